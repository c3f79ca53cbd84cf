"""OGC-DR and OGC-DRSV (Song and Yang 2022): rooms of a few objects, each moving rigidly over four frames."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.npy_files import map_npy
from dpcli.path_names import first_names, path_inside
from dpcli.prepare.reader import Item, Reader, Sample, describe, require_folder
from dpcli.store import CloudSequence
from dpcli.store.sequence import TOLERANCE, are_rigid

ROOMS = 5000
_SPLITS = {"train": "train", "val": "validation", "test": "test"}
_CLOUD = re.compile(r"pc_(\d+)\.npy")


def read_array(path: Path, kind: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """Reads a .npy of numbers of this kind ("f", "iu") and shape (None: any length).

    Raises DataError; pickles are refused.
    """
    try:
        array = map_npy(path)
    except FileNotFoundError:
        raise DataError(f"{path}: missing") from None
    good = array.dtype.kind in kind and array.ndim == len(shape)
    if not good or 0 in array.shape or any(e not in (None, n) for e, n in zip(shape, array.shape, strict=True)):
        wanted = ", ".join("n" if length is None else str(length) for length in shape)
        raise DataError(
            f"{path}: is {array.dtype} {array.shape}; expected {'floats' if kind == 'f' else 'whole numbers'} ({wanted})"
        )
    return array


def read_poses(path: Path) -> np.ndarray:
    """Reads pose_%02d.npy as f64 (objects,4,4). Raises DataError unless every matrix is a rotation and a shift."""
    pose = read_array(path, "f", (None, 4, 4)).astype(np.float64)
    good = are_rigid(pose, TOLERANCE)
    if not good.all():
        raise DataError(
            f"{path}: the matrix of object {int(np.argmin(good)) + 1} is not a rigid motion; "
            "expected a rotation and a shift"
        )
    return pose


def read_segmentation(path: Path, objects: int, points: int | None = None) -> np.ndarray:
    """Reads segm_%02d.npy as part i16 (N): object s (from 1) is s - 1, background (0, if there is any) is ``objects``."""
    segm = read_array(path, "iu", (points,))
    if segm.min() < 0 or segm.max() > objects:
        raise DataError(f"{path}: holds ids from {segm.min()} to {segm.max()}; expected 1 to {objects}, 0 = background")
    return np.where(segm == 0, objects, segm.astype(np.int64) - 1).astype(np.int16)


def read_room(folder: Path) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray]:
    """Reads frames f32 (N,3), parts i16 (N), poses f64 (T,objects+1,4,4), the last the background, which stands still."""
    numbers = sorted(int(m[1]) for path in folder.iterdir() if (m := _CLOUD.fullmatch(path.name)))
    if not numbers or numbers != list(range(len(numbers))):
        raise DataError(f"{folder}: frames {numbers or 'none'}; expected pc_00.npy, pc_01.npy, ... without gaps")
    clouds, parts, poses = [], [], []
    for t in numbers:
        cloud = read_array(folder / f"pc_{t:02d}.npy", "f", (None, 3))
        if not np.isfinite(cloud).all():
            raise DataError(f"{folder / f'pc_{t:02d}.npy'}: holds NaN or infinity; expected finite coordinates")
        pose = read_poses(folder / f"pose_{t:02d}.npy")
        if poses and len(pose) != len(poses[0]):
            raise DataError(
                f"{folder / f'pose_{t:02d}.npy'}: {counted(len(pose), 'object')}, {len(poses[0])} in pose_00.npy"
            )
        clouds.append(cloud.astype(np.float32))
        parts.append(read_segmentation(folder / f"segm_{t:02d}.npy", len(pose), len(cloud)))
        poses.append(pose)
    still = np.tile(np.eye(4), (len(poses), 1, 1, 1))
    return clouds, parts, np.concatenate([np.stack(poses), still], axis=1)


def read_lists(raw: Path) -> list[tuple[str, str]]:
    """Reads (room, split) from data/{train,val,test}.lst, in their order.

    Raises DataError when none is there or a room repeats.
    """
    data = require_folder(raw, "data/ of rooms and train.lst, val.lst, test.lst") / "data"
    rooms = [
        (name, split)
        for key, split in _SPLITS.items()
        if (data / f"{key}.lst").is_file()
        for name in (data / f"{key}.lst").read_text("utf-8-sig", "replace").split()
    ]
    if not rooms:
        raise DataError(
            f"{data}: no rooms listed; expected train.lst, val.lst and test.lst with names such as 8_000123"
        )
    name, times = Counter(name for name, _ in rooms).most_common(1)[0]
    if times > 1:
        raise DataError(f"{data}: room {name} is listed {times} times; a room is in one split, once")
    return rooms


def _misplaced(data: Path, name: str) -> str:
    """Returns what is wrong with a listed name that is not a folder's beside the list, "" when nothing is."""
    if Path(name).name != name or name in (".", ".."):
        return f"{data}: a list names {name!r}; expected the name of a folder beside it"
    try:
        path_inside(data, data, name)
    except DataError as error:
        return f"{data}: a list names a folder that is not a room: {error}"
    return ""


def most_parts(rooms: Iterable[Path]) -> int:
    """Returns how many parts every pose is padded to: the most objects of a room, one more if its first frame has
    background.
    """
    most = 1
    for folder in rooms:
        try:
            objects = map_npy(folder / "pose_00.npy").shape[0]
            most = max(most, int(read_segmentation(folder / "segm_00.npy", objects).max()) + 1, objects)
        except (DataError, OSError, IndexError):
            continue  # read() will say what is wrong with it
    return most


@dataclass(frozen=True)
class OgcRooms(Reader):
    """Reads the released arrays, of OGC-DR and OGC-DRSV alike."""

    raw: Path
    length_unit: ClassVar[str] = "room width"
    fields: ClassVar[tuple[str, ...]] = ("part", "pose")

    def items(self) -> list[Item]:
        data, items = self.raw / "data", []
        for name, split in read_lists(self.raw):
            problem = _misplaced(data, name)
            if not problem and not (data / name).is_dir():
                problem = f"{data / name}: in the list of the {split} split, but no such folder"
            items.append(Item(name, data / name, split=split, problem=problem))
        parts = most_parts(item.path for item in items if not item.problem)
        return [replace(item, extra={"parts": parts}) for item in items]

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        clouds, parts, poses = read_room(item.path)
        used, padded = 1 + max(int(part.max()) for part in parts), item.extra["parts"]
        if used > padded:
            raise DataError(f"{item.path}: background in a later frame, but in no first frame of any room")
        sequence = CloudSequence.from_frames(item.name, clouds, part=parts, pose=poses[:, :padded], **describe(item))
        sequence.pad_parts(padded)
        return Sample(sequence)

    def summary(self, items: list[Item]) -> list[str]:
        counts = Counter(item.split for item in items)
        lines = [
            f"{counted(len(items), 'room')} ({', '.join(f'{counts[split]} {split}' for split in _SPLITS.values())})"
        ]
        if len(items) != ROOMS:
            lines.append(f"{counted(len(items), 'room')} where the published set has {ROOMS}")
        folders = {path.name for path in (self.raw / "data").iterdir() if (path / "pc_00.npy").is_file()}
        left = sorted(folders - {item.name for item in items})
        return lines + ([f"not read, in no list: {first_names(left)}"] if left else [])
