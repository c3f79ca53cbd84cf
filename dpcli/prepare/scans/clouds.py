"""A folder of point cloud files (one sequence), or a folder of such folders (one sequence each)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.path_names import as_utf8, first_names
from dpcli.prepare.array_files.containers import SUFFIXES as CONTAINERS
from dpcli.prepare.cloud_formats.arrays import guess_bin_columns
from dpcli.prepare.cloud_formats.cloud import Cloud, without
from dpcli.prepare.decode.cloud_files import SUFFIXES, read_cloud
from dpcli.prepare.reader import Item, Sample, require_folder
from dpcli.prepare.scans.assembling import OwnScans
from dpcli.prepare.scans.cloud_series import find_sequences, refuse_file
from dpcli.prepare.scans.tables import TABLES, open_table
from dpcli.prepare.scans.times_of_tables import times_like_frames
from dpcli.prepare.scans.tracked_points import identify, with_track
from dpcli.prepare.series import Series, about_series

TIMED = (
    "column {0!r} tells times as far apart as those of frames, each for several points: if each file is a recording, give"
    " --frame-column {0!r}; as it is, each is one cloud"
)
_LISTED = 8
_LOOKED_AT = 5  # frames that tell how many columns a .bin has


@dataclass(frozen=True)
class CloudFolders(OwnScans):
    """Reads point cloud files. bin_columns: float32 values of a point in a .bin, None where the values tell; pattern: of the names
    of frames, "" for any; the rest as `OwnScans` has it.
    """

    bin_columns: int | None = None
    pattern: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.bin_columns is not None and self.bin_columns < 3:
            raise UsageError(f"--bin-columns {self.bin_columns}: expected 3 (x y z) or more")

    @property
    def fields(self) -> tuple[str, ...]:
        """Returns ``color`` among the fields when the very first frame has colors; then every frame must."""
        return self.fields_beside(time=self._timed, color=self._first[0])

    @property
    def config(self) -> dict[str, Any]:
        return {k: v for k, v in super().config.items() if k != "pattern" or self.pattern}

    def _in_folders(self) -> tuple[list[str], str]:
        layout = "CLASS/SEQUENCE" if len({len(path.parts) for path in self._relative}) > 1 else "CLASS"
        return [as_utf8(path.as_posix()) for path in self._relative], layout

    @cached_property
    def _series(self) -> list[Series]:
        refuse_file(self.raw, SUFFIXES)
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
    def _first(self) -> tuple[bool, tuple[str, ...], Path | None]:
        """Returns whether the first good cloud has colors, which of its columns are not read, and its file, None without one."""
        for one in self._series:
            try:
                clouds = ((read_cloud(path, self.bin_columns), path) for path in one.paths)
                cloud, path = next((found for found in clouds if len(found[0].points)), (None, None))
            except DataError:
                continue  # a bad sample: the next one tells
            if cloud is None:  # nothing was seen
                continue
            return cloud.color is not None, without(cloud.unread, with_track(self.keep, self.track)), path
        return False, (), None

    @cached_property
    def _times_of_first(self) -> str:
        """Returns the column of the first good cloud, of those that are not read, whose times are those of several frames."""
        _, unread, path = self._first
        if not unread or path is None or path.suffix.lower() not in (*TABLES, *CONTAINERS):
            return ""
        try:
            table = open_table(path)
            return times_like_frames(table, [name for name in unread if name in table.names])
        except DataError:  # of arrays that are no table
            return ""

    def items(self) -> list[Item]:
        color, unread, _ = self._first
        items, told = [], {"color": color, "timed": self._timed, "unread": unread}
        for relative, series in zip(self._relative, self._series, strict=True):
            name = as_utf8(relative.as_posix() if relative.parts else self.raw.resolve().name)
            items.append(Item(name, series.folder, extra={**told, "series": series}))
        return self._with_labels(items)

    def _with_labels(self, items: list[Item]) -> list[Item]:
        """Returns items with what the table says of them. Raises DataError when it names a stranger, and says so where the names
        are those of frames.
        """
        try:
            return self._table.apply(items)
        except DataError as error:
            frames = {Path(name).stem for one in self._series for name in one.names}
            if frames & {Path(name).stem for name in self._table.rows}:
                advice = "put those of each into a folder of its own, or, where each is a table of many frames, give --frame-column"
                raise DataError(f"{error}. Files of one folder are the frames of one sample: {advice}") from None
            raise

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        series = item.extra["series"]
        paths = series.paths[:: self.stride]
        columns, notes = self._bin_columns(paths)
        clouds = [read_cloud(path, columns, with_track(self.keep, self.track)) for path in paths]
        identify(item.path, clouds, self.track, self.keep)
        if item.extra["color"]:
            _require_colors(paths, clouds)
        time = series.frame_times(self.fps)[:: self.stride] if item.extra["timed"] else None
        return self._assembled(item, clouds, time, notes)

    def _bin_columns(self, paths: list[Path]) -> tuple[int | None, dict[str, int]]:
        """Returns how many columns the ``.bin`` frames of one sequence have, and a note where that had to be guessed."""
        frames = [path for path in paths if path.suffix.lower() == ".bin" and path.stat().st_size]
        if self.bin_columns or not frames:
            return self.bin_columns, {}
        columns, sure = guess_bin_columns(frames[:: max(1, len(frames) // _LOOKED_AT)][:_LOOKED_AT])
        doubt = "" if sure else ", though other numbers fit as well"
        note = f"sequences of .bin read as {columns} float32 a point, judged by their values{doubt} (--bin-columns says it)"
        return columns, {} if columns == 4 and sure else {note: 1}

    def summary(self, items: list[Item]) -> list[str]:
        frames = sum(len(item.extra["series"].names) for item in items)
        lines = [f"{counted(len(items), 'sequence')} of {counted(frames, 'frame')} found"]
        if self._first[1]:
            lines[0] += f"; not read: {first_names(self._first[1], _LISTED)}"
            lines[0] += "" if "no name" in self._first[1][0] else " (--keep-fields)"
        if self._times_of_first:
            lines.append(TIMED.format(self._times_of_first))
        if not self._timed and any(one.frame_times(self.fps) is not None for one in self._series):
            lines.append("the names of some sequences' frames are no times: no times are written (--fps gives them)")
        labels = [item.label for item in items]
        if self.label_from_folder and 1 < len(labels) == len(set(labels)) and frames > len(items):
            lines.append(
                "each class has one sequence only, whose frames are the files of its folder; if each file is a recording of its own,"
                " put it into a folder of its own (CLASS/SEQUENCE/frames), or give --frame-column where it is a table of frames"
            )
        lines += about_series([(item.name, item.extra["series"]) for item in items])
        return lines + self._table.unnamed(items)


def _require_colors(paths: list[Path], clouds: list[Cloud]) -> None:
    plain = [path for path, cloud in zip(paths, clouds, strict=True) if cloud.color is None and len(cloud.points)]
    if plain:
        raise DataError(
            f"{plain[0]}: no colors, though the first frame of all has them; expected the same fields throughout"
        )
