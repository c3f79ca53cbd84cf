"""A folder of point cloud files (one sequence), or a folder of such folders (one sequence each)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.path_names import as_utf8
from dpcli.prepare.decode.cloud_files import SUFFIXES, Cloud, read_cloud
from dpcli.prepare.labels import LabelTable, labels_of_folders, read_labels
from dpcli.prepare.reader import Item, Sample, describe, drop_empty_frames, offsets, require_folder
from dpcli.prepare.scans.cloud_series import find_sequences
from dpcli.prepare.series import Series, about_series
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
    pattern: str = ""

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
        return (("time",) if self._timed else ()) + (("color",) if self._has_color else ())

    @property
    def config(self) -> dict[str, Any]:
        """Returns the options that decide the content, for the provenance."""
        left_out = ("raw", "labels", *(() if self.pattern else ("pattern",)))
        return {k: v for k, v in asdict(self).items() if k not in left_out}

    @cached_property
    def _table(self) -> LabelTable | None:
        if self.label_from_folder:
            return labels_of_folders(self.raw, [as_utf8(path.as_posix()) for path in self._relative], "CLASS")
        return read_labels(self.labels) if self.labels else None

    @cached_property
    def _series(self) -> list[Series]:
        root = require_folder(self.raw, f"point clouds ({', '.join(SUFFIXES)}), or folders of them")
        found = find_sequences(root, SUFFIXES, pattern=self.pattern, table=self.labels)
        if self.label_from_folder and any(one.folder == root for one in found):
            raise DataError(f"{root}: holds clouds itself; --label-from-folder expects CLASS/SEQUENCE/frames below it")
        return found

    @property
    def _relative(self) -> list[Path]:
        return [one.folder.relative_to(self.raw) for one in self._series]

    @cached_property
    def _timed(self) -> bool:
        """Returns whether the time of every frame is known: by ``fps``, or because all names are times."""
        return all(one.frame_times(self.fps) is not None for one in self._series)

    @cached_property
    def _has_color(self) -> bool:
        for one in self._series:
            try:
                return read_cloud(one.paths[0], self.bin_columns).color is not None
            except DataError:
                continue  # a bad sample: the next one tells
        return False

    def items(self) -> list[Item]:
        """Returns the index in its final order. Raises DataError when the raw data are not what they should be."""
        items = []
        for relative, series in zip(self._relative, self._series, strict=True):
            name = as_utf8(relative.as_posix() if relative.parts else self.raw.resolve().name)
            items.append(Item(name, series.folder, extra={"color": self._has_color, "series": series}))
        return self._table.apply(items) if self._table else items

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        """Returns the sample of one item. Raises DataError when its data are bad."""
        series = item.extra["series"]
        paths = series.paths[:: self.stride]
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
        time = series.frame_times(self.fps)[:: self.stride][kept] if self._timed else None
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
        frames = sum(len(item.extra["series"].names) for item in items)
        lines = [f"{len(items)} sequence{'s' if len(items) != 1 else ''} of {frames} frames found"]
        if not self._timed and any(one.frame_times(self.fps) is not None for one in self._series):
            lines.append("the names of some sequences' frames are no times: no times are written (--fps gives them)")
        return lines + about_series([(item.name, item.extra["series"]) for item in items])


def drop_invalid(cloud: Cloud) -> int:
    """Removes points with NaN or infinity (organized clouds mark "no return" so) in place, and returns how many there
    were.
    """
    valid = np.isfinite(cloud.points).all(1)
    if not valid.all():
        cloud.points = cloud.points[valid]
        cloud.color = None if cloud.color is None else cloud.color[valid]
    return int(len(valid) - valid.sum())
