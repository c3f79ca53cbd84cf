"""KITTI 3D object detection (Geiger et al. 2012): single Velodyne scans, objects are what labeled boxes hold."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.prepare.decode.png import png_size
from dpcli.prepare.reader import Item, Reader, Sample, describe, require_known
from dpcli.prepare.scans.kitti_files import (
    COORDINATES,
    IMAGE_SIZE,
    OUTSIDE,
    View,
    calibration_matrix,
    check_objects,
    missing_files_problem,
    names_in,
    orient_points,
    read_calibration,
    read_velodyne,
    training_folder,
)
from dpcli.store import CloudSequence

TYPES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc")
MARGIN = 0.01  # meters by which a box is larger than its label says
SCANS = 7481
_SPLITS = {"train": "train", "val": "validation"}
_FILES = {"calib": ".txt", "label_2": ".txt"}
_OTHERS = {"velodyne": ".bin", "image_2": ".png"}


@dataclass(frozen=True)
class Box:
    """Holds a labeled box in camera axes: ``foot`` f64 (3), the middle of its lower face; size in meters; turned about
    y.
    """

    kind: str
    foot: np.ndarray
    height: float
    width: float
    length: float
    rotation_y: float

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Returns bool (N), which points f64 (N,3) it holds; y points down: the box reaches from -height to 0 above its
        foot.
        """
        x, y, z = (points - self.foot).T
        cosine, sine = np.cos(self.rotation_y), np.sin(self.rotation_y)
        along, across = cosine * x - sine * z, sine * x + cosine * z
        inside = (np.abs(along) <= self.length / 2 + MARGIN) & (np.abs(across) <= self.width / 2 + MARGIN)
        return inside & (y >= -self.height - MARGIN) & (y <= MARGIN)


def read_boxes(path: Path) -> list[Box]:
    """Reads the boxes of a label file, in its order, without DontCare regions.

    DataError names the line that is not one.
    """
    boxes = []
    for number, line in enumerate(path.read_text("utf-8-sig", "replace").splitlines(), 1):
        words = line.split()
        if not words or words[0] == "DontCare":
            continue
        try:
            height, width, length, x, y, z, angle = (float(word) for word in words[8:15])
        except ValueError:
            raise DataError(
                f"{path}:{number}: {line[:60]!r}; expected a type and 14 numbers (15 with a score)"
            ) from None
        values = np.array([height, width, length, x, y, z, angle])
        if not np.isfinite(values).all() or values[:3].min() <= 0:
            raise DataError(
                f"{path}:{number}: a box of size {height} {width} {length}; expected finite numbers, sizes > 0"
            )
        boxes.append(Box(words[0], np.array([x, y, z]), height, width, length, angle))
    return boxes


def parts_of_boxes(points: np.ndarray, boxes: list[Box]) -> np.ndarray:
    """Returns i16 (N): the number of the box, from 1, that holds a camera point f64 (N,3), 0 for none; of several, the
    last.
    """
    part = np.zeros(len(points), np.int16)
    for number, box in enumerate(boxes, 1):
        part[box.contains(points)] = number
    return part


def read_lists(folder: Path) -> dict[str, str]:
    """Returns a mapping from scan names to splits, from train.txt and val.txt of a folder; empty when neither is there."""
    found: dict[str, str] = {}
    for key, split in _SPLITS.items():
        path = folder / f"{key}.txt"
        for name in path.read_text("utf-8-sig", "replace").split() if path.is_file() else []:
            if not (name.isdecimal() and len(name) == 6):
                raise DataError(f"{path}: holds {name[:40]!r}; expected six digits a line, such as 000123")
            if name in found:
                raise DataError(f"{path}: scan {name} is listed twice; a scan is in one split, once")
            found[name] = split
    return found


@dataclass(frozen=True)
class KittiDetection(Reader):
    """Reads training/{velodyne,label_2,calib,image_2}; ``objects``: the types whose boxes are parts 1, 2, ...

    ``lists``: folder of train.txt and val.txt (the split of Chen et al. 2015, 3,712 and 3,769 scans); by default
    RAW/ImageSets. Without lists no scan has a split.
    """

    raw: Path
    lists: Path | None = None
    objects: tuple[str, ...] = ("Car",)
    view: View = View()
    coordinates: str = "published"
    length_unit: ClassVar[str] = "m"
    fields: ClassVar[tuple[str, ...]] = ("part",)

    def __post_init__(self) -> None:
        require_known(self, coordinates=COORDINATES)
        check_objects(self.objects, TYPES)

    @property
    def config(self) -> dict[str, Any]:
        view = {"near": self.view.near, "far": self.view.far}
        return {"objects": list(self.objects), **view, "coordinates": self.coordinates}

    def items(self) -> list[Item]:
        folder, split = training_folder(self.raw, "velodyne"), self._split()
        names = names_in(folder / "velodyne", ".bin")
        if not names:
            raise DataError(f"{folder / 'velodyne'}: no 000000.bin ...; expected the scans of the training set")
        present = set(names)
        return [
            Item(
                name,
                folder,
                split=split.get(name, ""),
                extra={"files": [folder / key / f"{name}{end}" for key, end in (*_FILES.items(), *_OTHERS.items())]},
                problem=missing_files_problem([folder / key / f"{name}{end}" for key, end in _FILES.items()])
                if name in present
                else f"{folder / 'velodyne' / name}.bin: listed ({split[name]}), but not there",
            )
            for name in sorted(present | set(split))
        ]

    def _split(self) -> dict[str, str]:
        if self.lists is None:
            return read_lists(self.raw / "ImageSets")
        found = read_lists(self.lists)
        if not found:
            raise DataError(f"{self.lists}: neither train.txt nor val.txt with names of scans in it")
        return found

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        scan = read_velodyne(item.path / "velodyne" / f"{item.name}.bin")
        path = item.path / "calib" / f"{item.name}.txt"
        found = read_calibration(path)
        projection, rectify, to_camera = (
            calibration_matrix(found, path, key) for key in ("P2", "R0_rect", "Tr_velo_to_cam")
        )
        image = item.path / "image_2" / f"{item.name}.png"
        size = png_size(image) if image.is_file() else IMAGE_SIZE
        points, _ = self.view.crop(scan, rectify @ to_camera, projection, size)
        if not len(points):
            raise DataError(
                f"{item.path / 'velodyne' / item.name}.bin: no point in the camera's view within "
                f"{self.view.far} m; do scan and calibration belong together?"
            )
        labeled = read_boxes(item.path / "label_2" / f"{item.name}.txt")
        boxes = [box for box in labeled if box.kind in self.objects]
        strange = [box.kind for box in labeled if box.kind not in TYPES]
        part = parts_of_boxes(points, boxes)
        notes = {
            OUTSIDE: len(scan) - len(points),
            "scans cropped to 1242x375, their image_2 is missing": int(not image.is_file()),
            "scans without an object": int(not part.any()),
            f"boxes left out whose type is none of KITTI's, such as {min(strange, default='')!r}": len(strange),
            "boxes without a point": len(boxes) - len(np.unique(part[part > 0])),
        }
        cloud = orient_points(points, self.coordinates)
        sequence = CloudSequence.from_frames(item.name, [cloud], part=[part], **describe(item))
        return Sample(sequence, notes)

    def summary(self, items: list[Item]) -> list[str]:
        counts = {split: sum(item.split == split for item in items) for split in (*_SPLITS.values(), "")}
        lines = [
            f"{counted(len(items), 'scan')} ({counts['train']} train, {counts['validation']} validation, {counts['']} in no list)"
        ]
        if not counts["train"] + counts["validation"]:
            lines.append(
                f"no {self.raw / 'ImageSets'}/train.txt and val.txt: no split is written (--lists names a folder)"
            )
        if len(items) != SCANS:
            lines.append(f"{counted(len(items), 'scan')} where the published training set has {SCANS}")
        return lines
