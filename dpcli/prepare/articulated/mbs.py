"""`mbs-shapepart` and `mbs-sapien`, the data of MultiBodySync (Huang et al. 2021): four views of articulated objects."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.npy_files import open_archive
from dpcli.path_names import first_names
from dpcli.prepare.array_files.safe_pickle import read_npz_member
from dpcli.prepare.articulated.object_splits import counts_of_splits
from dpcli.prepare.reader import SPLITS, Item, Reader, Sample, describe, require_folder, split_called
from dpcli.store import CloudSequence
from dpcli.store.sequence import TOLERANCE, are_rigid
from dpcli.text_files import read_json

_MOST_PARTS = 1000  # of a sample


def read_meta(raw: Path) -> dict[str, list[int]]:
    """Reads the numbers of the samples of each split from meta.json. Raises DataError when it is not that."""
    path = require_folder(raw, "meta.json and data/000000.npz ... as the authors distribute it") / "meta.json"
    try:
        meta = read_json(path)
    except OSError:
        raise DataError(f"{path}: not found; expected meta.json and a folder data/ of .npz files") from None
    good = isinstance(meta, dict) and any(map(split_called, meta))
    good = good and all(isinstance(meta[s], list) and all(type(n) is int and n >= 0 for n in meta[s]) for s in meta)
    if not good:
        raise DataError(f'{path}: expected {{"train": [numbers], "val": [...], "test": [...]}}')
    return meta


def most_parts(paths: Iterable[Path]) -> int:
    """Returns the largest part id of some samples, which every pose is padded to."""
    most = 1
    for path in paths:
        try:
            with open_archive(path) as archive:
                most = max(most, int(_part_ids(archive, path).max()))
        except (DataError, OSError, zipfile.BadZipFile):
            continue  # read() will say what is wrong with it
    return most


def _part_ids(archive: zipfile.ZipFile, path: Path) -> np.ndarray:
    """Reads the parts of the points, which count from 1. Raises DataError when they are something else."""
    segm = read_npz_member(archive, path, "segm")
    if segm.dtype.kind not in "iu" or not segm.size:
        raise DataError(f"{path}: segm is {segm.dtype} {segm.shape}; expected whole numbers (views, points)")
    if segm.min() < 1 or segm.max() > _MOST_PARTS:
        raise DataError(f"{path}: segm holds ids from {segm.min()} to {segm.max()}; expected 1 to the number of parts")
    return segm


def read_views(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reads one sample: points f32 (V,N,3), part ids i16 (V,N) from 0, poses f64 (V,parts,4,4).

    The file has for every view v its camera pose C_v and the pose T_s,v of every part s, so a point of part s goes
    from view i to j by C_j^-1 T_s,j T_s,i^-1 C_i; the pose of a part in the points of view v is C_v^-1 T_s,v.
    DataError names the array that is not as it should be.
    """
    try:
        with open_archive(path) as archive:
            points = read_npz_member(archive, path, "pc")
            segm = _part_ids(archive, path)
            trans = read_npz_member(archive, path, "trans", pickled=True)
    except zipfile.BadZipFile:
        raise DataError(f"{path}: not a .npz file, perhaps truncated") from None
    if points.ndim != 3 or points.shape[2] != 3 or points.dtype.kind != "f" or 0 in points.shape:
        raise DataError(f"{path}: pc is {points.dtype} {points.shape}; expected floats (views, points, 3)")
    if not np.isfinite(points).all():
        raise DataError(f"{path}: pc holds NaN or infinity; expected finite coordinates")
    if segm.shape != points.shape[:2]:
        raise DataError(f"{path}: segm is {segm.dtype} {segm.shape}; expected whole numbers {points.shape[:2]}")
    return points.astype(np.float32), (segm - 1).astype(np.int16), _poses(path, trans, len(points), int(segm.max()))


def _poses(path: Path, trans: Any, views: int, num_parts: int) -> np.ndarray:
    if isinstance(trans, np.ndarray) and trans.shape == ():
        trans = trans.item()
    if not isinstance(trans, dict):
        raise DataError(f"{path}: trans holds a {type(trans).__name__}; expected a dict of 'cam' and part ids")
    camera = _matrices(path, trans, "cam", views)
    poses = np.stack([_matrices(path, trans, part + 1, views) for part in range(num_parts)], axis=1)
    return np.linalg.inv(camera)[:, None] @ poses


def _matrices(path: Path, trans: dict, key: str | int, views: int) -> np.ndarray:
    value = trans.get(key, trans.get(str(key)))
    if value is None:
        raise DataError(f"{path}: trans has no {key!r}; found {', '.join(map(repr, list(trans)[:9]))}")
    try:
        matrices = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        matrices = np.zeros(0)
    if matrices.shape != (views, 4, 4):
        raise DataError(
            f"{path}: trans[{key!r}] has shape {matrices.shape}; expected ({views}, 4, 4), one for each view"
        )
    if not are_rigid(matrices, TOLERANCE).all():
        raise DataError(f"{path}: trans[{key!r}] is not a rigid motion; expected a rotation and a shift")
    return matrices


@dataclass(frozen=True)
class MultiBodySync(Reader):
    """Reads a folder of meta.json and data/%06d.npz."""

    raw: Path
    length_unit: ClassVar[str] = "as published"
    fields: ClassVar[tuple[str, ...]] = ("part", "pose")

    def items(self) -> list[Item]:
        meta = read_meta(self.raw)
        parts = most_parts(self.raw / "data" / f"{number:06d}.npz" for own in meta.values() for number in own)
        items = []
        for key in sorted(filter(split_called, meta), key=lambda key: SPLITS.index(split_called(key))):
            for number in meta[key]:
                path = self.raw / "data" / f"{number:06d}.npz"
                problem = "" if path.is_file() else f"{path}: listed under {key!r} in meta.json, but not there"
                name = f"{number:06d}"
                items.append(Item(name, path, split=split_called(key), extra={"parts": parts}, problem=problem))
        twice = len(items) - len({item.name for item in items})
        if twice:
            raise DataError(
                f"{self.raw / 'meta.json'}: {counted(twice, 'number')} listed twice; a sample is in one split"
            )
        return items

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        points, part, poses = read_views(item.path)
        sequence = CloudSequence.from_frames(item.name, list(points), part=list(part), pose=poses, **describe(item))
        sequence.pad_parts(item.extra["parts"])
        return Sample(sequence)

    def summary(self, items: list[Item]) -> list[str]:
        lines = [f"{counted(len(items), 'sample')} ({counts_of_splits(item.split for item in items)})"]
        left = sorted({path.stem for path in (self.raw / "data").glob("[!.]*.npz")} - {item.name for item in items})
        return lines + ([f"not read, in no split of meta.json: {first_names(left)}"] if left else [])
