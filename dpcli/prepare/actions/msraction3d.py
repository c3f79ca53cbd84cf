"""MSR-Action3D (Li et al. 2010): Kinect depth of 20 actions, the official ``.bin`` or the MATLAB ``.mat`` form."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from dpcli.errors import DataError, UsageError, reading
from dpcli.path_names import first_names
from dpcli.prepare.array_files.containers import own_data_set
from dpcli.prepare.array_files.mat5 import read_mat5
from dpcli.prepare.decode.folder_listing import files_below
from dpcli.prepare.decode.pinhole_camera import Intrinsics, back_project
from dpcli.prepare.reader import Item, Reader, Sample, require_folder, sample_of_frames

CLASS_NAMES = (
    "high arm wave",
    "horizontal arm wave",
    "hammer",
    "hand catch",
    "forward punch",
    "high throw",
    "draw x",
    "draw tick",
    "draw circle",
    "hand clap",
    "two hand wave",
    "side boxing",
    "bend",
    "forward kick",
    "side kick",
    "jogging",
    "tennis swing",
    "tennis serve",
    "golf swing",
    "pick up and throw",
)
NAME = re.compile(r"a(\d{2})_s(\d{2})_e(\d{2})_sdepth\.(bin|mat)", re.IGNORECASE)
_FOCAL = 280.0
_SIZE = 240, 320  # rows and columns of the pictures
_SMALLEST = 60  # rows of pictures that may be those of the data set, resized
_RESIZED = "videos that are resized, not 320x240; --focal (280 by default) counts pixels of 320x240: give theirs"
_LISTED = 8
# (action, subject, trial) absent from the 567 published videos; trial 0 stands for all three
ABSENT = (
    [(a, 4, 0) for a in range(1, 7)]
    + [(4, 3, 3), (5, 6, 3), (6, 6, 3), (7, 4, 3), (7, 7, 3), (15, 2, 3)]
    + [(15, s, 0) for s in (3, 4, 5)]
)


def published_names() -> list[str]:
    """Returns the names ``aAA_sSS_eEE`` of the 567 videos that the authors published (of 20 x 10 x 3 recorded)."""
    every = [(a, s, e) for a in range(1, 21) for s in range(1, 11) for e in range(1, 4)]
    return [f"a{a:02}_s{s:02}_e{e:02}" for a, s, e in every if not {(a, s, e), (a, s, 0)} & set(ABSENT)]


def read_bin(path: Path) -> tuple[np.ndarray, dict[str, int]]:
    """Reads the official binary form: depth uint32 (T,H,W) in raw units, 0 = background, and notes.

    Little-endian uint32: number of frames, width, height, then frames x height x width depths, row by row.
    """
    with path.open("rb") as file:
        header = np.fromfile(file, "<u4", 3).astype(int)
        if len(header) < 3:
            raise DataError(f"{path}: {path.stat().st_size} bytes; the header alone takes 12")
        frames, width, height = (int(v) for v in header)
        check_shape(path, frames, height, width)
        expected, found = 12 + 4 * frames * height * width, path.stat().st_size
        if found < expected:
            raise DataError(
                f"{path}: truncated: {frames} frames of {width}x{height} take {expected} bytes, found {found}"
            )
        depth = np.fromfile(file, "<u4", frames * height * width).reshape(frames, height, width)
    return depth, {"files with bytes after the last frame": 1} if found > expected else {}


def read_mat(path: Path) -> np.ndarray:
    """Reads a MATLAB file with a variable ``depth`` (H,W,T), version 5 or 7.3, as depth (T,H,W), C order. Where 240 rows and
    320 columns tell another order of the axes, as NumPy's users save them, it is that.
    """
    with path.open("rb") as file:
        is_hdf5 = b"MATLAB 7.3" in file.read(20)
    depth = _read_mat73(path) if is_hdf5 else read_mat5(path, "depth")
    if depth.dtype.kind not in "uif":
        raise DataError(f"{path}: 'depth' has type {depth.dtype}; expected numbers")
    if depth.ndim == 2:  # MATLAB drops a trailing axis of length one
        depth = depth[..., None]
    if depth.ndim != 3:
        raise DataError(f"{path}: 'depth' has shape {depth.shape}; expected (height, width, frames)")
    if [depth.shape.count(side) for side in _SIZE] == [1, 1]:
        rows, columns = map(depth.shape.index, _SIZE)
        depth = depth.transpose(rows, columns, 3 - rows - columns)
    check_shape(path, depth.shape[2], depth.shape[0], depth.shape[1])
    if depth.dtype.kind == "f" and not np.isfinite(depth).all():
        raise DataError(f"{path}: 'depth' holds NaN or infinity; expected finite numbers")
    return np.ascontiguousarray(depth.transpose(2, 0, 1))


def _read_mat73(path: Path) -> np.ndarray:
    import h5py

    from dpcli.store.heap_check import check_heaps

    check_heaps(path)
    with reading(f"{path}, a MATLAB 7.3 file"), h5py.File(path, "r") as file:
        if "depth" not in list(file):
            raise DataError(f"{path}: no variable 'depth'; found {list(file) or 'none'}")
        return own_data_set(file, "depth", path)[()].T  # HDF5 lists MATLAB's axes in reverse


def check_shape(path: Path, frames: int, height: int, width: int) -> None:
    """Raises DataError unless there is at least one frame of a believable size (a wrong header shows itself here)."""
    if frames == 0:
        raise DataError(f"{path}: an empty video: 0 frames; expected at least 1")
    if not (0 < height <= 8192 and 0 < width <= 8192):
        raise DataError(f"{path}: frames of {width}x{height} pixels; expected 320x240")


@dataclass(frozen=True)
class MSRAction3D(Reader):
    """Reads MSR-Action3D; defaults are those of the published point-cloud protocols (MeteorNet, PSTNet, Kinet)."""

    raw: Path
    focal: float = _FOCAL  # pixels; a guess of the MeteorNet authors, no calibration was published
    scale: float = 300.0  # raw depth units per unit of length in the output
    train_subjects: tuple[int, ...] = (1, 2, 3, 4, 5)
    class_names: ClassVar[tuple[str, ...]] = CLASS_NAMES
    fields: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        if not (self.focal > 0 and self.scale > 0):
            raise UsageError(f"--focal and --scale must be positive, found {self.focal:g} and {self.scale:g}")

    @property
    def length_unit(self) -> str:
        return f"{self.scale:g} raw depth units" if self.scale != 1 else "raw depth unit"

    def items(self) -> list[Item]:
        expected = "MSR-Action3D files named aAA_sSS_eEE_sdepth.bin or .mat"
        folder = require_folder(self.raw, expected)
        found: dict[str, Item] = {}
        for path in sorted(files_below(folder), key=lambda p: (p.name.lower(), str(p))):
            match = NAME.fullmatch(path.name)
            if not match:
                continue
            item = self._item(path, *(int(v) for v in match.groups()[:2]))
            first = found.setdefault(item.name, item).path
            # .bin sorts before .mat: where both are present the official form wins
            if first.suffix.lower() == path.suffix.lower() and not first.samefile(path):
                problem = f"{path}: {item.name} is there twice; {first} is read"
                found[f"{item.name} ({path})"] = Item(f"{item.name} ({path})", path, item.split, problem=problem)
        if not found:
            raise DataError(f"{folder}: no {expected} in it or below")
        return [found[name] for name in sorted(found)]

    def _item(self, path: Path, action: int, subject: int) -> Item:
        problem = ""
        if not 1 <= action <= len(CLASS_NAMES):
            problem = f"{path}: action {action} in the file name is out of range; expected 1 to {len(CLASS_NAMES)}"
        return Item(
            name=path.name[:11].lower(),
            path=path,
            label=action - 1,
            subject=subject,
            problem=problem,
            split="train" if subject in self.train_subjects else "test",
        )

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        notes: dict[str, int] = {}
        if item.path.suffix.lower() == ".bin":
            depth, notes = read_bin(item.path)
        else:
            depth = read_mat(item.path)
        height, width = depth.shape[1:]
        notes[_RESIZED] = int(self.focal == _FOCAL and (height, width) != _SIZE and height >= _SMALLEST)
        points, counts = back_project(depth, Intrinsics(self.focal, self.focal, width / 2, height / 2))
        points *= np.float32(1 / self.scale)
        return sample_of_frames(item, points, counts, notes)

    def summary(self, items: list[Item]) -> list[str]:
        expected, names = published_names(), {item.name for item in items if not item.problem}
        lines = [f"{len(names & set(expected))} of the {len(expected)} published videos found"]
        train = {name for name in expected if int(name[5:7]) in self.train_subjects}
        for split, wanted in (("train", train), ("test", set(expected) - train)):
            missing = sorted(wanted - names)
            subjects = Counter(name[4:7] for name in missing)
            where = ", ".join(f"{s}: {n}" for s, n in sorted(subjects.items()))
            lines.append(
                f"{split}: {len(wanted) - len(missing)}/{len(wanted)}"
                + (f"; missing by subject {where}" if missing else "")
            )
        extra = sorted(names - set(expected))
        lines += [f"not among the published: {first_names(extra, _LISTED)}"] if extra else []
        taken = {item.path.resolve() for item in items}
        files = (p for p in files_below(self.raw) if p.suffix.lower() in (".bin", ".mat"))
        left = [p.name for p in files if p.resolve() not in taken]
        why = "called otherwise, or beside the .bin of the same video"
        return lines + ([f"not read, {why}: {first_names(left, _LISTED)}"] if left else [])
