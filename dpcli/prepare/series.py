"""Series of frames in a folder: which files make one clip, in which order, and the times that their names tell.

Files belong together when their names differ in numbers only. Where several series lie in one folder, one is chosen by
rule or by the pattern that a user gives; the others are named, and where no rule decides, so is the choice to make.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from fnmatch import fnmatchcase
from os.path import splitext
from pathlib import Path
from unicodedata import normalize

import numpy as np

from dpcli.errors import DataError
from dpcli.path_names import first_names
from dpcli.prepare.reader import natural_key
from dpcli.runtime.clips.name_numbers import Name, NumberColumns, parse_name, parse_names, tell_unclear_order

_LISTED, _FEW = 5, 8
_HEX = re.compile(r"(.*?)([0-9a-f]+)", re.IGNORECASE)
_SIXTY = 60  # minutes and seconds end below
TEXTS = (".txt", ".csv", ".tsv")
_BESIDE = re.compile(
    r"(read[-_ ]?me|licen[cs]e|copying|changelog|notes?|poses?|traj\w*|odom\w*|ground[-_ ]?truth|gt|times?|time_?stamps?|"
    r"calib\w*|camera\w*|intrinsics?|extrinsics?|k|labels?|classes|meta\w*|info|index|files?|list|train|val|test|splits?|"
    r"associations?|imu|gps|oxts|config|settings|requirements|cmakelists)([-_. ].*)?",
    re.IGNORECASE,
)

_ARRAYS_BESIDE = re.compile(
    r"((cam(era)?|depth|color|rgb)[-_]?)?(poses|trajectory|odometry|times|time_?stamps?|calib(ration)?|(in|ex)trinsics?|labels|"
    r"imu|gps|k)",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class TimesBeside:
    """Holds the file that lists the times of a series, and these: seconds since the first frame, f64 (F), rising."""

    path: Path
    seconds: np.ndarray


@dataclass(frozen=True)
class Series:
    """Holds the files of one series in their order; ``left_out`` names what else lay there, a phrase each.

    ``beside``: times that a file beside the frames lists. ``joined``: the series that a user's pattern makes one of, a phrase each.
    """

    folder: Path
    names: tuple[str, ...]
    pattern: str
    left_out: tuple[str, ...] = ()
    numbered: bool = True
    suffix: str = field(default="", compare=False)
    beside: TimesBeside | None = field(default=None, compare=False)
    joined: tuple[str, ...] = ()

    @property
    def paths(self) -> list[Path]:
        """Returns the files in their order."""
        return [self.folder / name for name in self.names]

    @property
    def stems(self) -> frozenset[str]:
        """Returns the names without their suffixes."""
        return frozenset(splitext(name)[0] for name in self.names)

    def described(self) -> str:
        """Returns pattern and number of files, such as ``frame_*.png (30 files)``, or the one file's name."""
        return self.names[0] if len(self.names) == 1 else f"{self.pattern} ({len(self.names)} files)"

    def numbers(self) -> np.ndarray | None:
        """Returns the running numbers in the names, i64 (F), rising; None when the names hold none, or more than one."""
        return NumberColumns(parse_names(self.names)).running_numbers() if self.numbered else None

    def _is_counted(self) -> bool:
        """Returns whether the names hold a number that counts the frames beside another, such as a time."""
        numbers = self.numbers()
        several = len(NumberColumns(parse_names(self.names)).varying()) > 1
        return several and numbers is not None and int(np.diff(numbers).min()) == 1

    def name_times(self) -> np.ndarray | None:
        """Returns seconds since the first frame, f64 (F), rising, where the names are times; None when they are not."""
        return NumberColumns(parse_names(self.names)).times() if self.numbered else None

    def times(self) -> np.ndarray | None:
        """Returns seconds since the first frame, f64 (F), rising, as the names or a file beside them tell; else None."""
        named = self.name_times()
        return self.beside.seconds if named is None and self.beside else named

    def frame_times(self, fps: float | None) -> np.ndarray | None:
        """Returns seconds since the first frame, f64 (F): numbers in the names divided by ``fps``, so that what is missing
        leaves a gap, or else the times that are told; None when neither says anything.
        """
        if fps is None:
            return self.times()
        numbers = None if self.name_times() is not None and not self._is_counted() else self.numbers()
        places = np.arange(len(self.names)) if numbers is None else evenly(numbers)
        return places / fps


def missing_numbers(numbers: np.ndarray | None) -> list[str]:
    """Returns which numbers are missing in rising ones, i64 (F), such as ``["3 to 6", "9"]``; a common step is no gap.

    >>> missing_numbers(np.array([0, 1, 2, 7, 8]))
    ['3 to 6']
    >>> missing_numbers(np.array([0, 5, 10]))
    []
    """
    if numbers is None or len(numbers) < 2:
        return []
    steps = np.diff(numbers)
    step = int(np.gcd.reduce(steps))
    found = []
    for place in np.flatnonzero(steps > step):
        first, last = int(numbers[place]) + step, int(numbers[place + 1]) - step
        found.append(str(first) if first == last else f"{first} to {last}")
    return found


def about_series(clips: Sequence[tuple[str, Series]]) -> list[str]:
    """Returns lines for the log about what of a folder is not in its clip: other files, and numbers that are missing.

    clips: (name of the sample, its series).
    """
    lines = []
    for name, series in clips:
        if series.left_out:
            lines.append(
                f"{name}: its frames are {series.described()}; left out: {first_names(series.left_out, _LISTED)}"
            )
        gaps = missing_numbers(series.numbers()) if series.name_times() is None else []
        if series.beside:
            lines.append(f"{name}: its frames have the times in {series.beside.path.name}")
        if order := _doubts_of_order(series):
            lines.append(f"{name}: {order}")
        if gaps:
            lines.append(f"{name}: its frames are numbered with gaps: {first_names(gaps, _LISTED)} missing")
    lines += _twice(clips)
    if moments := _moments([series for _, series in clips]):
        lines.append(moments)
    more = len(lines) - 2 * _LISTED
    return lines if more <= 0 else [*lines[: 2 * _LISTED], f"... and {more} more such folders"]


def _doubts_of_order(series: Series) -> str:
    """Returns what may be wrong with the order of frames: names that count nothing, or that hold two counts; "" if nothing."""
    if len(series.names) < 2 or _counted_in_hex(series.names):
        return ""
    if series.joined:
        return f"the pattern joins {len(series.joined)} series in the order of their names: {first_names(series.joined, _LISTED)}"
    if not series.numbered:
        return f"no number counts its frames; they are in the order of their names: {', '.join(series.names[:3])} ..."
    names = parse_names(series.names)
    found = _by_outer_numbers(names) if len({name.shape for name in names}) == 1 else None
    clocks = found is not None and (_are_clocks(names) or series.name_times() is not None)
    if found is None or clocks or not 1 < len(found[0]) < len(names) / 2:
        return ""
    return (
        f"two numbers vary in the names of its frames ({series.pattern}); all {len(names)} are taken as one sequence, not the"
        f" {len(found[0])} that begin as {found[0][0][0].text} and {found[0][1][0].text} do (--pattern takes one)"
    )


def _twice(clips: Sequence[tuple[str, Series]]) -> list[str]:
    """Returns a line for the log where several samples are the same files, to which links lead."""
    places: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for name, series in clips:
        places.setdefault((os.path.realpath(series.folder), series.names), []).append(name)
    same = [names for names in places.values() if len(names) > 1]
    return [f"{' and '.join(same[0][:3])} are the same files by a link: samples that are there twice"] if same else []


def _moments(clips: Sequence[Series]) -> str:
    """Returns a line for the log where folders that are numbered hold the same few names each, as where a folder is one moment
    and its files are what several cameras saw then; "" otherwise.
    """
    folders = [one.folder for one in clips]
    names = {one.names for one in clips}
    beside = len(clips) > 2 and len(names) == 1 and len({folder.parent for folder in folders}) == 1
    if not beside or len(next(iter(names))) > _FEW or len(all_series(folders[0].parent, [f.name for f in folders])) > 1:
        return ""
    if NumberColumns([parse_name(folder.name) for folder in folders]).varying() == []:
        return ""
    return (
        f"{len(clips)} folders such as {folders[0].name} hold {', '.join(next(iter(names))[:3])} each: if a folder is one"
        " moment, not one sequence, put the files of one camera into one folder"
    )


def evenly(numbers: np.ndarray) -> np.ndarray:
    """Returns how many steps each number is behind the first; a common step of 2 or more counts as one."""
    return (numbers - numbers[0]) // max(int(np.gcd.reduce(np.diff(numbers))), 1) if len(numbers) > 1 else numbers * 0


def is_hidden(name: str) -> bool:
    """Returns whether a file or folder is none of the user's: hidden, as what macOS puts beside a file (``._x``) or packs into a
    folder ``__MACOSX`` of an archive, or a lock.
    """
    return name.startswith((".", "~$")) or name == "__MACOSX"


def is_beside(name: str) -> bool:
    """Returns whether a text's or an array's name says that it is about the frames (README, poses, times, ...), not one."""
    stem, suffix = splitext(name)
    if suffix.lower() in (".npy", ".npz"):
        return _ARRAYS_BESIDE.fullmatch(stem) is not None
    return suffix.lower() in TEXTS and _BESIDE.fullmatch(stem) is not None


def all_series(folder: Path, names: Sequence[str]) -> list[Series]:
    """Returns the series among the names of files, largest first; names without numbers make one for each suffix."""
    groups: dict[tuple[str, str], list[Name]] = {}
    for name in parse_names(names):
        groups.setdefault((name.shape if name.numbers else "", name.suffix), []).append(name)
    if len(groups) > 1 and (hexadecimal := _counted_in_hex(names)):
        suffix = splitext(names[0])[1].lower()
        return [Series(folder, tuple(hexadecimal), f"*{suffix}", numbered=False, suffix=suffix)]
    apart = [part for group in groups.values() for part in _spelled_apart(group)]
    found = [_made(folder, part) for group in apart for part in _objects(group)]
    scattered = sum(len(one.names) for one in found if one.numbered and len(one.names) == 1)
    if scattered > 2 and 2 * scattered > sum(len(one.names) for one in found if one.numbered):
        found = _by_suffix(found)  # such as hashes: their letters are no pattern
    return sorted(found, key=lambda one: (-len(one.names), one.names))


def _spelled_apart(group: list[Name]) -> list[list[Name]]:
    """Returns the files of one shape, by their spelling where two have the same numbers, such as ``Frame_1`` and ``frame_1``."""
    if len({name.numbers for name in group}) == len(group) or not group[0].numbers:
        return [group]
    spellings: dict[tuple[str, ...], list[Name]] = {}
    for name in group:
        spellings.setdefault((*name.parts, splitext(name.text)[1]), []).append(name)
    return list(spellings.values())


def _by_outer_numbers(group: list[Name]) -> tuple[list[list[Name]], int, bool] | None:
    """Returns the files of one shape by all of their varying numbers but one, that one's place, and whether it tells times;
    None where one number varies, or several tell times. The number left out is the one that tells times, else the last; of two
    that tell times the one that is another in every name, beside when its recording began.
    """
    columns = NumberColumns(group)
    varying = columns.varying()
    timed = [column for column in varying if columns.tells_times(column)]
    if len(timed) > 1:
        timed = [column for column in timed if len(set(columns.columns[column])) == len(group)]
    if len(varying) < 2 or len(timed) > 1:
        return None
    inner = timed[0] if timed else varying[-1]
    parts: dict[tuple[str, ...], list[Name]] = {}
    for name in group:
        parts.setdefault(tuple(name.numbers[column] for column in varying if column != inner), []).append(name)
    return list(parts.values()), inner, bool(timed)


def _objects(group: list[Name]) -> list[list[Name]]:
    """Returns the files of one shape by object, where each object's frames are counted anew, such as ``cup1_0, cup1_1,
    cup2_0, cup2_1``, where several have the same times, or where their counts overlap.
    """
    found = _by_outer_numbers(group)
    if found is None:
        return [group]
    parts, inner, timed = found
    counts = [sorted(float(name.numbers[inner]) for name in part) for part in parts]
    several = len(parts) > 1 and all(len(own) > 1 for own in counts)
    if timed:
        apart = [k for k in range(len(group[0].numbers)) if k != inner and len({name.numbers[k] for name in group}) > 1]
        fractions = all(len(name.numbers[k]) in (6, 9) for name in group for k in apart)  # of the seconds
        return parts if several and not fractions and not _within_seconds(parts, inner, apart) else [group]
    anew = all(own == [counts[0][0] + k for k in range(len(own))] for own in counts)
    alike = all(own == counts[0] for own in counts) and counts[0][-1] >= _SIXTY
    ends = sorted((own[0], own[-1]) for own in counts)
    overlap = any(after[0] <= before[1] for before, after in zip(ends, ends[1:])) and not _are_clocks(group)
    return parts if several and (anew or alike or overlap) else [group]


def _within_seconds(parts: list[list[Name]], inner: int, apart: list[int]) -> bool:
    """Returns whether another number than the one at ``inner`` tells times, too, and is that of the second of each frame."""
    if not any(NumberColumns([name for part in parts for name in part]).tells_times(k) for k in apart):
        return False
    times = [NumberColumns(part).seconds(inner) or [Decimal(0)] for part in parts]
    return all(max(own) - min(own) <= 1 for own in times)


def _are_clocks(group: list[Name]) -> bool:
    """Returns whether all numbers of the names that vary are of two digits below 60, as minutes and seconds are."""
    varying = NumberColumns(group).varying()
    return all(len(name.numbers[k]) == 2 and name.numbers[k] < "60" for name in group for k in varying)


def _made(folder: Path, names: list[Name]) -> Series:
    columns = NumberColumns(names)
    tell_unclear_order(folder, [name.text for name in names])
    ordered = tuple(name.text for name in sorted(names, key=columns.key))
    numbered = bool(names[0].numbers)
    pattern = columns.pattern() if numbered else f"*{names[0].suffix}"
    return Series(folder, ordered, pattern, numbered=numbered, suffix=names[0].suffix)


def _by_suffix(found: list[Series]) -> list[Series]:
    """Returns one series for each suffix."""
    suffixes = dict.fromkeys(one.suffix for one in found)
    groups = [[one for one in found if one.suffix == suffix] for suffix in suffixes]
    return [_joined(same, f"*{suffix}", suffix) for suffix, same in zip(suffixes, groups)]


def _joined(found: list[Series], pattern: str, suffix: str = "") -> Series:
    """Returns all files of some series of one folder as one, in the natural order of their names."""
    names = sorted((name for one in found for name in one.names), key=natural_key)
    return Series(found[0].folder, tuple(names), pattern, numbered=False, suffix=suffix)


def _counted_in_hex(names: Sequence[str]) -> list[str]:
    """Returns names that hexadecimal numbers of one length count without a gap, in their order; [] of others, such as hashes."""
    found = [_HEX.fullmatch(splitext(name)[0]) for name in names]
    suffixes = {splitext(name)[1].lower() for name in names}
    if not all(found) or len(suffixes) > 1 or len({(match[1], len(match[2])) for match in found if match}) > 1:
        return []
    numbers = {int(match[2], 16): name for match, name in zip(found, names) if match}
    gapless = len(numbers) == len(names) == max(numbers) - min(numbers) + 1
    return [numbers[number] for number in sorted(numbers)] if gapless else []


def choose_series(
    folder: Path,
    names: Sequence[str],
    *,
    pattern: str = "",
    suffixes: Sequence[str] = (),
    wanted: str = "",
    judge: Callable[[Path], bool] | None = None,
) -> Series | None:
    """Returns the one series that is the clip; None when the folder holds nothing but hidden files and texts about frames,
    or nothing that fits the pattern.

    names: the files of ``folder`` that may be frames. pattern: what a user chose, such as ``*.depth.png``. suffixes: in
    the order in which two files of one name are preferred. wanted: a regular expression for names that say what is looked
    for. judge: whether a file can be a frame, asked of one file of each series when nothing else decides. Raises DataError
    that lists the series when no rule decides.
    """
    shown = [name for name in names if not is_hidden(name)]
    if pattern:
        return _by_pattern(folder, shown, pattern)
    frames = [name for name in shown if not is_beside(name)]
    beside = [name for name in shown if is_beside(name)]
    if not frames:
        return None
    found = _mixed_formats(folder, all_series(folder, frames))
    left_out: list[Series] = []
    rules = (
        lambda s: _only(s, lambda one: one.numbered),
        lambda s: _preferred(s, suffixes, judge),
        lambda s: _only(s, lambda one: one.suffix not in TEXTS),
        lambda s: _only(s, lambda one: re.search(wanted, one.pattern, re.IGNORECASE) is not None),
        lambda s: _only(s, lambda one: len(one.names) > 1),
        lambda s: _only(s, lambda one: judge(one.paths[0])) if judge and len(s) > 1 else s,
    )
    for rule in rules:
        kept = rule(found)
        left_out += _without(found, kept)
        found = kept
    if len(found) > 1:
        raise DataError(
            f"{folder}: holds {len(found)} series of frames: {', '.join(one.described() for one in found[:6])}; name one:"
            f" --pattern '{_pattern_of_one(found)}', or put each into a folder of its own"
        )
    return replace(found[0], left_out=(*(one.described() for one in left_out), *sorted(beside)))


def _pattern_of_one(found: list[Series]) -> str:
    """Returns a pattern that only one of several series fits; where none is found, that of the first."""
    for one in found:
        others = [name for other in found if other is not one for name in other.names]
        for pattern in (one.pattern, f"*[0-9]{one.suffix}"):
            if not any(fnmatchcase(name, pattern) for name in others) and all(
                fnmatchcase(name, pattern) for name in one.names
            ):
                return pattern
    return found[0].pattern


def _by_pattern(folder: Path, names: list[str], pattern: str) -> Series | None:
    matching = [name for name in names if fnmatchcase(name, pattern)]
    if not matching:
        return None
    found = all_series(folder, matching)
    others = all_series(folder, [name for name in names if not fnmatchcase(name, pattern)])
    one = found[0] if len(found) == 1 else _joined(found, pattern)
    longer = tuple(own.described() for own in found if len(own.names) > 1)
    return replace(
        one,
        left_out=tuple(other.described() for other in others),
        joined=longer if len(longer) == len(found) > 1 else (),
    )


def _mixed_formats(folder: Path, found: list[Series]) -> list[Series]:
    """Returns the series, those of one shape joined where no frame is there twice: a clip whose files changed format."""
    shapes: dict[tuple[str, bool], list[Series]] = {}
    for one in found:
        own = one.pattern[: -len(one.suffix)] if one.suffix else one.pattern
        shapes.setdefault((own.casefold(), one.numbered), []).append(one)
    joined = []
    for same in shapes.values():
        if len(same) == 1:
            joined += same
            continue
        stems = [normalize("NFC", stem).casefold() for one in same for stem in one.stems]
        texts = {one.suffix in TEXTS for one in same}
        if same[0].numbered and len(set(stems)) == len(stems) and len(texts) == 1:
            joined.append(_made_of(folder, same))
        else:
            joined += same
    return joined


def _made_of(folder: Path, same: list[Series]) -> Series:
    names = parse_names([name for one in same for name in one.names])
    one = _made(folder, names)
    return replace(one, pattern=one.pattern[: -len(one.suffix)] + ".*" if one.suffix else one.pattern)


def _only(found: list[Series], fits: Callable[[Series], bool]) -> list[Series]:
    """Returns the series that fit, all where none does."""
    return [one for one in found if fits(one)] or found


def _preferred(
    found: list[Series], suffixes: Sequence[str], judge: Callable[[Path], bool] | None = None
) -> list[Series]:
    """Returns the series without twins: those that hold the same frames in a format that is less preferred, or that are
    none by ``judge``, such as pictures of depth beside arrays of it.
    """
    ranks = {suffix: rank for rank, suffix in enumerate(suffixes)}
    formats = _formats_of_stems(found)
    pictures = {one for one in found if judge is not None and _is_twin(one, formats) and not judge(one.paths[0])}
    dropped: list[Series] = []
    taken: dict[str, set[str]] = {}
    for one in sorted(found, key=lambda one: (one in pictures, ranks.get(one.suffix, len(ranks)))):
        if _is_twin(one, taken):
            dropped.append(one)
            continue
        for stem in one.stems:
            taken.setdefault(stem, set()).add(one.suffix)
    return _without(found, dropped)


def _formats_of_stems(found: list[Series]) -> dict[str, set[str]]:
    formats: dict[str, set[str]] = {}
    for one in found:
        for stem in one.stems:
            formats.setdefault(stem, set()).add(one.suffix)
    return formats


def _is_twin(one: Series, formats: dict[str, set[str]]) -> bool:
    """Returns whether a frame of a series is there in another format. formats: suffixes by the names without them."""
    return any(formats.get(stem, set()) - {one.suffix} for stem in one.stems)


def _without(found: list[Series], others: Sequence[Series]) -> list[Series]:
    gone = set(others)  # a folder may hold thousands of series
    return [one for one in found if one not in gone]
