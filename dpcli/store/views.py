"""Files of kind `views`: one object seen from V cameras over T frames, as RGBA pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import h5py
import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, reading
from dpcli.path_names import as_utf8
from dpcli.runtime.whole_file import refuse_existing
from dpcli.store.file import (
    PACKED,
    data_set,
    history_of,
    open_store,
    read_provenance,
    read_strings,
    root_attributes,
    write_root,
    write_strings,
)
from dpcli.store.schema import fields_of
from dpcli.store.writing.atomic_file import AtomicFile

ROLES = ("reference", "train", "test")
_FIELD = fields_of("views")
_RIGID = 1e-5  # how far R R^T may be from the identity: room for matrices that were once float32


@dataclass
class ViewsHeader:
    """Holds all of a views file but its pictures and ground truth; V views, T frames.

    name: str. intrinsics: f64 (V,3,3) pixels, pixel centers at +0.5. world_to_camera: f64 (V,4,4) rigid, OpenCV axes.
    time: f64 (T) seconds, rising. role: V of reference | train | test, with one reference. reference: its index.
    size: (width, height) pixels. length_unit: of the world; "" = unknown.
    """

    name: str
    intrinsics: np.ndarray
    world_to_camera: np.ndarray
    time: np.ndarray
    role: list[str]
    reference: int
    size: tuple[int, int]
    length_unit: str = ""

    @property
    def num_views(self) -> int:
        """Counts the views, V."""
        return len(self.role)

    @property
    def num_frames(self) -> int:
        """Counts the frames, T."""
        return len(self.time)

    def camera_centers(self) -> np.ndarray:
        """Returns where the cameras stand in the world, f64 (V,3)."""
        return -np.einsum("vji,vj->vi", self.world_to_camera[:, :3, :3], self.world_to_camera[:, :3, 3])

    def validate(self) -> None:
        """Raises DataError, which names the field, unless shapes agree, values are finite, poses rigid, times rising."""
        views, frames = self.num_views, self.num_frames
        if not views or not frames or min(self.size) < 1:
            raise DataError(f"{self.name!r}: {views} views, {frames} frames, size {tuple(self.size)}; none may be 0")
        shapes = {"intrinsics": (views, 3, 3), "world_to_camera": (views, 4, 4), "time": (frames,)}
        for key, shape in shapes.items():
            value = np.asarray(getattr(self, key))
            if value.shape != shape:
                raise DataError(f"{self.name!r}: {key} has shape {value.shape}, expected {shape}")
            if not np.isfinite(value).all():
                raise DataError(f"{self.name!r}: {key} holds NaN or infinite values")
        self._check_roles()
        self._check_cameras()
        if (np.diff(self.time) <= 0).any():
            frame = int(np.argmax(np.diff(self.time) <= 0))
            raise DataError(f"{self.name!r}: time must rise; frame {frame + 1} is not later than frame {frame}")

    def _check_roles(self) -> None:
        wrong = sorted(set(self.role) - set(ROLES))
        if wrong:
            raise DataError(f"{self.name!r}: role {wrong[0]!r}; expected one of {', '.join(ROLES)}")
        references = [view for view, role in enumerate(self.role) if role == "reference"]
        if references != [self.reference]:
            raise DataError(
                f"{self.name!r}: views {references} have the role reference, but reference = {self.reference}"
            )

    def _check_cameras(self) -> None:
        for view, (camera, pose) in enumerate(zip(self.intrinsics, self.world_to_camera, strict=True)):
            if camera[0, 0] <= 0 or camera[1, 1] <= 0 or list(camera[2]) != [0, 0, 1] or camera[1, 0] != 0:
                raise DataError(
                    f"{self.name!r}: intrinsics of view {view} are not [[fx s cx] [0 fy cy] [0 0 1]], fx, fy > 0"
                )
            # one that shifts the ends of the picture by more than half a pixel
            if abs(camera[0, 1]) * self.size[1] > camera[1, 1]:
                raise DataError(
                    f"{self.name!r}: intrinsics of view {view} have a skew of {camera[0, 1]:g}; expected pixels that are "
                    "rectangles, since nothing draws others"
                )
            rotation = pose[:3, :3]
            off = np.abs(rotation @ rotation.T - np.eye(3)).max()
            if off > _RIGID or np.linalg.det(rotation) < 0 or list(pose[3]) != [0, 0, 0, 1]:
                raise DataError(
                    f"{self.name!r}: world_to_camera of view {view} is not a rotation and a shift (off by {off:.2g})"
                )


def _check_truth(name: str, frames: int, track: np.ndarray | None, part: np.ndarray | None) -> None:
    if track is None:
        if part is not None:
            raise DataError(f"{name!r}: part without track; parts belong to tracked points")
        return
    if track.ndim != 3 or track.shape[0] != frames or track.shape[2] != 3 or not np.isfinite(track).all():
        raise DataError(f"{name!r}: track {track.shape} must be finite, shape (frames = {frames}, points, 3)")
    if part is not None and (part.shape != track.shape[1:2] or part.min(initial=-1) < -1):
        raise DataError(f"{name!r}: part {part.shape} must have {track.shape[1]} ids, none below -1")


class ViewsWriter:
    """Writes pictures one by one by `add`, in any order, as a context manager; the file appears whole when the block ends.

    track: f32 (T,M,3) true world positions of M surface points at every frame, part: i16 (M) their rigid part or bone,
    -1 unknown; both optional. One picture is in memory at a time. Raises DataError when the block ends and one is missing;
    UsageError when `path` exists and `force` is off.
    """

    def __init__(
        self,
        path: str | Path,
        header: ViewsHeader,
        *,
        seed: int = 0,
        source: str = "",
        provenance: dict | Sequence[dict] | None = None,
        track: np.ndarray | None = None,
        part: np.ndarray | None = None,
        force: bool = False,
    ) -> None:
        refuse_existing(path, force)
        header.validate()
        track = None if track is None else np.asarray(track, _FIELD["track"].dtype)
        part = None if part is None else np.asarray(part, _FIELD["part"].dtype)
        _check_truth(header.name, header.num_frames, track, part)
        self.header = header
        self.provenance = history_of(provenance)
        self._written = np.zeros((header.num_views, header.num_frames), bool)
        self._atomic = AtomicFile(path)
        try:
            self._create(seed, source, track, part)
        except BaseException as error:
            self._atomic.failed(error)
            raise

    def _create(self, seed: int, source: str, track: np.ndarray | None, part: np.ndarray | None) -> None:
        file, header = self._atomic.file, self.header
        write_root(
            file,
            "views",
            length_unit=header.length_unit,
            source=source,
            seed=seed,
            class_names=(),
            provenance=self.provenance,
        )
        file.attrs.update({"name": as_utf8(header.name), "reference": int(header.reference)})
        width, height = header.size
        picture = (height, width, 4)
        shape = (header.num_views, header.num_frames, *picture)
        self._rgba = file.create_dataset("rgba", shape, _FIELD["rgba"].dtype, chunks=(1, 1, *picture), **PACKED)
        for key in ("intrinsics", "world_to_camera", "time"):
            file.create_dataset(key, data=np.asarray(getattr(header, key), _FIELD[key].dtype))
        write_strings(file, "role", header.role)
        if track is not None:
            file.create_dataset("track", data=track)
        if part is not None:
            file.create_dataset("part", data=part)

    def add(self, view: int, frame: int, rgba: np.ndarray) -> None:
        """Writes one picture: u8 (H,W,4), straight (not premultiplied) alpha. Raises DataError on another shape or a repeat."""
        views, frames = self._written.shape
        if not (0 <= view < views and 0 <= frame < frames):
            raise DataError(
                f"{self.header.name!r}: view {view}, frame {frame}; expected one of {counted(views, 'view')} and {counted(frames, 'frame')}"
            )
        if rgba.shape != self._rgba.shape[2:] or rgba.dtype != np.uint8:
            raise DataError(
                f"{self.header.name!r}: view {view}, frame {frame} is {rgba.dtype} {rgba.shape}, "
                f"expected uint8 {self._rgba.shape[2:]}"
            )
        if self._written[view, frame]:
            raise DataError(f"{self.header.name!r}: view {view}, frame {frame} was given twice")
        self._rgba[view, frame] = rgba
        self._written[view, frame] = True

    def __enter__(self) -> ViewsWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            self._atomic.failed(error)
            return
        if not self._written.all():
            view, frame = np.argwhere(~self._written)[0]
            self._atomic.discard()
            raise DataError(
                f"{self._atomic.target}: {int((~self._written).sum())} of {self._written.size} pictures are missing, "
                f"the first is view {view}, frame {frame}; nothing was written"
            )
        self._atomic.commit()


class ViewsReader:
    """Reads a `views` file, opened lazily in each process, as a context manager; the handle is never pickled.

    `header`: ViewsHeader. `track`: f32 (T,M,3) or None, `part`: i16 (M) or None, read when first asked for.
    Raises DataError when the file is not what the contract says.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._file: h5py.File | None = None
        self._truth: tuple[np.ndarray | None, np.ndarray | None] | None = None
        with open_store(self.path, ["views"]) as file:
            self.attributes, self.provenance = root_attributes(file), read_provenance(file)
            self.header = self._load_header(file)
            self.fields = tuple(key for key in ("track", "part") if key in file)

    def _load_header(self, file: h5py.File) -> ViewsHeader:
        rgba, intrinsics, poses, time = (
            data_set(file, key) for key in ("rgba", "intrinsics", "world_to_camera", "time")
        )
        for key in ("name", "reference"):
            if key not in file.attrs:
                raise DataError(f"{self.path}: attribute {key!r} is missing; the file is incomplete, make it again")
        role = read_strings(file, "role")
        found = (len(role), len(time))
        if rgba.shape[:2] != found:
            raise DataError(
                f"{self.path}: rgba is {rgba.dtype} {rgba.shape}, expected uint8 "
                f"(views = {found[0]}, frames = {found[1]}, height, width, 4)"
            )
        header = ViewsHeader(
            str(self.attributes["name"]),
            intrinsics[:],
            poses[:],
            time[:],
            role,
            int(self.attributes["reference"]),
            (rgba.shape[3], rgba.shape[2]),
            str(self.attributes.get("length_unit", "")),
        )
        try:
            header.validate()
        except DataError as error:
            raise DataError(f"{self.path}: {error}") from None
        return header

    @property
    def num_views(self) -> int:
        """Counts the views, V."""
        return self.header.num_views

    @property
    def num_frames(self) -> int:
        """Counts the frames, T."""
        return self.header.num_frames

    @property
    def file(self) -> h5py.File:
        """Opens the file in this process unless it is open, and returns the handle."""
        self._open()
        return self._file

    @property
    def _rgba(self) -> h5py.Dataset:
        self._open()
        return self._pictures

    def _open(self) -> None:
        if self._file is None or not self._file.id.valid:
            self._file = open_store(self.path, ["views"])
            self._pictures = self._file["rgba"]  # looking a data set up costs as much as decoding a picture

    def rgba(self, view: int, frame: int) -> np.ndarray:
        """Reads the picture u8 (H,W,4) of a view at a frame, straight alpha. One chunk is read."""
        if not (0 <= view < self.num_views and 0 <= frame < self.num_frames):
            raise DataError(
                f"{self.path}: view {view}, frame {frame}; the file has {counted(self.num_views, 'view')}"
                f" and {counted(self.num_frames, 'frame')}"
            )
        with reading(f"{self.path}: view {view}, frame {frame}"):
            return self._rgba[view, frame]

    @property
    def track(self) -> np.ndarray | None:
        """Reads the true positions of surface points, f32 (T,M,3), once; None where the file has none."""
        return self._load_truth()[0]

    @property
    def part(self) -> np.ndarray | None:
        """Reads the parts of these points, i16 (M), once; None where the file has none."""
        return self._load_truth()[1]

    def _load_truth(self) -> tuple[np.ndarray | None, np.ndarray | None]:
        if self._truth is None:
            with reading(self.path):
                track, part = (self.file[key][:] if key in self.fields else None for key in ("track", "part"))
            try:
                _check_truth(self.header.name, self.num_frames, track, part)
            except DataError as error:
                raise DataError(f"{self.path}: {error}; make the file again") from None
            self._truth = (track, part)
        return self._truth

    def close(self) -> None:
        """Closes the handle of this process; the next read opens the file again."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> ViewsReader:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def __getstate__(self) -> dict:
        return {**self.__dict__, "_file": None, "_pictures": None}
