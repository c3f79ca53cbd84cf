"""Numbers in the names of frames: which run, which are times, and the order they put files in."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from decimal import Decimal
from functools import lru_cache
from os.path import splitext
from pathlib import Path
from typing import Any
from unicodedata import normalize

import numpy as np

from dpcli.runtime.progress import log

_DATE = re.compile(
    r"((?:19|20)\d\d)[-_.]?([01]\d)[-_.]?([0-3]\d)[T _-]{1,2}([0-2]\d)[-_.:hH]?([0-5]\d)[-_.:mM]?([0-6]\d)(?:([.,_-])(\d{1,9})(?!\d))?"
    r"(?:\+([01]\d):?([0-5]\d)(?!\d))?"  # ahead of Greenwich; behind a minus other numbers may stand
)
_YEAR_LAST = re.compile(
    r"([0-3]\d)[-_.]([0-3]\d)[-_.]((?:19|20)\d\d)[T _-]{1,2}([0-2]\d)[-_.:hH]?([0-5]\d)[-_.:mM]?([0-6]\d)(?:[.,_](\d{1,9})(?!\d))?"
)
# since 1970, and their parts
_SECONDS = re.compile(r"(?<!\d)([12]\d{9})(?:\.(\d{1,9})|_(\d{6}|[1-9]\d{6,7}|\d{9}))(?!\d)")
_PARTED = re.compile(r"(?<!\d)([12]\d{9})([_-])(\d{1,9})(?!\d)")  # the same, of any length
_MICROSECONDS, _NANOSECONDS = 6, 9  # digits of the parts
_TICK_PLACES = 7
_SHORTEST = 1e-4  # seconds between frames: what is shorter was counted, not timed
_HALF_DAY = re.compile(r"\d[.:_-]\d\d[ _.-]?[ap]\.?m(?![a-z])", re.IGNORECASE)  # a time before or after noon
_TIME_OF_DAY = re.compile(r"(?<!\d)([01]\d|2[0-3])([-_.:h])([0-5]\d)\2([0-5]\d)(?!\d)")
_HALF_A_DAY = 720  # minutes
_SAID: set[str] = set()
_NUMBER = re.compile(r"\d+(?:\.\d+)?")
_NOTHING = Decimal(0)
_OF_DATA_SETS = (  # names whose second number tells times, and its decimal places: ARKitScenes, Redwood's scans
    (re.compile(r"\d{8}_\d+\.\d{3}"), 0),
    (re.compile(r"\d{7}-\d{12}"), _MICROSECONDS),
)
_EPOCHS = ((10, 0), (13, 3), (16, 6), (19, 9), (18, 9))  # digits of a time since 1970, or GPS's 1980 -> decimal places


@dataclass(frozen=True)
class Name:
    """Holds a file name taken apart: the parts between its numbers (one more than these), and the numbers as written.

    A date with its time of day counts as one number, that of its seconds since 1970; ``spelled`` has it as it stands there.
    """

    text: str
    parts: tuple[str, ...]
    suffix: str
    numbers: tuple[str, ...]
    is_time: tuple[bool, ...]
    spelled: tuple[str, ...] = ()

    @property
    def shape(self) -> str:
        """Returns the name without suffix, in small letters that are composed alike, with ``*`` for every number."""
        shape = "*".join(self.parts)
        return (shape if shape.isascii() else normalize("NFC", shape)).casefold()


def is_ticks(number: int) -> bool:
    """Returns whether a number counts tenths of microseconds since the year 1 (.NET) or 1601 (Windows), and means a moment
    from 2000 to 2050.

    >>> is_ticks(638452458000000000), is_ticks(133531434000000000), is_ticks(1700000000000000000)
    (True, True, False)
    """
    return 630 <= number // 10**15 <= 646 or 126 <= number // 10**15 <= 141


def parse_names(texts: Sequence[str]) -> list[Name]:
    """Returns the names of one folder taken apart, because one alone doesn't tell what its parts of a second are.

    Behind seconds or dates, digits of several lengths lack leading zeros: they count milli-, micro- or nanoseconds by
    the longest. Numbers that go on by 1 from name to name count frames.

    >>> [name.numbers for name in parse_names(["1700000000_5.png", "1700000000_120000000.png"])]
    [('1700000000.000000005',), ('1700000000.120000000',)]
    """
    places = _places(texts)
    return [parse_name(text, places) for text in texts]


def _places(texts: Sequence[str]) -> int | None:
    """Returns how many digits the parts of a second have in names of one folder; 0: what looks like parts counts frames;
    None: as they are written.
    """
    found = []
    for text in texts:
        stem = splitext(text)[0]
        match = _PARTED.search(stem)
        if match is None and (date := _DATE.search(stem)) and date[7] in ("_", "-"):
            match = date
        if match:
            groups = match.groups()
            whole, own = (groups[0], groups[2]) if match.re is _PARTED else ("".join(map(str, groups[:6])), groups[7])
            found.append((int(whole), int(own), len(own), match.re is _PARTED))
    if len(found) < 2:
        return None
    found.sort()
    lengths = {length for _, _, length, _ in found}
    if all(b[1] - a[1] == 1 for a, b in zip(found, found[1:])):
        return 0
    within = [b[1] - a[1] for a, b in zip(found, found[1:]) if a[0] == b[0]]
    if (within and set(within) == {1}) or len({joined for *_, joined in found}) > 1:
        return None  # frames of several recordings
    longest = max(lengths)
    falls = any(b[1] < a[1] for a, b in zip(found, found[1:]))
    if len(lengths) == 1 and not (falls and longest in (3, _NANOSECONDS)):
        return None
    return 3 if longest <= 3 else _MICROSECONDS if longest <= _MICROSECONDS else _NANOSECONDS


@lru_cache(maxsize=1 << 16)  # a name is asked for its order, its number and its time
def parse_name(text: str, places: int | None = None) -> Name:
    """Returns a file's name taken apart. places: digits of the parts of a second, as `parse_names` finds them.

    >>> parse_name("frame-000012.depth.png").shape, parse_name("scan_3.25.ply").numbers
    ('frame-*.depth', ('3.25',))
    """
    stem, suffix = splitext(text)
    parts, numbers, is_time, spelled, end = [], [], [], [], 0
    while end < len(stem):
        match, written, timed = _next_number(stem, end, places)
        if match is None:
            break
        parts.append(stem[end : match.start()])
        numbers.append(written)
        is_time.append(timed)
        spelled.append(match[0])
        end = match.end()
    return Name(text, (*parts, stem[end:]), suffix.lower(), tuple(numbers), tuple(is_time), tuple(spelled))


def _next_number(stem: str, start: int, places: int | None) -> tuple[re.Match[str] | None, str, bool]:
    """Returns the first number from ``start`` on, how it is written as one, and whether it is a date or seconds and parts."""
    plain = _NUMBER.search(stem, start)
    if plain is None:
        return None, "", False
    digits = len(plain[0])
    if digits >= 4 and (date := _DATE.match(stem, plain.start())):
        *moment, sign, own, hours, minutes = date.groups()
        seconds = _since_1970(*moment, _filled(own, places) if sign in ("_", "-") else own, hours, minutes)
        if (
            seconds
            and sign in ("_", "-")
            and (places == 0 or (sign == "-" and places is None and len(own) < _MICROSECONDS))
        ):
            end = date.start(7)
            return _DATE.match(stem[:end], plain.start()), _since_1970(*moment, None), True
        if seconds:
            return date, seconds, True
    if (
        digits in (2, 5)
        and (date := _YEAR_LAST.match(stem, plain.start()))
        and (seconds := _since_1970_told_last(date))
    ):
        return date, seconds, True
    if digits >= 10 and places and (parts := _PARTED.match(stem, plain.start())):
        return parts, f"{parts[1]}.{_filled(parts[3], places)}", True
    if digits >= 10 and (parts := _SECONDS.match(stem, plain.start())) and (places is None or parts[2]):
        own = parts[2] or parts[3]
        return parts, f"{parts[1]}.{own if parts[2] or len(own) == _MICROSECONDS else own.zfill(_NANOSECONDS)}", True
    return plain, plain[0], False


def _filled(own: str | None, places: int | None) -> str | None:
    return own.zfill(places) if own and places else own


def _since_1970_told_last(match: re.Match[str]) -> str:
    """Returns the seconds of a date whose year stands last, "" where day and month may be either way round."""
    first, other, year, *clock = match.groups()
    if (first > "12") == (other > "12"):
        return ""
    day, month = (first, other) if first > "12" else (other, first)
    return _since_1970(year, month, day, *clock)


def _since_1970(
    year: str, month: str, day: str, hour: str, minute: str, second: str, fraction: str | None, *ahead: str | None
) -> str:
    """Returns the seconds of a date, "" where it is none. ahead: hours and minutes by which its zone is."""
    zone = timezone(timedelta(hours=int(ahead[0] or 0), minutes=int(ahead[1] or 0)) if ahead else timedelta())
    try:
        moment = datetime(int(year), int(month), int(day), int(hour), int(minute), 0, tzinfo=zone)
    except ValueError:  # such as month 13: it is no date
        return ""
    return f"{int(moment.timestamp()) + int(second)}" + (f".{fraction}" if fraction else "")


class NumberColumns:
    """Looks at the numbers of all names of one shape, because one alone doesn't tell what it means.

    Whether ``5.10`` comes before ``5.9`` depends on the others: decimals are written with trailing zeros or without,
    seconds and nanoseconds with a point between them may lack leading zeros.
    """

    def __init__(self, names: Sequence[Name]) -> None:
        self.names = names
        self.columns = list(zip(*(name.numbers for name in names))) if names and names[0].numbers else []
        self.counted = [_counts_after_point(column) for column in self.columns]

    def varying(self) -> list[int]:
        """Returns which columns hold more than one number."""
        return [k for k, column in enumerate(self.columns) if len(set(column)) > 1]

    def key(self, name: Name) -> tuple[Any, ...]:
        """Returns the sort key of a name: its numbers one after the other, and its spelling last."""
        return (*(_value(number, counted) for number, counted in zip(name.numbers, self.counted)), name.text)

    def pattern(self) -> str:
        """Returns the names with ``*`` where they differ."""
        first, varying = self.names[0], set(self.varying())
        shown = ["*" if k in varying or len(self.names) == 1 else number for k, number in enumerate(first.spelled)]
        text = first.parts[0] + "".join(number + part for number, part in zip(shown, first.parts[1:]))
        return text + splitext(first.text)[1]

    def running_numbers(self) -> np.ndarray | None:
        """Returns the whole numbers that rise from name to name, i64 (F), of several such columns those that do so by the
        smallest steps: another one tells times; None without one.
        """
        found = []
        for column in self.varying():
            if not any("." in number for number in self.columns[column]):
                numbers = [int(number) for number in self.columns[column]]
                if all(a < b for a, b in zip(numbers, numbers[1:])) and numbers[-1] < 2**62:
                    found.append(numbers)
        return np.array(min(found, key=lambda own: own[-1] - own[0]), np.int64) if found else None

    def tells_times(self, column: int) -> bool:
        """Returns whether all numbers of a column are dates or seconds, or may be times since 1970."""
        return self.seconds(column) is not None

    def times(self) -> np.ndarray | None:
        """Returns the seconds between the first name's time and each, f64 (F); None unless all hold times, rising."""
        for column in self.varying():
            seconds = self.seconds(column)
            if seconds is not None and all(a < b for a, b in zip(seconds, seconds[1:])):
                since = np.array([float(second - seconds[0]) for second in seconds])
                if np.median(np.diff(since)) >= _SHORTEST:
                    return since
        return None

    def seconds(self, column: int) -> list[Decimal] | None:
        """Returns the seconds that the numbers of a column tell, None where they may be no times."""
        numbers = self.columns[column]
        if all(name.is_time[column] for name in self.names):
            return [_in_seconds(number, self.counted[column]) for number in numbers]
        for form, places in _OF_DATA_SETS:
            if column == 1 and all(form.fullmatch(splitext(name.text)[0]) for name in self.names):
                return [Decimal(number).scaleb(-places) for number in numbers]
        lengths = {len(number.partition(".")[0]) for number in numbers}
        for digits, places in _EPOCHS:
            fits = lengths == {digits} and all(number[0] in "12" or digits == 18 for number in numbers)
            if fits and (places or not any("." in number for number in numbers)):  # milliseconds may have fractions
                ticks = digits == 18 and all(is_ticks(int(Decimal(number))) for number in numbers)
                return [Decimal(number).scaleb(-_TICK_PLACES if ticks else -places) for number in numbers]
        if all("." in number and len(number.partition(".")[2]) >= 6 for number in numbers):  # as %f and ROS write them
            return [_in_seconds(number, False) for number in numbers]
        return None


def in_order(paths: Sequence[Path]) -> list[Path]:
    """Returns files by the numbers in their names, fractions and dates as such, those that are named otherwise at the end.

    Where most have a name of their own shape they stay in the order in which they come.
    """
    names = parse_names([path.name for path in paths])
    (shape, count), *_ = Counter(name.shape for name in names).most_common(1) or [("", 0)]
    if count <= len(paths) // 2:
        return list(paths)
    columns = NumberColumns([name for name in names if name.shape == shape])
    alike = [path for path, name in zip(paths, names) if name.shape == shape]
    tell_unclear_order(alike[0].parent, [path.name for path in alike])
    others = [path for path, name in zip(paths, names) if name.shape != shape]
    ordered = sorted(zip(alike, columns.names), key=lambda pair: columns.key(pair[1]))
    return [path for path, _ in ordered] + others


def tell_unclear_order(folder: Path, names: Sequence[str]) -> None:
    """Warns where dates or times in names may mean two things, so that their numbers may give another order than time."""
    dates = [match for name in names if (match := _YEAR_LAST.search(name)) and not _since_1970_told_last(match)]
    why = ""
    if len({match.groups()[:3] for match in dates}) > 1:
        why = f"whether day or month stands first in {dates[0][0]} and the like"
    elif len(names) > 1 and any(map(_HALF_DAY.search, names)):
        why = "when it was by clocks of 12 hours"
    elif _may_lack_zeros(names):
        why = "whether the digits behind the point count nanoseconds without leading zeros"
    elif _may_pass_midnight(names):
        why = "whether these times of day go on past midnight"
    if why:
        with log.each_once(_SAID):
            log.warn(
                f"{folder}: {why} can't be told from the names; they are ordered by these numbers as written. Names such as"
                " 2024-03-05_14-30-00 tell it"
            )


def _may_lack_zeros(names: Sequence[str]) -> bool:
    """Returns whether seconds have up to nine digits behind the point, and neither a zero before nor one at the end of
    some of these tells fractions cut short from nanoseconds without leading zeros.
    """
    after = [match[2] for name in names if (match := _SECONDS.search(name)) and match[2]]
    lengths = {len(digits) for digits in after}
    return len(lengths) > 1 and max(lengths) == _NANOSECONDS and not any(d[0] == "0" or d[-1] == "0" for d in after)


def _may_pass_midnight(names: Sequence[str]) -> bool:
    """Returns whether names hold times of day without a date, and none from between late and early: more than half a day."""
    clocks = [match for name in names if (match := _TIME_OF_DAY.search(name)) and not _DATE.search(name)]
    minutes = sorted({int(match[1]) * 60 + int(match[3]) for match in clocks})
    apart = [b - a for a, b in zip(minutes, minutes[1:])]
    return len(clocks) == len(names) > 1 and max(apart, default=0) > _HALF_A_DAY


def _counts_after_point(column: Sequence[str]) -> bool:
    """Returns whether digits after the point count by themselves, as in versions and nanoseconds without leading zeros.

    Numbers that count never begin with 0 and some end with it; fractions cut short begin with 0 and never end with it.
    """
    after = [number.partition(".")[2] for number in column if "." in number]
    if len({len(digits) for digits in after}) < 2:
        return False
    return all(digits[0] != "0" or digits == "0" for digits in after) and any(digits[-1] == "0" for digits in after)


def _value(number: str, counted: bool) -> tuple[int, Decimal]:
    whole, point, after = number.partition(".")
    if not point:
        return int(whole), _NOTHING
    return int(whole), Decimal(after or 0) if counted else Decimal(f"0.{after or 0}")


def _in_seconds(number: str, counted: bool) -> Decimal:
    """Returns seconds; digits that count by themselves are nanoseconds."""
    whole, after = _value(number, counted)
    return whole + (after.scaleb(-9) if counted else after)
