"""Tables of segments: which action each stretch of a recording shows, as CSV, or as JSON with provenance.

Both hold, for each recording, `start` (first frame, from 0), `end` (one past the last), `class` (empty: nothing) and,
where they were predicted, `confidence`, and where the recording has times `start_seconds` and `end_seconds`, those of
the first and the last frame.
"""

from __future__ import annotations

import csv
import io
import json
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.text_files import decode_text, parse_json

SUFFIXES = (".csv", ".json")  # of the files
_NEEDED = ("recording", "start", "end", "class")
_COLUMNS = (*_NEEDED, "confidence", "start_seconds", "end_seconds")
_MOST_FRAMES = 20_000_000  # of a recording: a week at 30 a second; a damaged number must not ask for all memory


@dataclass(frozen=True)
class Segment:
    """Holds the frames `start` to `end` (one past the last) and their class, "" for nothing; confidence: NaN = unknown.

    seconds: of its first and last frame, where the recording has times.
    """

    start: int
    end: int
    name: str
    confidence: float = float("nan")
    seconds: tuple[float, float] | None = None


@dataclass
class Segments:
    """Holds the segments of recordings by name, in order and without overlap, and what made them."""

    recordings: dict[str, list[Segment]]
    class_names: list[str] = field(default_factory=list)
    provenance: list[dict[str, Any]] = field(default_factory=list)


def segments_text(found: Segments, suffix: str) -> str:
    """Returns the segments as a file of that suffix holds them, `.csv` or `.json`."""
    rows = [_row(name, one) for name, own in found.recordings.items() for one in own]
    if suffix == ".json":
        whole = {"kind": "segments", "class_names": found.class_names, "provenance": found.provenance, "segments": rows}
        return json.dumps(whole, indent=1, allow_nan=False) + "\n"
    columns = [name for name in _COLUMNS if name in _NEEDED or any(name in row for row in rows)]
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _row(recording: str, one: Segment) -> dict[str, Any]:
    row: dict[str, Any] = {"recording": recording, "start": one.start, "end": one.end, "class": one.name}
    if np.isfinite(one.confidence):
        row["confidence"] = round(one.confidence, 4)
    if one.seconds is not None:
        row |= {"start_seconds": round(one.seconds[0], 4), "end_seconds": round(one.seconds[1], 4)}
    return row


def read_segments(path: str | Path, text: str | None = None) -> Segments:
    """Returns the segments of a table, sorted. text: what it holds, where it was read already.

    Raises DataError, which names the line or entry, for a table without the columns `recording,start,end,class`, a frame
    that is no whole number from 0 up, an end that is not behind its start, and segments that overlap.
    """
    if text is None:
        text = _text_of(Path(path))
    about: Mapping[str, Any] = {}
    if text.lstrip().startswith("{"):
        about = _json_of(path, text)
        rows = [(f"entry {number}", row) for number, row in enumerate(about.get("segments", []))]
    else:
        rows = _csv_rows(path, text)
    recordings: dict[str, list[Segment]] = {}
    for where, row in rows:
        name, segment = _parsed(f"{path}: {where}", row)
        recordings.setdefault(name, []).append(segment)
    if not recordings:
        raise DataError(f"{path}: holds no segment")
    for name, own in recordings.items():
        own.sort(key=lambda one: one.start)
        _check_overlap(path, name, own)
    return Segments(recordings, list(about.get("class_names", [])), list(about.get("provenance", [])))


def _text_of(path: Path) -> str:
    try:
        text = decode_text(path)
        if "\0" in text:
            raise UnicodeError
        return text
    except (DataError, UnicodeError):
        raise DataError(f"{path}: no text; expected segments as .csv or .json") from None
    except OSError as error:
        raise DataError(f"{path}: can't be read ({error.strerror})") from None


def _json_of(path: str | Path, text: str) -> Mapping[str, Any]:
    found = parse_json(text, path)
    rows = found.get("segments") if isinstance(found, dict) and found.get("kind") == "segments" else None
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise DataError(f"{path}: no segments; expected what `dpc classify predict --segments` writes")
    for key, kind in (("class_names", str), ("provenance", dict)):
        told = found.get(key, [])
        if not isinstance(told, list) or not all(isinstance(one, kind) for one in told):
            raise DataError(f"{path}: {key} is {told!r:.80}, expected what `dpc classify predict --segments` writes")
    return found


def _csv_rows(path: str | Path, text: str) -> list[tuple[str, Mapping[str, Any]]]:
    """Returns the rows of a CSV table, divided by commas, semicolons or tabs, each with its line in words."""
    first = text.partition("\n")[0]
    divider = next((mark for mark in ",;\t" if mark in first), ",")
    reader = csv.DictReader(io.StringIO(text), delimiter=divider, skipinitialspace=True)
    try:
        columns = [name.strip().lower() for name in reader.fieldnames or []]
        _check_columns(path, columns)
        reader.fieldnames = columns
        rows = [(f"line {reader.line_num}", row) for row in reader]
    except csv.Error as error:
        raise DataError(f"{path}: line {reader.line_num}: damaged CSV ({error})") from None
    for where, row in rows:
        if any(row.pop(None, [])):  # type: ignore[call-overload]  # cells behind the last column
            raise DataError(f"{path}: {where}: more cells than the {len(columns)} columns; quote a class with a comma")
    return rows


def _check_columns(path: str | Path, columns: Sequence[str]) -> None:
    missing = [name for name in _NEEDED if name not in columns]
    if missing:
        raise DataError(
            f"{path}: no column {missing[0]!r}; expected a first line with {','.join(_NEEDED)} (it has "
            f"{','.join(columns)[:80] or 'none'})"
        )
    twice = next((name for name in columns if name in _COLUMNS and columns.count(name) > 1), None)
    if twice:
        raise DataError(f"{path}: two columns {twice!r}; leave one of them out, or call it otherwise")


def _parsed(where: str, row: Mapping[str, Any]) -> tuple[str, Segment]:
    """Returns the recording and the segment of a row. Raises DataError where it can't be one."""
    name, title = row.get("recording"), row.get("class")
    start, end = (_whole(where, key, row.get(key)) for key in ("start", "end"))
    if not isinstance(name, str) or not name or not isinstance(title, str):
        raise DataError(f"{where}: recording {name!r}, class {title!r}; expected a name, and a class that may be empty")
    if end <= start:
        raise DataError(
            f"{where}: ends at {end}, which is not after its start {start}; `end` is one past the last frame"
        )
    try:
        given = row.get("confidence")
        confidence = float("nan" if given in (None, "") else given)
    except (TypeError, ValueError, OverflowError):
        raise DataError(f"{where}: confidence {given!r}; expected a number") from None
    name, title = (unicodedata.normalize("NFC", text) for text in (name, title.strip()))  # as macOS takes them apart
    return name, Segment(start, end, title, confidence)


def _whole(where: str, key: str, value: Any) -> int:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = float("nan")
    if isinstance(value, bool) or not 0 <= number < _MOST_FRAMES or number != int(number):
        raise DataError(
            f"{where}: {key} {value!r}; expected a frame's number, whole and from 0 to {_MOST_FRAMES:,} (of seconds: times the frame"
            " rate)"
        )
    return int(number)


def _check_overlap(path: str | Path, name: str, own: Sequence[Segment]) -> None:
    for one, following in zip(own, own[1:]):
        if following.start < one.end:
            raise DataError(
                f"{path}: {name}: frames {one.start} to {one.end} ({one.name or 'nothing'}) and {following.start} to "
                f"{following.end} ({following.name or 'nothing'}) overlap; a frame has one class"
            )
