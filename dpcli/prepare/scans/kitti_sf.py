"""KITTI scene flow 2015 (Menze and Geiger 2015): disparity, optical flow and instances into pairs of clouds with flow."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.prepare.reader import Item, Reader, Sample, describe, require_known
from dpcli.prepare.scans.kitti_files import (
    COORDINATES,
    calibration_matrix,
    missing_files_problem,
    names_in,
    orient_points,
    read_calibration,
    read_png,
    renumber_objects,
    training_folder,
)
from dpcli.store import CloudSequence

# Cityscapes numbers, which KITTI's instance images use
CLASSES = {
    "person": 24,
    "rider": 25,
    "car": 26,
    "truck": 27,
    "bus": 28,
    "caravan": 29,
    "trailer": 30,
    "train": 31,
    "motorcycle": 32,
    "bicycle": 33,
}
LABELS = ("instance", "obj_map")
BASELINE = 0.54  # meters between the color cameras
SCENES, TRAIN_SCENES = 200, 100


@dataclass
class FlowPair:
    """Holds the same points in two frames, camera axes: first, second f64 (N,3) meters; pixel i64 (N,2) row, column."""

    first: np.ndarray
    second: np.ndarray
    pixel: np.ndarray


def unproject(u: np.ndarray, v: np.ndarray, depth: np.ndarray, projection: np.ndarray) -> np.ndarray:
    """Returns points f64 (N,3), x right, y down, z forward, of pixels (u, v) and depths (N) under a projection f64
    (3+,4).

    With P = projection: u (z + P[2,3]) = P[0,0] x + P[0,2] z + P[0,3], and so for v; the same focal length both ways.
    """
    focal, scaled = projection[0, 0], depth + projection[2, 3]
    x = (u * scaled - (projection[0, 2] * depth + projection[0, 3])) / focal
    y = (v * scaled - (projection[1, 2] * depth + projection[1, 3])) / focal
    return np.stack([x, y, depth], axis=-1)


def flow_pair(
    disparity: tuple[np.ndarray, np.ndarray],  # f64 (H,W) pixels, 0 = unknown; the second at pixels of frame 1
    flow: np.ndarray,  # u16 (H,W,3), u, v, valid as the file has them
    projection: np.ndarray,  # f64 (3+,4)
    far: float,
) -> FlowPair:
    """Returns points whose disparity in both frames and flow are known and that are nearer than ``far`` in both."""
    depth = [projection[0, 0] * BASELINE / (one + 1e-5) for one in disparity]
    good = (disparity[0] > 0) & (disparity[1] > 0) & (flow[..., 2] == 1) & (depth[0] < far) & (depth[1] < far)
    v, u = np.nonzero(good)
    moved = (flow[good][:, :2].astype(np.float64) - 2**15) / 64
    first = unproject(u, v, depth[0][good], projection)
    second = unproject(u + moved[:, 0], v + moved[:, 1], depth[1][good], projection)
    return FlowPair(first, second, np.stack([v, u], axis=1))


def class_numbers(names: tuple[str, ...]) -> tuple[int, ...]:
    """Returns cityscapes numbers of class names; UsageError names one that is unknown."""
    unknown = [name for name in names if name not in CLASSES]
    if unknown or not names:
        raise UsageError(
            f"--objects {','.join(names)}: {', '.join(unknown) or 'nothing'} is not a class of the instance "
            f"images; expected some of {', '.join(CLASSES)}"
        )
    return tuple(CLASSES[name] for name in names)


@dataclass(frozen=True)
class KittiSceneFlow(Reader):
    """Reads training/{disp_occ_0,disp_occ_1,flow_occ,instance,calib_cam_to_cam}.

    ``objects``: the classes whose instances are parts 1, 2, ...; all else is part 0. ``labels``: which images say so.
    """

    raw: Path
    objects: tuple[str, ...] = ("car", "bus")
    labels: str = "instance"
    far: float = 35.0
    coordinates: str = "published"
    length_unit: ClassVar[str] = "m"
    fields: ClassVar[tuple[str, ...]] = ("part", "scene_flow")

    def __post_init__(self) -> None:
        class_numbers(self.objects)
        require_known(self, coordinates=COORDINATES, labels=LABELS)
        if not self.far > 0:
            raise UsageError(f"--far {self.far}: expected a distance above 0, meters")

    @property
    def config(self) -> dict[str, Any]:
        objects = {"objects": list(self.objects)} if self.labels == "instance" else {}
        return {"labels": self.labels, **objects, "far": self.far, "coordinates": self.coordinates}

    def items(self) -> list[Item]:
        folder = training_folder(self.raw, "flow_occ")
        names = names_in(folder / "flow_occ", "_10.png")
        if not names:
            raise DataError(
                f"{folder / 'flow_occ'}: no 000000_10.png ...; expected the 200 flow maps of the training set"
            )
        unknown = [name for name in names if not (name.isdecimal() and len(name) == 6)]
        if unknown:
            raise DataError(f"{folder / 'flow_occ' / unknown[0]}_10.png: expected a name of six digits and _10.png")
        return [
            Item(
                name,
                folder,
                split="train" if int(name) < TRAIN_SCENES else "test",
                extra={"files": list(self._files(folder, name).values())},
                problem=missing_files_problem(list(self._files(folder, name).values())),
            )
            for name in names
        ]

    def _files(self, folder: Path, name: str) -> dict[str, Path]:
        images = ("disp_occ_0", "disp_occ_1", "flow_occ", self.labels)
        plain = folder / "calib_cam_to_cam" / f"{name}.txt"
        calibration = plain if plain.exists() else plain.with_name(f"{name}_10.txt")
        chosen = calibration if calibration.exists() else plain
        return {**{key: folder / key / f"{name}_10.png" for key in images}, "calibration": chosen}

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        files = self._files(item.path, item.name)
        flow = read_png(files["flow_occ"], 3)
        size = flow.shape[:2]
        disparity = tuple(read_png(files[key], 1, size) / 256 for key in ("disp_occ_0", "disp_occ_1"))
        found = read_calibration(files["calibration"])
        projection = calibration_matrix(found, files["calibration"], "P_rect_02")
        if not projection[0, 0] > 0:
            raise DataError(
                f"{files['calibration']}: P_rect_02 has focal length {projection[0, 0]}; expected pixels > 0"
            )
        pair = flow_pair(disparity, flow, projection, self.far)
        if not len(pair.pixel):
            raise DataError(f"{files['flow_occ']}: no pixel has flow and both disparities nearer than {self.far} m")
        part = self._parts(files[self.labels], size, pair.pixel)
        first, second = (orient_points(points, self.coordinates) for points in (pair.first, pair.second))
        flows = [second - first, first - second]
        sequence = CloudSequence.from_frames(
            item.name, [first, second], part=[part, part], scene_flow=flows, **describe(item)
        )
        return Sample(sequence, {"scenes without an object": int(not part.any())})

    def _parts(self, path: Path, size: tuple[int, int], pixel: np.ndarray) -> np.ndarray:
        """Returns i16 (N): 0 background, then one number for each object that has points."""
        ids = read_png(path, 1, size, bits=(8, 16))[pixel[:, 0], pixel[:, 1]].astype(np.int64)
        if self.labels == "instance":
            ids[~np.isin(ids // 256, class_numbers(self.objects))] = 0
        return renumber_objects(ids)

    def summary(self, items: list[Item]) -> list[str]:
        good = sum(not item.problem for item in items)
        train = sum(item.split == "train" for item in items)
        lines = [f"{good} of {counted(len(items), 'scene')} with all their files ({train} train)"]
        if len(items) != SCENES:
            lines.append(f"{counted(len(items), 'scene')} where the published training set has {SCENES}")
        return lines
