"""The choice of the kept columns that a network reads: those that say something of what happens at a point.

A sensor's rows also have numbers, clocks and counters. A network that reads them learns which recording it sees, or how long
it lasts; on new recordings they mislead. What a column is called tells nothing, so its values in the training videos decide.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dpcli.classify.network.descriptors import SLOTS
from dpcli.store import CloudsReader
from dpcli.store.schema import KEPT, kept_name

_LOOKED_AT, _POINTS = 2000, 10_000_000  # videos and, about, points at most, evenly over the file
_MOST = 0.9  # of frames, or of steps between them, for which a rule must hold: counters wrap, clocks stop
_STEPS = 20  # between frames, or points of a video, at least, before they tell a rule
_ENOUGH = 8  # videos a class: in fewer, chance can hide what a column says
_CHANCE = 0.05  # how often a column that says nothing is read nevertheless


@dataclass(frozen=True)
class _Video:
    """Holds the values f64 (P) of a column in one video, the finite ones, and of each its frame, its row there, and where
    the point is (P,3)."""

    values: np.ndarray
    frames: np.ndarray
    rows: np.ndarray
    points: np.ndarray
    length: int


def file_columns(reader: CloudsReader) -> tuple[str, ...]:
    """Returns the names of the columns that a file keeps of its points."""
    return tuple(name.removeprefix(KEPT) for name in reader.fields if name.startswith(KEPT))


def telling_columns(
    reader: CloudsReader, sequences: Sequence[int], *, by_class: bool = True
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Returns the columns that say something of what happens in these videos, and why the others don't, by name.

    by_class: also leave out a column that goes with neither class nor place, where the videos are enough to say.
    """
    names = file_columns(reader)
    if not names or not len(sequences):
        return names, {}
    points = int(reader.frame_sizes.sum()) * len(sequences) // len(reader)
    some = list(sequences)[:: max(-(-len(sequences) // _LOOKED_AT), -(-points // _POINTS))]
    labels = reader.labels[some] if by_class else None
    columns = _columns(reader, some, names)
    found = {name: _why_not(columns[name], labels) for name in names}
    return tuple(name for name in names if not found[name]), {name: why for name, why in found.items() if why}


def not_read(left_out: dict[str, str]) -> str:
    """Returns the columns that aren't read with the reasons, as the end of a sentence; "" where all are read."""
    return "; not read: " + ", ".join(f"{name} ({why})" for name, why in left_out.items()) if left_out else ""


def _columns(reader: CloudsReader, sequences: Sequence[int], names: tuple[str, ...]) -> dict[str, list[_Video]]:
    """Returns some videos by column; columns without missing values share all but these."""
    found: dict[str, list[_Video]] = {name: [] for name in names}
    for number in sequences:
        video = reader.read(number, fields=tuple(map(kept_name, names)))
        counts = np.diff(video.frame_offsets)
        frames = np.repeat(np.arange(video.num_frames), counts)
        rows = np.arange(len(frames)) - np.repeat(video.frame_offsets[:-1], counts)
        for name in names:
            values = video.extra[kept_name(name)].astype(np.float64)
            good = np.isfinite(values)
            own = (values, frames, rows, video.points)
            found[name].append(_Video(*(own if good.all() else (part[good] for part in own)), video.num_frames))
    return found


def _why_not(videos: list[_Video], labels: np.ndarray | None) -> str:
    """Returns why a column says nothing of what happens, "" where it may."""
    values = np.concatenate([one.values for one in videos])
    if not len(values):
        return "has no number"
    if values.min() == values.max():
        return f"is {values[0]:g} everywhere"
    rules: tuple[tuple[Callable[[list[_Video]], bool], str], ...] = (
        (_numbers_rows, "numbers the points of a frame"),
        (_is_a_clock, "rises or falls with time"),
        (_names_videos, "tells which video it is"),
    )
    for rule, why in rules:
        if rule(videos):
            return why
    return "might as well be drawn at random" if labels is not None and _by_chance(videos, labels) else ""


def _numbers_rows(videos: list[_Video]) -> bool:
    """Returns whether the value grows by 1 from row to row in nearly all frames that have several, but for frames that all have
    as many points: there a number is a name, such as a joint's."""
    sizes = np.unique(np.concatenate([np.unique(one.frames, return_counts=True)[1] for one in videos]))
    if len(sizes) == 1:
        return False
    right = several = 0
    for one in videos:
        same = np.diff(one.frames) == 0
        wrong = same & (np.diff(one.values) != np.diff(one.rows))
        of = np.unique(one.frames[1:][same])
        several += len(of)
        right += len(of) - len(np.unique(one.frames[1:][wrong]))
    return several > 0 and right >= _MOST * several


def _is_a_clock(videos: list[_Video]) -> bool:
    """Returns whether the middle value of frames goes the same way in nearly all steps, in all videos; it may stand still."""
    steps = np.concatenate([np.diff(_middles(one)) for one in videos])
    steps = steps[steps != 0]
    return len(steps) >= _STEPS and max((steps > 0).mean(), (steps < 0).mean()) >= _MOST


def _middles(video: _Video) -> np.ndarray:
    """Returns the median of each frame with points, in order."""
    ends = np.flatnonzero(np.diff(video.frames)) + 1
    return np.array([np.median(part) for part in np.split(video.values, ends) if len(part)])


def _names_videos(videos: list[_Video]) -> bool:
    """Returns whether values differ between videos and hardly within them, as if each video had a range of its own."""
    from scipy.stats import rankdata

    sizes = [len(one.values) for one in videos]
    if sum(size > 1 for size in sizes) < 2:
        return False
    ranks = rankdata(np.concatenate([one.values for one in videos]))
    own = [part - part.mean() for part in np.split(ranks, np.cumsum(sizes)[:-1]) if len(part)]
    count = len(own)
    return bool(np.mean(np.concatenate(own) ** 2) <= min(4 / count**2, 0.01) * ranks.var())


def _by_chance(videos: list[_Video], labels: np.ndarray) -> bool:
    """Returns whether a column's values might as well be dealt to the points at random: their level and spread, in all and in
    each slot of time, are alike in all classes (analysis of variance), and within videos they don't go with place (Student's
    test of the correlations), beyond Bonferroni's bound. False where the videos are too few to say.
    """
    from scipy.stats import f_oneway, rankdata, ttest_1samp

    classes, counts = np.unique(labels, return_counts=True)
    if len(classes) < 2 or np.median(counts) < _ENOUGH:
        return False
    ranks = rankdata(np.concatenate([one.values for one in videos]))
    parts = np.split(ranks / len(ranks) - 0.5, np.cumsum([len(one.values) for one in videos])[:-1])
    means = np.stack([_means(own, one) for own, one in zip(parts, videos)])
    means = means[:, np.isfinite(means).any(0)]  # videos of few frames leave slots empty
    means = np.where(np.isnan(means), np.nanmean(means, 0), means)
    means = means[:, np.ptp(means, 0) > 0]
    with_place = np.stack([_with_place(own, one) for own, one in zip(parts, videos)])
    by_place = np.full(with_place.shape[1], np.nan)
    known = np.isfinite(with_place).sum(0) > 1
    if known.any():
        by_place[known] = ttest_1samp(with_place[:, known], 0, nan_policy="omit").pvalue
    chances = [*f_oneway(*(means[labels == one] for one in classes)).pvalue, *np.nan_to_num(by_place, nan=1.0)]
    return bool(min(chances) * len(chances) > _CHANCE)


def _means(ranks: np.ndarray, video: _Video) -> np.ndarray:
    """Returns means f64 (2 + 2 slots) of the ranks of one video's values and of their distance from the middle, NaN of none.

    Means, since the number of points, which differs between classes, shifts quantiles but no means.
    """
    slots = video.frames * SLOTS // max(video.length, 1)
    counts = np.bincount(slots, minlength=SLOTS)
    sums = [np.bincount(slots, own, SLOTS) for own in (ranks, np.abs(ranks))]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.concatenate([np.append(own, own.sum()) / np.append(counts, counts.sum()) for own in sums])


def _with_place(ranks: np.ndarray, video: _Video) -> np.ndarray:
    """Returns how the ranks of one video's values go with x, y, z and the distance from its median: f64 (4), NaN of too few."""
    if len(ranks) < _STEPS:
        return np.full(4, np.nan)
    about = video.points - np.median(video.points, 0)
    others = np.column_stack([about, np.linalg.norm(about, axis=1)])
    own, others = ranks - ranks.mean(), others - others.mean(0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return own @ others / (np.linalg.norm(own) * np.linalg.norm(others, axis=0))
