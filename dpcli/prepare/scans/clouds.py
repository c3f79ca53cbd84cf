"""A folder of point cloud files (one sequence), or a folder of such folders (one sequence each)."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.path_names import as_utf8
from dpcli.prepare.decode.cloud_files import SUFFIXES, Cloud, read_cloud
from dpcli.prepare.labels import LabelTable, labels_of_folders, read_labels
from dpcli.prepare.reader import Item, Sample, describe, drop_empty_frames, natural_key, offsets, require_folder
from dpcli.store import CloudSequence

_FAR_AWAY = 1e4  # beyond this a float32 step exceeds half a millimeter: map coordinates must be shifted first


@dataclass(frozen=True)
class CloudFolders:
    """Reads point cloud files. ``scale``: input units per unit of length in the output."""

    raw: Path
    bin_columns: int = 4
    scale: float = 1.0
    unit: str = "m"
    fps: float | None = None
    stride: int = 1
    label_from_folder: bool = False
    labels: Path | None = None

    def __post_init__(self) -> None:
        if self.labels and self.label_from_folder:
            raise UsageError("--labels and --label-from-folder were both given; use one")
        if not self.scale > 0 or (self.fps is not None and not self.fps > 0):
            raise UsageError("--scale and --fps must be more than 0")
        if self.bin_columns < 3:
            raise UsageError(f"--bin-columns {self.bin_columns}: expected 3 (x y z) or more")

    @property
    def class_names(self) -> list[str]:
        """Returns the class names in the order of their labels."""
        return self._table.class_names if self._table else []

    @property
    def length_unit(self) -> str:
        """Returns the name of the output's unit of length."""
        return self.unit

    @property
    def fields(self) -> tuple[str, ...]:
        """Returns ``color`` among the fields when the very first frame has colors; then every frame must."""
        return (("time",) if self.fps else ()) + (("color",) if self._has_color else ())

    @property
    def config(self) -> dict[str, Any]:
        """Returns the options that decide the content, for the provenance."""
        return {k: v for k, v in asdict(self).items() if k not in ("raw", "labels")}

    @cached_property
    def _table(self) -> LabelTable | None:
        if self.label_from_folder:
            return labels_of_folders(self.raw, [as_utf8(path.as_posix()) for path in self._relative], "CLASS")
        return read_labels(self.labels) if self.labels else None

    @cached_property
    def _relative(self) -> list[Path]:
        expected = f"point clouds ({', '.join(SUFFIXES)}), or folders of them"
        root = require_folder(self.raw, expected)
        table = self.labels.resolve() if self.labels else None  # a .csv that is no cloud may lie among the data
        folders = [
            Path(f)
            for f, _, names in os.walk(root)
            if any(is_cloud(n) and (Path(f) / n).resolve() != table for n in names)
        ]
        if not folders:
            raise DataError(f"{root}: no {expected}")
        relative = sorted((f.relative_to(root) for f in folders), key=lambda p: natural_key(p.as_posix()))
        if self.label_from_folder and any(not path.parts for path in relative):
            raise DataError(f"{root}: holds clouds itself; --label-from-folder expects CLASS/SEQUENCE/frames below it")
        return relative

    @cached_property
    def _has_color(self) -> bool:
        for relative in self._relative:
            try:
                return read_cloud(frame_paths(self.raw / relative)[0], self.bin_columns).color is not None
            except DataError:
                continue  # a bad sample: the next one tells
        return False

    def items(self) -> list[Item]:
        """Returns the index in its final order. Raises DataError when the raw data are not what they should be."""
        items = []
        for relative in self._relative:
            name = as_utf8(relative.as_posix() if relative.parts else self.raw.resolve().name)
            items.append(Item(name, self.raw / relative, extra={"color": self._has_color}))
        return self._table.apply(items) if self._table else items

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        """Returns the sample of one item. Raises DataError when its data are bad."""
        paths = frame_paths(item.path)[:: self.stride]
        clouds = [read_cloud(path, self.bin_columns) for path in paths]
        notes = {"points with NaN or infinity dropped": sum(drop_invalid(cloud) for cloud in clouds)}
        counts = np.array([len(cloud.points) for cloud in clouds], np.int64)
        kept, dropped = drop_empty_frames(str(item.path), counts)
        notes = {what: count for what, count in {**notes, **dropped}.items() if count}
        points = np.concatenate([clouds[t].points for t in kept])
        if self.scale != 1:
            points = points.astype(np.float64) / self.scale
        if np.abs(points).max() > _FAR_AWAY:
            points = points - np.floor(points[: counts[kept[0]]].min(0))
            notes["sequences shifted to their first frame's corner for precision"] = 1
        color = self._colors(item, paths, clouds) if item.extra["color"] else None
        time = kept * self.stride / self.fps if self.fps else None
        return Sample(
            CloudSequence(
                item.name, points.astype(np.float32), offsets(counts[kept]), time=time, color=color, **describe(item)
            ),
            notes,
        )

    def _colors(self, item: Item, paths: list[Path], clouds: list[Cloud]) -> np.ndarray:
        plain = [path for path, cloud in zip(paths, clouds, strict=True) if cloud.color is None]
        if plain:
            raise DataError(
                f"{plain[0]}: no colors, though the first frame of all has them; expected the same fields throughout"
            )
        return np.concatenate([cloud.color for cloud in clouds if cloud.color is not None])

    def summary(self, items: list[Item]) -> list[str]:
        """Returns lines for the log about what the index holds and lacks."""
        frames = sum(len(frame_paths(item.path)) for item in items)
        return [f"{len(items)} sequence{'s' if len(items) != 1 else ''} of {frames} frames found"]


def is_cloud(name: str) -> bool:
    """Returns whether a file name looks like a point cloud."""
    return name.lower().endswith(SUFFIXES) and not name.startswith(".")


def frame_paths(folder: Path) -> list[Path]:
    """Returns the point clouds directly in a folder, in natural order."""
    return sorted((p for p in folder.iterdir() if is_cloud(p.name) and p.is_file()), key=natural_key)


def drop_invalid(cloud: Cloud) -> int:
    """Removes points with NaN or infinity (organized clouds mark "no return" so) in place, and returns how many there
    were.
    """
    valid = np.isfinite(cloud.points).all(1)
    if not valid.all():
        cloud.points = cloud.points[valid]
        cloud.color = None if cloud.color is None else cloud.color[valid]
    return int(len(valid) - valid.sum())
