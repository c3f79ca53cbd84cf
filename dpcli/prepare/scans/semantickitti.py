"""SemanticKITTI (Behley et al. 2019): Velodyne scans of sequences 00 to 10, objects are labeled instances."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.file_cache import cached_by_file
from dpcli.path_names import first_names
from dpcli.prepare.reader import Item, Reader, Sample, describe, require_folder, require_known, require_least
from dpcli.prepare.scans.kitti_files import (
    COORDINATES,
    IMAGE_SIZE,
    OUTSIDE,
    View,
    calibration_matrix,
    check_objects,
    is_no_camera,
    names_in,
    orient_points,
    read_calibration,
    read_velodyne,
    renumber_objects,
    to_camera_axes,
)
from dpcli.store import CloudSequence

# the lower 16 bits of a label; moving ones have numbers of their own
CLASSES = {
    "car": (10, 252),
    "bicycle": (11,),
    "bus": (13, 257),
    "motorcycle": (15,),
    "on-rails": (16, 256),
    "truck": (18, 258),
    "other-vehicle": (20, 259),
    "person": (30, 254),
    "bicyclist": (31, 253),
    "motorcyclist": (32, 255),
}
_OTHER_CLASSES = (0, 1, 40, 44, 48, 49, 50, 51, 52, 60, 70, 71, 72, 80, 81, 99)  # ground, buildings, plants, ...
LABELED = tuple(f"{number:02}" for number in range(11))
GROUPS = {"all": LABELED, "without-08": tuple(s for s in LABELED if s != "08"), "only-08": ("08",)}
VALIDATION = "08"
_WHOLE = "scans kept whole, because P2 in calib.txt is no camera's (focal length below 10 pixels)"
_KNOWN = np.isin(np.arange(1 << 16), [*_OTHER_CLASSES, *(number for own in CLASSES.values() for number in own)])
_REMAPPED = (
    "scans with classes that SemanticKITTI doesn't have, as where labels were renumbered for training; objects are found by its"
    " own numbers (car 10, truck 18, ...)"
)


def read_labels(path: Path, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Reads semantic class and full label, i64 (count) each; the file: uint32, class in the lower 16 bits, instance
    above.
    """
    data = path.read_bytes()
    if len(data) != 4 * count:
        raise DataError(f"{path}: {len(data)} bytes; expected {4 * count}, 4 for each of the scan's {count} points")
    label = np.frombuffer(data, "<u4").astype(np.int64)
    return label & 0xFFFF, label


@cached_by_file(4)
def read_poses(path: Path) -> np.ndarray:
    """Reads poses.txt as f64 (scans,4,4): camera of each scan to the camera of scan 0."""
    try:
        rows = [
            [float(word) for word in line.split()] for line in path.read_text("utf-8-sig").splitlines() if line.strip()
        ]
    except OSError:
        raise DataError(f"{path}: not found; --align needs it") from None
    except ValueError:
        raise DataError(f"{path}: not lines of 12 numbers") from None
    if not rows or any(len(row) != 12 for row in rows) or not np.isfinite(rows).all():
        raise DataError(f"{path}: expected 12 finite numbers a line (a 3x4 matrix), one line for each scan")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = np.reshape(rows, (-1, 3, 4))
    return poses


def _labels_without_scan(folder: Path) -> list[str]:
    return sorted(set(names_in(folder / "labels", ".label")) - set(names_in(folder / "velodyne", ".bin")))


@dataclass(frozen=True)
class _Scan:
    """Holds the points of one scan in camera axes, f64 (M,3), and their objects, i64 (M), 0 = background.

    ``dropped`` counts the points outside the view; ``strange``: there are classes that SemanticKITTI doesn't have.
    """

    points: np.ndarray
    objects: np.ndarray
    dropped: int
    strange: bool


@dataclass(frozen=True)
class SemanticKitti(Reader):
    """Reads sequences/SS/{velodyne,labels,calib.txt,poses.txt}.

    ``group``: which of GROUPS; ``frames`` successive scans are one sample, windows don't overlap; ``align`` moves them
    to the camera of the sample's first scan; ``objects``: the classes whose instances are parts 1, 2, ..., else 0.
    """

    raw: Path
    group: str = "all"
    frames: int = 1
    align: bool = False
    objects: tuple[str, ...] = ("car", "truck")
    view: View = View()
    coordinates: str = "published"
    length_unit: ClassVar[str] = "m"
    fields: ClassVar[tuple[str, ...]] = ("part",)

    def __post_init__(self) -> None:
        require_known(self, coordinates=COORDINATES)
        if self.group not in GROUPS:
            raise UsageError(f"--group {self.group}: expected {', '.join(GROUPS)}")
        check_objects(self.objects, CLASSES)
        require_least(self, frames=1)

    @property
    def config(self) -> dict[str, Any]:
        own = {"group": self.group, "frames": self.frames, "align": self.align, "objects": list(self.objects)}
        return {**own, "near": self.view.near, "far": self.view.far, "coordinates": self.coordinates}

    def _folders(self) -> list[tuple[str, Path]]:
        require_folder(self.raw, "dataset/sequences/00 ... as SemanticKITTI is unpacked")
        for folder in (self.raw / "dataset" / "sequences", self.raw / "sequences", self.raw):
            found = [(name, folder / name) for name in GROUPS[self.group] if (folder / name / "velodyne").is_dir()]
            if found:
                return found
        wanted = "08" if self.group == "only-08" else "00"
        raise DataError(
            f"{self.raw}: no sequences/{wanted}/velodyne/ in it; expected the odometry scans and the labels"
        )

    def items(self) -> list[Item]:
        items = []
        for sequence, folder in self._folders():
            scans = names_in(folder / "velodyne", ".bin")
            for start in range(0, len(scans) - self.frames + 1, self.frames):
                window = scans[start : start + self.frames]
                split = "validation" if sequence == VALIDATION else "train"
                problem = self._problem(folder, window)
                files = [folder / "velodyne" / f"{name}.bin" for name in window]
                files += [folder / "labels" / f"{name}.label" for name in window]
                extra = {"scans": window, "files": [*files, folder / "calib.txt", folder / "poses.txt"]}
                items.append(Item(f"{sequence}_{window[0]}", folder, split=split, extra=extra, problem=problem))
        if not items:
            raise DataError(f"{self.raw}: no sequence holds {counted(self.frames, 'scan')} (velodyne/000000.bin ...)")
        return items

    def _problem(self, folder: Path, window: list[str]) -> str:
        numbers = [int(name) if name.isdecimal() else -1 for name in window]
        if numbers != list(range(max(numbers[0], 0), numbers[0] + len(window))):
            return f"{folder / 'velodyne'}: {window[0]} to {window[-1]} are not {len(window)} successive scans"
        for name in window:
            if not (folder / "labels" / f"{name}.label").is_file():
                return f"{folder / 'labels' / name}.label: missing"
        return ""

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        path = item.path / "calib.txt"
        if not path.is_file():
            raise DataError(f"{path}: missing; the crop to the camera's view needs it")
        found = read_calibration(path)
        to_camera, projection = (calibration_matrix(found, path, key) for key in ("Tr", "P2"))
        whole = is_no_camera(projection)
        kept = [self._scan(item.path, name, to_camera, None if whole else projection) for name in item.extra["scans"]]
        notes = {_WHOLE: len(kept)} if whole else {OUTSIDE: sum(scan.dropped for scan in kept)}
        notes[_REMAPPED] = sum(scan.strange for scan in kept)
        motions = self._alignment(item)
        moved = [scan.points @ m[:3, :3].T + m[:3, 3] for scan, m in zip(kept, motions, strict=True)]
        ahead = whole and to_camera[2, 0] < 0.5  # x of the scanner stays x, as by a Tr that moves nothing
        clouds = [orient_points(to_camera_axes(points) if ahead else points, self.coordinates) for points in moved]
        sizes = np.cumsum([len(scan.objects) for scan in kept])[:-1]
        # over all frames: an object keeps its number
        part = renumber_objects(np.concatenate([scan.objects for scan in kept]))
        if not min(map(len, clouds)):
            raise DataError(f"{item.name}: a scan without a point in the camera's view within {self.view.far} m")
        sequence = CloudSequence.from_frames(item.name, clouds, part=np.split(part, sizes), **describe(item))
        notes["samples without an object"] = int(not part.any())
        return Sample(sequence, notes)

    def _scan(self, folder: Path, name: str, to_camera: np.ndarray, projection: np.ndarray | None) -> _Scan:
        """Reads a scan; without a projection all points are kept, where ``to_camera`` puts them."""
        scan = read_velodyne(folder / "velodyne" / f"{name}.bin")
        semantic, label = read_labels(folder / "labels" / f"{name}.label", len(scan))
        strange = not _KNOWN[semantic].all()
        label[~np.isin(semantic, [number for kind in self.objects for number in CLASSES[kind]])] = 0
        if projection is None:
            return _Scan(scan.astype(np.float64) @ to_camera[:3, :3].T + to_camera[:3, 3], label, 0, strange)
        points, index = self.view.crop(scan, to_camera, projection, IMAGE_SIZE)
        return _Scan(points, label[index], len(scan) - len(index), strange)

    def _alignment(self, item: Item) -> np.ndarray:
        """Returns f64 (frames,4,4): what moves each scan's camera points to the camera of the first; identities
        without.
        """
        numbers = [int(name) for name in item.extra["scans"]]
        if not self.align:
            return np.tile(np.eye(4), (len(numbers), 1, 1))
        poses = read_poses(item.path / "poses.txt")
        if numbers[-1] >= len(poses):
            raise DataError(
                f"{item.path / 'poses.txt'}: {counted(len(poses), 'line')}, none for scan {item.extra['scans'][-1]}"
            )
        return np.linalg.inv(poses[numbers[0]]) @ poses[numbers]

    def summary(self, items: list[Item]) -> list[str]:
        held = sum(len(names_in(folder / "velodyne", ".bin")) for _, folder in self._folders())
        found = [name for name, _ in self._folders()]
        lines = [f"{counted(len(items), 'sample')} of {counted(self.frames, 'scan')}, sequences {', '.join(found)}"]
        missing = [name for name in GROUPS[self.group] if name not in found]
        if missing:
            lines.append(f"sequences not there: {', '.join(missing)}")
        lost = [f"{name}/{stem}" for name, folder in self._folders() for stem in _labels_without_scan(folder)]
        if lost:
            lines.append(f"{counted(len(lost), 'label file')} without a scan: {first_names(lost)}; is the copy whole?")
        left = held - len(items) * self.frames
        if left:
            lines.append(
                f"{counted(left, 'scan')} at the ends of sequences left out: fewer than --frames {self.frames}"
            )
        return lines
