"""Where a video to compare comes from: a views file, a Gaussian scene, a folder of images, an array, or a video file."""

from __future__ import annotations

import os
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.path_names import utf8_path
from dpcli.store import file_kind
from dpcli.store.views import ViewsHeader, ViewsReader

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
VIDEO_SUFFIXES = (".mp4", ".gif", ".webm", ".avi", ".mov", ".mkv")
_EXPECTED = "expected a views or gaussians file, a folder of images, an .npy array, or a video file"


@dataclass(frozen=True)
class View:
    """One camera's video. names: what it goes by, its own first; role: reference | train | test."""

    names: tuple[str, ...]
    role: str

    @property
    def title(self) -> str:
        return self.names[0]


@dataclass(frozen=True)
class Picture:
    """A frame, as it is stored: rgba u8 (H,W,4) with straight alpha, or values f32 (H,W,4) premultiplied with alpha."""

    rgba: np.ndarray | None = None
    values: np.ndarray | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        height, width = (self.rgba if self.values is None else self.values).shape[:2]
        return width, height

    @property
    def unusable(self) -> int:
        """Pixels with a NaN or infinite value."""
        return 0 if self.values is None else int((~np.isfinite(self.values)).any(-1).sum())

    def over(self, background: Sequence[float]) -> np.ndarray:
        """Colors f32 (3,H,W) in 0..1 over a background color (3) in 0..1."""
        behind = np.asarray(background, np.float32)
        if self.values is None:
            from dpcli.evaluate.video.image_kernels import composite

            out = np.empty((3, *self.rgba.shape[:2]), np.float32)
            composite(np.ascontiguousarray(self.rgba), behind, out)
            return out
        mixed = self.values[..., :3] + (1 - self.values[..., 3:]) * behind
        return np.ascontiguousarray(np.clip(mixed, 0, 1).transpose(2, 0, 1), np.float32)

    def mask(self) -> np.ndarray:
        """Pixels of the object, u8 (H,W): alpha of one half or more."""
        alpha = self.rgba[..., 3] >= 128 if self.values is None else self.values[..., 3] >= 0.5
        return alpha.astype(np.uint8)


class Source(ABC):
    """Videos of one object. `pictures` reads the frames of a view in rising order, one in memory at a time.

    frames: of each view, None = any (a scene can be seen at any time). has_alpha: whether the object is cut out.
    """

    path: Path
    kind: str
    views: list[View]
    frames: list[int] | None
    has_alpha: bool = True
    header: ViewsHeader | None = None
    history: list[dict] = []

    @abstractmethod
    def pictures(self, view: int, frames: Sequence[int]) -> Iterator[Picture]:
        """The frames of a view, in rising order."""

    def close(self) -> None:  # noqa: B027  most sources hold nothing open
        """Let go of open files."""


def _named(index: int, role: str, of_role: int) -> tuple[str, ...]:
    """What view `index` goes by; `of_role`: how many views of its role come before. `eval_k` is Consistent4D's name."""
    extra = ("reference",) if role == "reference" else (f"{role}_{of_role}",)
    return (str(index), *extra, *((f"eval_{of_role}",) if role == "test" else ()))


class ViewsSource(Source):
    """A `views` file."""

    kind = "views file"

    def __init__(self, path: Path) -> None:
        self.path, self.reader = path, ViewsReader(path)
        self.header, self.history = self.reader.header, self.reader.provenance
        roles = self.header.role
        self.views = [View(_named(i, role, roles[:i].count(role)), role) for i, role in enumerate(roles)]
        self.frames = [self.header.num_frames] * len(self.views)

    def pictures(self, view: int, frames: Sequence[int]) -> Iterator[Picture]:
        for frame in frames:
            yield Picture(rgba=self.reader.rgba(view, frame))

    def close(self) -> None:
        self.reader.close()


class SceneSource(Source):
    """A `gaussians` file, rendered at the cameras and times of a views file in float32, never rounded to 8 bits.

    DataError when the truth's times lie more than half a frame outside the scene's.
    """

    kind, frames = "gaussians file", None

    def __init__(self, path: Path, header: ViewsHeader, truth: Path) -> None:
        from dpcli.store.gaussians import read_scene, scene_origin

        self.path, self.header, self.scene, self.history = path, header, read_scene(path), scene_origin(path)[1]
        roles = header.role
        self.views = [View(_named(i, role, roles[:i].count(role)), role) for i, role in enumerate(roles)]
        self._same_times(truth)

    def _same_times(self, truth: Path) -> None:
        own, wanted = self.scene.time, self.header.time
        slack = 0.5 * min((np.diff(t).min() for t in (own, wanted) if len(t) > 1), default=np.inf)
        if wanted[0] < own[0] - slack or wanted[-1] > own[-1] + slack:
            raise DataError(
                f"{self.path}: holds {own[0]:.4g} to {own[-1]:.4g} s, but {truth} has frames from "
                f"{wanted[0]:.4g} to {wanted[-1]:.4g} s; was it fitted to another clip?"
            )

    def pictures(self, view: int, frames: Sequence[int]) -> Iterator[Picture]:
        for frame in frames:
            yield Picture(values=self._render(view, float(self.header.time[frame])))

    def _render(self, view: int, time: float) -> np.ndarray:
        """Premultiplied colors and alpha f32 (H,W,4)."""
        import torch

        from dpcli.ops.splatting.rasterization import rasterization

        scene, (width, height) = self.scene, self.header.size
        cameras = (self.header.world_to_camera[view, None], self.header.intrinsics[view, None])
        arrays = (*scene.at(time), scene.scale, scene.opacity, scene.sh, *cameras)
        with torch.no_grad():
            tensors = (torch.from_numpy(np.ascontiguousarray(array, np.float32)) for array in arrays)
            colors, alphas, _ = rasterization(*tensors, width, height, sh_degree=scene.sh_degree)
        return torch.cat([colors[0, ..., :3], alphas[0]], -1).numpy()


class FolderSource(Source):
    """A folder of images, frames ordered by the numbers in their names, or of such folders, one per view."""

    kind = "folder of images"

    def __init__(self, path: Path) -> None:
        self.path = path
        folders = {path: _images(path)} if _images(path) else {}
        for child in sorted((p for p in path.iterdir() if p.is_dir()), key=_numbers) if not folders else ():
            if _images(child):
                folders[child] = _images(child)
        if not folders:
            raise DataError(f"{path}: no images in it or in its folders ({', '.join(IMAGE_SUFFIXES)})")
        self.files = list(folders.values())
        self.views = [_folder_view("" if folder == path else folder.name) for folder in folders]
        self.frames = [len(files) for files in self.files]
        self.has_alpha = _read_image(self.files[0][0])[1]

    def pictures(self, view: int, frames: Sequence[int]) -> Iterator[Picture]:
        for frame in frames:
            yield Picture(rgba=_read_image(self.files[view][frame])[0])


def _images(folder: Path) -> list[Path]:
    return sorted((p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES), key=_numbers)


def _numbers(path: Path) -> tuple:
    return [int(number) for number in re.findall(r"\d+", path.stem)], path.name


def _folder_view(name: str) -> View:
    """`2`, `view_2`, `cam-02`: view 2 of a views file; `reference`, `ref`, `input`, or one folder alone: the reference."""
    if name.lower() in ("", "reference", "ref", "input"):
        return View(tuple(dict.fromkeys([name.lower() or "reference", "reference"])), "reference")
    number = re.fullmatch(r"(?:view|cam|camera)?[-_]?(\d+)", name.lower())
    return View((name, *([str(int(number[1]))] if number and number[1] != name else ())), "test")


def _read_image(path: Path) -> tuple[np.ndarray, bool]:
    """rgba u8 (H,W,4), and whether the file has an alpha channel. DataError when unreadable or not 8-bit color."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            if image.mode.startswith(("I", "F")):
                raise DataError(f"{path}: pixels of type {image.mode}; expected an 8-bit color picture")
            has_alpha = "A" in image.getbands() or "transparency" in image.info
            return np.asarray(image.convert("RGBA")), has_alpha
    except (OSError, SyntaxError, ValueError) as error:
        raise DataError(f"{path}: not a readable image ({error}); make it again") from None


class ArraySource(Source):
    """An .npy array (T,H,W,C) or (V,T,H,W,C), C 3 or 4 (straight alpha): uint8, or floats in 0..1."""

    kind = "array"

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            array = np.load(path, mmap_mode="r", allow_pickle=False)
        except (ValueError, OSError, EOFError) as error:
            raise DataError(f"{path}: not a readable .npy array ({error})") from None
        array = array[None] if array.ndim == 4 else array
        known = array.dtype == np.uint8 or array.dtype.kind == "f"
        if array.ndim != 5 or array.shape[-1] not in (3, 4) or not known or array.size == 0:
            raise DataError(
                f"{path}: {array.dtype} {array.shape}; expected uint8, or floats in 0..1, of shape "
                "([views,] frames, height, width, 3 or 4)"
            )
        self.array, count = array, len(array)
        self.views = [_folder_view("" if count == 1 else str(index)) for index in range(count)]
        self.frames = [array.shape[1]] * count
        self.has_alpha = array.shape[-1] == 4

    def pictures(self, view: int, frames: Sequence[int]) -> Iterator[Picture]:
        for frame in frames:
            values = np.array(self.array[view, frame])
            if values.shape[-1] == 3:
                opaque = np.full((*values.shape[:2], 1), 255 if values.dtype == np.uint8 else 1, values.dtype)
                values = np.concatenate([values, opaque], -1)
            if values.dtype == np.uint8:
                yield Picture(rgba=values)
                continue
            largest = float(np.nanmax(values, initial=0))
            if 1.5 < largest < np.inf:
                raise DataError(
                    f"{self.path}: frame {frame} has values up to {largest:g}; floats are taken as 0..1: "
                    "divide by 255, or store them as uint8"
                )
            with np.errstate(invalid="ignore"):  # NaN is found, and said, by whoever compares
                colored = values[..., :3] * values[..., 3:]
            yield Picture(values=np.concatenate([colored, values[..., 3:]], -1, dtype=np.float32))


class VideoSource(Source):
    """A video file: one opaque view, decoded as it is read."""

    kind, has_alpha = "video file", False

    def __init__(self, path: Path) -> None:
        self.path = path
        capture = self._open()
        count = 0
        while capture.grab():  # what a container declares is often wrong
            count += 1
        capture.release()
        if not count:
            raise DataError(f"{path}: not a readable video (empty, damaged, or of an unknown codec)")
        self.views, self.frames = [_folder_view("")], [count]

    def _open(self):  # -> cv2.VideoCapture
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        import cv2

        return cv2.VideoCapture(utf8_path(self.path, "OpenCV"))

    def pictures(self, view: int, frames: Sequence[int]) -> Iterator[Picture]:
        capture, wanted = self._open(), set(frames)
        for frame in range(max(wanted, default=-1) + 1):
            good, image = capture.read()
            if not good:
                raise DataError(f"{self.path}: frame {frame} cannot be decoded; make the file again")
            if frame in wanted:
                rgba = np.full((*image.shape[:2], 4), 255, np.uint8)
                rgba[..., :3] = image[..., ::-1]
                yield Picture(rgba=rgba)
        capture.release()


def open_source(path: Path, *, truth: Source | None = None) -> Source:
    """The videos at `path`; `truth` gives a Gaussian scene its cameras and times. DataError for anything else."""
    if path.is_dir():
        return FolderSource(path)
    if not path.is_file():
        raise DataError(f"{path}: no such file or folder; {_EXPECTED}")
    if path.suffix.lower() == ".npy":
        return ArraySource(path)
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return VideoSource(path)
    kind = file_kind(path)
    if kind == "views":
        return ViewsSource(path)
    if kind != "gaussians":
        raise DataError(f"{path}: holds {kind!r}; {_EXPECTED}")
    if truth is None:
        raise DataError(f"{path}: a Gaussian scene has no pictures, so it can't be the truth; give the views file")
    if not isinstance(truth, ViewsSource):
        raise DataError(
            f"{truth.path}: a {truth.kind} has no cameras to render {path} with; give the views file, "
            "or render the scene first (`dpc generate4d render`)"
        )
    return SceneSource(path, truth.header, truth.path)
