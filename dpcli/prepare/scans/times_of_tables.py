"""Times that columns of tables tell: seconds and their parts, dates, times of day, durations, in units that names say."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import partial

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.column_names import SECONDS, Table, seconds_in_brackets, words_of
from dpcli.runtime.clips.name_numbers import is_ticks

_EPOCHS = {10: 1.0, 13: 1e-3, 16: 1e-6, 18: 1e-9, 19: 1e-9}  # digits of a time since 1970 -> seconds
SHORTEST = 1e-4  # seconds between frames: what is shorter are days, or times of points
_APART = 5e-3  # seconds between frames whose points share a time
_LONGEST = 1000.0  # seconds between frames: what seems longer was counted from another moment, in another unit
_TIME_WORDS = frozenset(
    "time timestamp stamp t timestamps epoch utc ts datetime date posix zeit zeitstempel uhrzeit datum heure hora fecha".split()
)
_NO_UNITS = _TIME_WORDS | {"gps", "unix", "posix", "local", "sensor", "since", "start"}
_SEVERAL = re.compile(r"[\[(]\s*([\d.]+)\s*([^\W\d]+)\s*[\])]\s*$")  # such as [100 ns]
_BRACKETS = re.compile(r"[\[(]([^\])]*)[\])]?\s*$")
_CLOCK = re.compile(
    r"(?:(\d{4})[-/](\d\d?)[-/](\d\d?)[T _]\s*|(-?\d+) days?,? \+?)?"  # a date, or a number of days
    r"(\d\d?):(\d\d):(\d\d)([.,]\d{1,9})?\s*(?:([AP])\.?M\.?)?\s*(Z|UTC|[-+]\d\d:?\d\d)?",
    re.IGNORECASE,
)
_DIGITS = re.compile(r"(\d{14})(\d{3})?(?:\.(\d*))?")  # year to second, milliseconds, a fraction
_DAY_FIRST = re.compile(r"^(\d\d?)\.(\d\d?)\.(\d{4})")  # with points the day stands first
_DAY = 86_400.0
_TICK = 1e-7
_DAYS = ((36_526, 54_788), (730_486, 748_749))  # 2000 to 2050 as spreadsheets and as MATLAB count days
_FASTEST = 0.002  # seconds between frames: smaller steps of such numbers are days
_BEYOND = 5  # steps that may be missing where a minute ends; as many would lie between its 60th and 100th second


@dataclass(frozen=True)
class Clock:
    """Holds the seconds f64 (N) of each row of a table, as columns told them that don't number the frames: one, or one of
    seconds and one of their parts.
    """

    columns: tuple[str, ...]
    seconds: np.ndarray


def seconds_of(column: str, values: np.ndarray) -> float:
    """Returns how many seconds one unit of a column is that holds times; 0 where its values f64 (T) count frames, or the unit
    isn't known.

    >>> seconds_of("frame", np.array([1.0, 2.0])), seconds_of("t_ms", np.array([0.0, 33.0]))
    (0.0, 0.001)
    >>> seconds_of("t [ticks]", np.array([0.5, 1.0])), seconds_of("t [µs]", np.array([0.5, 1.0]))
    (0.0, 1e-06)
    """
    words = words_of(column)
    if several := _SEVERAL.search(column):
        size, unit = several[1], " ".join(words_of(several[2]))
        return float(size) * SECONDS.get(unit, 0.0) if re.fullmatch(r"\d+(\.\d+)?", size) else 0.0
    if len(words) > 1 and words[-1] in SECONDS:
        return SECONDS[words[-1]]
    if set(words) & _TIME_WORDS and (inside := _BRACKETS.search(column)):
        told = words_of(inside[1])
        if not set(told) <= _NO_UNITS:
            return seconds_in_brackets(" ".join(told))
    digits = {len(str(int(abs(value)))) for value in values[[0, -1]]}
    epoch = _EPOCHS.get(digits.pop(), 0.0) if len(digits) == 1 else 0.0
    epoch = _TICK if epoch and all(is_ticks(int(value)) for value in values[[0, -1]]) else epoch
    if not (values == np.floor(values)).all():
        return epoch or 1.0  # milliseconds since 1970 may have fractions
    unit = epoch if set(words) & _TIME_WORDS else 0.0
    steps = np.diff(np.unique(values)) if unit else values[:0]
    return 0.0 if len(steps) and float(np.median(steps)) * unit > _LONGEST else unit


def calendar_seconds(column: str, values: np.ndarray, written: Callable[[], Sequence[str]]) -> np.ndarray | None:
    """Returns the seconds f64 (N) of a column of times whose numbers f64 (N) are written as digits of dates (20240305143057.25),
    as hours, minutes and seconds (143057.25), or as days (of spreadsheets, of MATLAB); None where they are nothing of these.

    written: gives the numbers as they are written; of dates a float keeps steps of 4 milliseconds alone.

    >>> calendar_seconds("utc", np.array([143059.5, 143100.0]), list) is None  # two frames are too few to tell
    True
    >>> dates = ["20240305143059.501", "20240305143100"]
    >>> calendar_seconds("time", np.array(dates, float), lambda: dates).tolist()
    [1709649059.501, 1709649060.0]
    """
    words = set(words_of(column))
    if not words & _TIME_WORDS or not words <= _NO_UNITS or not len(values) or not np.isfinite(values).all():
        return None
    least, most = float(values.min()), float(values.max())
    if 1.9e13 < least <= most < 2.1e13 or 1.9e16 < least <= most < 2.1e16:
        return _of_digits(written(), values)
    steps = np.diff(np.unique(values))
    step = float(np.median(steps)) if len(steps) else 0.0
    fractions = bool((values != np.floor(values)).any())
    if fractions and 0 < step < _FASTEST and any(first <= least <= most < last for first, last in _DAYS):
        return values * _DAY
    if most < 240_000 and 0 < step * _BEYOND < 40 and (values % 100 < 60).all() and (values % 10_000 < 6000).all():
        seconds = values // 10_000 * 3600 + values % 10_000 // 100 * 60 + values % 100
        over = np.diff(np.unique(values // 100)) > 0
        jumps, told = steps[steps >= 40], np.diff(np.unique(seconds))[steps >= 40]
        return seconds if over.any() and len(jumps) == len(over) and (told <= _BEYOND * step).all() else None
    return None


def _of_digits(words: Sequence[str], values: np.ndarray) -> np.ndarray | None:
    """Returns the seconds since 1970, f64 (N), of numbers whose digits are year, month, day, hour, minute and second; by the
    numbers' values f64 (N) where their words are no plain digits, such as 2.0240305143059500e+13.
    """
    found = [_DIGITS.fullmatch(word.strip()) for word in words]
    if not all(found):
        found = [_DIGITS.fullmatch(f"{value:.3f}") for value in values]
    whole = np.array([match[1] for match in found], np.int64)
    fraction = np.array([f"0.{match[2] or ''}{match[3] or ''}" for match in found], np.float64)
    known, own = np.unique(whole // 1_000_000, return_inverse=True)
    try:
        days = [
            datetime(day // 10_000, day // 100 % 100, day % 100, tzinfo=timezone.utc).timestamp()
            for day in known.tolist()
        ]
    except ValueError:  # such as a month 13
        return None
    clock = whole % 1_000_000
    if not ((clock < 240_000) & (clock % 10_000 < 6000) & (clock % 100 < 60)).all():
        return None
    return np.array(days)[own] + clock // 10_000 * 3600 + clock % 10_000 // 100 * 60 + clock % 100 + fraction


def unit_by_rate(column: str, values: np.ndarray, fps: float) -> float:
    """Returns how many seconds one unit of a column of rising times in whole numbers is, if one makes its steps those of
    ``fps``; else 0.

    >>> unit_by_rate("time", np.array([0, 33, 67, 100]), 30), unit_by_rate("t", np.array([0, 1, 2, 5]), 30)
    (0.001, 0.0)
    """
    if not set(words_of(column)) & _TIME_WORDS or len(values) < 2:
        return 0.0
    step = float(np.median(np.diff(values))) * fps
    return next((unit for unit in (1e-3, 1e-6, 1e-9) if 0.5 < step * unit < 2), 0.0)


def find_clocks(table: Table, names: Sequence[str]) -> list[Clock]:
    """Returns the times that some of the columns ``names`` tell, in seconds or of a unit in the column's name."""
    found = []
    for name in names:
        if clock := seconds_and_parts(table, name):
            found.append(clock)
        elif set(words_of(name)) & _TIME_WORDS and (clock := _one_column(table, name)):
            found.append(clock)
    return found


def times_like_frames(table: Table, names: Sequence[str]) -> str:
    """Returns the first of the columns ``names`` that tells times which never fall, of several rows each and as far apart as
    frames are; "" without one. Those of a turning lidar's points are microseconds apart.
    """
    for clock in find_clocks(table, names):
        steps = np.diff(clock.seconds)
        apart = steps[steps != 0]
        if len(apart) and apart.min() >= _APART and 2 * (len(apart) + 1) <= len(clock.seconds):
            return clock.columns[0]
    return ""


def seconds_and_parts(table: Table, name: str) -> Clock | None:
    """Returns the clock of a column of whole seconds beside which another, called alike, holds their parts, as
    ``stamp.sec`` and ``stamp.nanosec``; None without it.
    """
    words = words_of(name)
    if not words or SECONDS.get(words[-1]) != 1:
        return None
    for other in table.names:
        *rest, unit = words_of(other) or [""]
        if rest != words[:-1] or SECONDS.get(unit, 1) >= 1:
            continue
        try:
            values = table.columns([table.names.index(name), table.names.index(other)])
        except DataError:
            continue
        seconds, parts = values[:, 0], values[:, 1] * SECONDS[unit]
        if len(values) and (seconds == np.floor(seconds)).all() and ((parts >= 0) & (parts < 1)).all():
            return Clock((name, other), seconds - seconds[0] + parts)
    return None


def _one_column(table: Table, name: str) -> Clock | None:
    place = table.names.index(name)
    seconds = table.moments(place)
    if seconds is None:
        try:
            values = table.columns([place])[:, 0]
        except DataError:
            seconds = np.array(clock_seconds(table.words(place)))
        else:
            told = calendar_seconds(name, values, partial(table.words, place))
            unit = seconds_of(name, values) if told is None and len(values) and np.isfinite(values).all() else 0.0
            seconds = told if told is not None else (values - values[0]) * unit if unit else values[:0]
    return Clock((name,), seconds) if len(seconds) and np.isfinite(seconds).all() else None


def clock_seconds(words: Sequence[str]) -> list[float]:
    """Returns the seconds of dates with times of day, or of times of day alone, which may pass midnight; [] of other words.

    >>> clock_seconds(["23:59:59.5", "00:00:00"]), clock_seconds(["1 days 00:00:01"]), clock_seconds(["a"])
    ([86399.5, 86400.0], [86401.0], [])
    >>> clock_seconds(["-1 days +23:59:59.5", "0 days 00:00:01"])  # as pandas writes a duration below 0
    [-0.5, 1.0]
    >>> clock_seconds(["31.12.2023 23:59:59", "01.01.2024 00:00:01"])
    [1704067199.0, 1704067201.0]
    >>> clock_seconds(["11:59:59 AM", "12:00:01 PM", "1:00:00 PM"])
    [43199.0, 43201.0, 46800.0]
    """
    found: list[float] = []
    days = 0
    for word in words:
        match = _CLOCK.fullmatch(_DAY_FIRST.sub(r"\3-\2-\1", word.strip()))
        try:
            seconds = _seconds_told(match) if match else None
        except ValueError:  # such as a month 13
            seconds = None
        if match is None or seconds is None:
            return []
        if match[1] is None and match[4] is None:
            days += bool(found) and seconds + days * _DAY < found[-1] - _DAY / 2
        found.append(seconds + days * _DAY)
    return found


def _seconds_told(match: re.Match[str]) -> float:
    year, month, day, days, hour, minute, second, fraction, half, zone = match.groups()
    hours = int(hour) % 12 + 12 * (half in "Pp") if half else int(hour)
    own = hours * 3600 + int(minute) * 60 + int(second) + float((fraction or ".0").replace(",", "."))
    if year is None:
        return own + int(days or 0) * _DAY
    return datetime(int(year), int(month), int(day), tzinfo=timezone.utc).timestamp() + own - _offset(zone)


def _offset(zone: str | None) -> float:
    """Returns the seconds by which a zone such as ``+02:00`` is ahead."""
    if not zone or zone[0] not in "+-":
        return 0.0
    ahead = int(zone[1:3]) * 3600 + int(zone[-2:]) * 60
    return float(-ahead if zone[0] == "-" else ahead)
