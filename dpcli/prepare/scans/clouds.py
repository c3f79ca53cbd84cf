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
from dpcli.prepare.cloud_formats.arrays import guess_bin_columns
from dpcli.prepare.cloud_formats.cloud import Cloud
from dpcli.prepare.decode.cloud_files import SUFFIXES, read_cloud
from dpcli.prepare.labels import LabelTable, labels_of_folders, read_labels
from dpcli.prepare.reader import Item, Sample, natural_key, require_folder
from dpcli.prepare.scans.assembling import Lengths, assemble
from dpcli.store.schema import KEPT

_LOOKED_AT = 5  # frames that tell how many columns a .bin has


@dataclass(frozen=True)
class CloudFolders:
    """Reads point cloud files. ``scale``: input units per unit of length in the output; ``keep``: further columns."""

    raw: Path
    bin_columns: int | None = None
    scale: float | None = None
    unit: str = "m"
    fps: float | None = None
    stride: int = 1
    label_from_folder: bool = False
    labels: Path | None = None
    keep: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.labels and self.label_from_folder:
            raise UsageError("--labels and --label-from-folder were both given; use one")
        if self.fps is not None and not self.fps > 0:
            raise UsageError("--scale and --fps must be more than 0")
        if self.bin_columns is not None and self.bin_columns < 3:
            raise UsageError(f"--bin-columns {self.bin_columns}: expected 3 (x y z) or more")
        Lengths(self.scale, self.unit)

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
        kept = tuple(f"{KEPT}{name}" for name in self.keep)
        return (("time",) if self.fps else ()) + (("color",) if self._has_color else ()) + kept

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
        columns, notes = self._bin_columns(paths)
        clouds = [read_cloud(path, columns, self.keep) for path in paths]
        if item.extra["color"]:
            _require_colors(paths, clouds)
        time = np.arange(len(paths)) * self.stride / self.fps if self.fps else None
        sample = assemble(item, clouds, Lengths(self.scale, self.unit), color=item.extra["color"], time=time)
        sample.notes |= notes
        return sample

    def _bin_columns(self, paths: list[Path]) -> tuple[int | None, dict[str, int]]:
        """Returns how many columns the ``.bin`` frames of one sequence have, and a note where that had to be guessed."""
        frames = [path for path in paths if path.suffix.lower() == ".bin" and path.stat().st_size]
        if self.bin_columns or not frames:
            return self.bin_columns, {}
        columns, sure = guess_bin_columns(frames[:: max(1, len(frames) // _LOOKED_AT)][:_LOOKED_AT])
        doubt = "" if sure else ", though other numbers fit as well"
        note = f"sequences of .bin read as {columns} float32 a point, by their look{doubt} (--bin-columns says it)"
        return columns, {} if columns == 4 and sure else {note: 1}

    def summary(self, items: list[Item]) -> list[str]:
        """Returns lines for the log about what the index holds and lacks."""
        frames = sum(len(frame_paths(item.path)) for item in items)
        return [f"{len(items)} sequence{'s' if len(items) != 1 else ''} of {frames} frames found"]


def _require_colors(paths: list[Path], clouds: list[Cloud]) -> None:
    plain = [path for path, cloud in zip(paths, clouds, strict=True) if cloud.color is None]
    if plain:
        raise DataError(
            f"{plain[0]}: no colors, though the first frame of all has them; expected the same fields throughout"
        )


def is_cloud(name: str) -> bool:
    """Returns whether a file name looks like a point cloud."""
    return name.lower().endswith(SUFFIXES) and not name.startswith(".")


def frame_paths(folder: Path) -> list[Path]:
    """Returns the point clouds directly in a folder, in natural order."""
    return sorted((p for p in folder.iterdir() if is_cloud(p.name) and p.is_file()), key=natural_key)
