"""Identities of points across frames: a column that names them, the rows of every frame, or the tracks of a views file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.path_names import as_utf8
from dpcli.prepare.cloud_formats.cloud import Cloud
from dpcli.prepare.cloud_formats.column_names import Table
from dpcli.prepare.reader import Item, Sample, describe
from dpcli.prepare.scans.assembling import OwnScans
from dpcli.store import CloudSequence
from dpcli.store.views import ViewsReader

ROWS = "rows"
_WRAP = 1 << 64  # whole numbers of as many bits, with a sign or without, stay apart


def with_track(keep: tuple[str, ...], track: str) -> tuple[str, ...]:
    """Returns the columns to read: those to keep, and the one that names the points.

    >>> with_track(("intensity",), "id"), with_track((), "rows")
    (('intensity', 'id'), ())
    """
    return keep if track in ("", ROWS, *keep) else (*keep, track)


def identify(path: Path, clouds: Sequence[Cloud], track: str, keep: tuple[str, ...]) -> None:
    """Gives the points of one sequence's frames, as they were read and before any is left out, their identities, in place.

    track: "" for none, ``rows`` where every frame lists the same points in the same order, else the name of a column of
    whole numbers, which every cloud has among its ``extra``; it stays there only if ``keep`` names it. Raises DataError
    where the frames can't be what ``track`` says.
    """
    if track == ROWS:
        lost = next((reason for cloud in clouds for reason in cloud.dropped if reason.endswith("dropped")), "")
        counts = sorted({len(cloud.points) for cloud in clouds})
        if lost or len(counts) > 1:
            why = f"reading left some out ({lost})" if lost else f"its frames have {counts[0]} to {counts[-1]} points"
            raise DataError(
                f"{path}: --track rows: expected the same points in the same order in every frame, but {why}"
            )
        for cloud in clouds:
            cloud.track = np.arange(len(cloud.points))
    elif track:
        for cloud in clouds:
            cloud.track = _whole(path, track, cloud.extra[track])
            cloud.extra = {name: values for name, values in cloud.extra.items() if name in keep}


def name_rows(table: Table, track: str) -> np.ndarray:
    """Returns the identity i64 (N) of each row of a table by one of its columns: whole numbers as they are, words numbered."""
    if track not in table.names:
        raise DataError(
            f"{table.path}: --track {track}: no such column; found {', '.join(table.names)[:200] or 'no names'}"
        )
    place = table.names.index(track)
    try:
        values = table.columns([place])[:, 0]
    except DataError:
        return _numbered(table.path, track, table.words(place))
    if not np.isfinite(values).all() or np.abs(values).max(initial=0) < _exact_below(values.dtype):
        return _whole(table.path, track, values)
    try:  # as they are written: the numbers are rounded
        whole = [int(word) % _WRAP for word in table.words(place)]
    except ValueError:
        return _whole(table.path, track, values)
    return np.array(whole, np.uint64).astype(np.int64)


def _numbered(path: Path, track: str, words: list[str]) -> np.ndarray:
    """Returns a number i64 (N) for each word, the same for the same. Raises DataError where one is missing, or a number."""
    known = dict.fromkeys(words)
    name = next((word for word in known if word and not _is_number(word)), "")
    for word in known:
        if not word or _is_number(word):
            raise DataError(
                f"{path}: --track {track}: expected whole numbers or names, one for every point; found {word!r} beside {name!r}"
            )
    return np.unique(np.array(words), return_inverse=True)[1].reshape(-1)


def _whole(path: Path, track: str, values: np.ndarray) -> np.ndarray:
    """Returns numbers as identities i64 (N). Raises DataError where some are no whole ones, or may have been rounded to them."""
    if values.dtype.kind in "iub":
        return values.astype(np.int64)  # the greatest of 64 bits become negative, and stay apart
    if not np.isfinite(values).all() or (values != np.floor(values)).any():
        raise DataError(f"{path}: --track {track}: expected a whole number for every point, the same in every frame")
    limit, most = _exact_below(values.dtype), float(np.abs(values).max(initial=0))
    if most >= limit:
        raise DataError(
            f"{path}: --track {track}: numbers up to {most:.0f} read as {values.dtype}, which doesn't tell whole numbers beyond"
            f" {limit} apart; write smaller ones, or a column of integers"
        )
    return values.astype(np.int64)


def _exact_below(kind: np.dtype) -> int:
    """Returns the number up to which a type of floats holds all whole ones.

    >>> _exact_below(np.dtype("float32")), _exact_below(np.dtype("float64"))
    (16777216, 9007199254740992)
    """
    return int(2 ** (np.finfo(kind).nmant + 1))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


@dataclass(frozen=True)
class TrackedViews(OwnScans):
    """Reads the true tracks of a `views` file, such as of an animated mesh, as a cloud of M points in every frame, with their
    identities and parts; the options are those of `OwnScans`. Lengths are the views file's.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.keep or self.label_from_folder or self.track not in ("", ROWS):
            raise UsageError(
                f"{self.raw}: holds views and their true tracks; leave out --keep-fields, --label-from-folder, --track"
            )

    @cached_property
    def fields(self) -> tuple[str, ...]:
        with ViewsReader(self.raw) as views:
            return ("time", *views.fields)

    @property
    def length_unit(self) -> str:
        """Returns the unit that the options name, where one of them is given; else the views file's, "" where it tells none."""
        with ViewsReader(self.raw) as views:
            return self.unit if self.unit != "m" or self.scale is not None else views.header.length_unit

    @property
    def history(self) -> list[dict[str, Any]]:
        with ViewsReader(self.raw) as views:
            return views.provenance

    def items(self) -> list[Item]:
        """Returns the one sample, named as the views are. Raises DataError where they have no tracks."""
        with ViewsReader(self.raw) as views:
            if "track" not in views.fields:
                raise DataError(
                    f"{self.raw}: views without true tracks, from which no clouds can be made; `dpc generate4d fit` makes a"
                    " scene of them, and `dpc generate4d export --as clouds` its clouds"
                )
            items = [Item(as_utf8(views.header.name), self.raw)]
        return self._table.apply(items)

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        with ViewsReader(item.path) as views:
            track, part = views.track[:: self.stride], views.part
            time = views.header.time[:: self.stride]
        frames, points = track.shape[:2]
        sequence = CloudSequence(
            item.name,
            (track.reshape(-1, 3) / (self.scale or 1.0)).astype(np.float32),
            np.arange(frames + 1, dtype=np.int64) * points,
            time=np.arange(frames) * self.stride / self.fps if self.fps else time,
            track=np.tile(np.arange(points), frames),
            part=None if part is None else np.tile(part, frames),
            **describe(item),
        )
        return Sample(sequence)

    def summary(self, items: list[Item]) -> list[str]:
        with ViewsReader(self.raw) as views:
            frames, points = views.track.shape[:2]
        return [f"the true tracks of {counted(points, 'point')} in {counted(frames, 'frame')} of views"]
