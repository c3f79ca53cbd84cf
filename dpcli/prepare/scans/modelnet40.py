"""ModelNet40 as PointNet's authors distribute it (modelnet40_ply_hdf5_2048): one cloud per shape, to pretrain with."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import h5py
import numpy as np

from dpcli.errors import DataError, reading
from dpcli.file_cache import cached_by_file
from dpcli.path_names import first_names
from dpcli.prepare.array_files.containers import own_data_set
from dpcli.prepare.reader import Item, Reader, Sample, describe, natural_key, published_found, require_folder
from dpcli.store import CloudSequence
from dpcli.store.heap_check import check_heaps

CLASS_NAMES = tuple(
    "airplane bathtub bed bench bookshelf bottle bowl car chair cone cup curtain desk door dresser flower_pot"
    " glass_box guitar keyboard lamp laptop mantel monitor night_stand person piano plant radio range_hood sink"
    " sofa stairs stool table tent toilet tv_stand vase wardrobe xbox".split()
)
PUBLISHED = {"train": 9840, "test": 2468}
_FILE = re.compile(r"ply_data_(train|test)(\d+)\.h5")
_EXPECTED = "ply_data_train0.h5 ..., ply_data_test0.h5 ..., train_files.txt and test_files.txt"


def _read_array(path: Path, name: str) -> np.ndarray:
    check_heaps(path)
    with reading(path), h5py.File(path, "r") as file:
        return own_data_set(file, name, path)[()]


@cached_by_file(1)  # 50 MB; its 2,048 shapes are read one after the other
def _clouds(path: Path) -> np.ndarray:
    data = _read_array(path, "data")
    if data.ndim != 3 or data.shape[2] != 3 or data.dtype.kind != "f":
        raise DataError(f"{path}: data is {data.dtype} {data.shape}; expected floats (shapes, points, 3)")
    return data


def read_labels(path: Path) -> np.ndarray:
    """Returns labels i64 (N) of a file, from 0."""
    label = _read_array(path, "label")
    if label.dtype.kind not in "iu" or label.ndim == 0 or label.size != len(label):
        raise DataError(f"{path}: label is {label.dtype} {label.shape}; expected whole numbers (shapes, 1)")
    return label.reshape(-1).astype(np.int64)


@dataclass(frozen=True)
class ModelNet40(Reader):
    """Reads the folder; a sample is a sequence of one frame."""

    raw: Path
    length_unit: ClassVar[str] = "unit sphere"
    fields: ClassVar[tuple[str, ...]] = ()

    @property
    def class_names(self) -> list[str]:
        path = self.raw / "shape_names.txt"
        if not path.is_file():
            return list(CLASS_NAMES)
        names = path.read_text("utf-8-sig", "replace").split()
        if len(names) != len(CLASS_NAMES) or len(set(names)) != len(names):
            raise DataError(f"{path}: {len(names)} names, {len(set(names))} of them different; expected 40")
        return names

    def items(self) -> list[Item]:
        folder = require_folder(self.raw, _EXPECTED)
        there = {path.name: path for path in folder.iterdir() if _FILE.fullmatch(path.name)}
        splits = {name: _FILE.fullmatch(name)[1] for name in there}  # type: ignore[index]
        listed = {split: _listed(folder / f"{split}_files.txt") for split in PUBLISHED}
        items: list[Item] = []
        for name in sorted(there.keys() | {n for names in listed.values() for n in names or ()}, key=natural_key):
            homes = [split for split, names in listed.items() if name in (names or ())]
            if not homes and all(names is None for names in listed.values()):
                homes = [splits[name]]  # copies without the lists: the name tells
            items += self._shapes(name, there.get(name), homes, folder)
        if not items:
            raise DataError(f"{folder}: no {_EXPECTED}")
        order = {"train": 0, "test": 1, "": 2}
        return sorted(items, key=lambda item: order[item.split])

    def _shapes(self, name: str, path: Path | None, homes: list[str], folder: Path) -> list[Item]:
        problem = ""
        if path is None:
            problem = f"{folder / name}: listed in {homes[0]}_files.txt, but not there"
        elif len(homes) != 1:
            problem = f"{path}: in {'both list files' if homes else 'neither list file'}; expected one"
        if not problem:
            try:
                labels = read_labels(path)
            except (DataError, OSError) as error:
                problem = str(error)
        if problem:
            return [Item(name, path or folder, homes[0] if homes else "", problem=problem)]
        stem = name.removesuffix(".h5").removeprefix("ply_data_")
        rows = enumerate(labels.tolist())
        return [_item(f"{stem}/{row:04d}", path, homes[0], (row, len(labels)), label) for row, label in rows]

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        data, (row, labels) = _clouds(item.path), item.extra["row"]
        if row >= len(data):
            raise DataError(f"{item.path}: data has {len(data)} shapes, label has more; expected as many")
        if not np.isfinite(data[row]).all():
            raise DataError(f"{item.path}: shape {row} holds NaN or infinity; expected finite coordinates")
        more = len(data) - labels if row == 0 else 0  # told once of a file
        sequence = CloudSequence.from_frames(item.name, [data[row].astype(np.float32)], **describe(item))
        return Sample(sequence, {"shapes behind the last label left out": max(more, 0)})

    def summary(self, items: list[Item]) -> list[str]:
        lines = published_found(items, PUBLISHED, "shapes")
        files = (path.name for path in self.raw.glob("[!.]*") if path.suffix.lower() in (".h5", ".hdf5"))
        left = sorted(name for name in files if not _FILE.fullmatch(name))
        return lines + ([f"not read, not called ply_data_train0.h5 or the like: {first_names(left)}"] if left else [])


def _item(name: str, path: Path, split: str, place: tuple[int, int], label: int) -> Item:
    """Returns the item of a shape; place: its row in the file, and how many labels that has."""
    row, problem = place[0], ""
    if not 0 <= label < len(CLASS_NAMES):
        problem = f"{path}: label {label} of shape {row} is out of range; expected 0 to {len(CLASS_NAMES) - 1}"
    return Item(name, path, split, label=label, extra={"row": place}, problem=problem)


def _listed(path: Path) -> set[str] | None:
    """Returns file names of a list such as ``data/modelnet40_ply_hdf5_2048/ply_data_train0.h5``; None without the
    list.
    """
    if not path.is_file():
        return None
    lines = path.read_text("utf-8-sig", "replace").split("\n")
    return {line.strip().replace("\\", "/").rpartition("/")[2] for line in lines if line.strip()}
