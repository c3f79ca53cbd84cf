"""Segmental metrics: frame accuracy, edit score and F1 at an overlap, as Lea et al. (2017) and MS-TCN (Farha & Gall 2019) define them.

Everything is made of counts of single recordings, so that those of many add up. Neighboring segments of one class are
one segment, as they are in labels of frames; nothing ("") counts for the frame accuracy alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dpcli.evaluate.bootstrap import WeightedMetric, ratios_of_sums
from dpcli.store.tables.segments import Segment

OVERLAPS = (10, 25, 50)  # percent of intersection over union
METRICS = ("frame_accuracy", "edit_score", *(f"f1_{percent}" for percent in OVERLAPS))


@dataclass(frozen=True)
class RecordingCounts:
    """Holds the counts of one recording. edit: 0..1, NaN without any action on either side; hits: by overlap."""

    frames: int
    right: int
    true: int  # segments of actions
    predicted: int
    edit: float
    hits: Mapping[int, int]


def count_recording(predicted: Sequence[Segment], true: Sequence[Segment]) -> RecordingCounts:
    """Returns the counts of the segments of one recording, each sorted; frames that neither names show nothing.

    A frame counts from 0 to the last one that either side names.

    >>> true = [Segment(0, 10, "wave"), Segment(10, 20, "bow")]
    >>> found = count_recording([Segment(0, 12, "wave"), Segment(12, 20, "kick")], true)
    >>> found.right, found.edit, found.hits[50]
    (10, 0.5, 1)
    """
    frames = max(one.end for one in (*predicted, *true))
    ours, theirs = merged(predicted), merged(true)
    names = {name: number for number, name in enumerate(["", *{one.name for one in (*ours, *theirs)} - {""}])}
    right = int((_labels(ours, frames, names) == _labels(theirs, frames, names)).sum())
    ours, theirs = ([one for one in side if one.name] for side in (ours, theirs))
    hits = {percent: _hits(ours, theirs, percent / 100) for percent in OVERLAPS}
    return RecordingCounts(frames, right, len(theirs), len(ours), _edit_score(ours, theirs), hits)


def merged(segments: Sequence[Segment]) -> list[Segment]:
    """Returns sorted segments, those that touch and are of one class made one."""
    made: list[Segment] = []
    for one in segments:
        if made and made[-1].name == one.name and made[-1].end == one.start:
            made[-1] = Segment(made[-1].start, one.end, one.name)
        else:
            made.append(Segment(one.start, one.end, one.name))
    return made


def _labels(segments: Sequence[Segment], frames: int, names: Mapping[str, int]) -> np.ndarray:
    labels = np.zeros(frames, np.int32)
    for one in segments:
        labels[one.start : one.end] = names[one.name]
    return labels


def _edit_score(ours: Sequence[Segment], theirs: Sequence[Segment]) -> float:
    """Returns 1 - Levenshtein distance of the two orders of classes / the longer one's length; NaN where both are empty."""
    if not ours and not theirs:
        return float("nan")
    numbers = {name: number for number, name in enumerate({one.name for one in theirs})}
    orders = np.array([numbers[one.name] for one in theirs], np.int64)
    places = np.arange(len(theirs) + 1)
    row = places
    for i, own in enumerate(ours, start=1):
        reached = np.minimum(row[1:] + 1, row[:-1] + (orders != numbers.get(own.name, -1)))
        row = np.minimum.accumulate(np.concatenate([[i], reached]) - places) + places  # then steps along the row
    return 1 - float(row[-1]) / max(len(ours), len(theirs))


def _hits(ours: Sequence[Segment], theirs: Sequence[Segment], least: float) -> int:
    """Returns how many predicted segments are right: of their own class the true segment that they overlap most, by at least
    `least` of the union, and the first to claim it."""
    taken: set[tuple[str, int]] = set()
    of_class: dict[str, list[tuple[int, int]]] = {}
    for one in theirs:
        of_class.setdefault(one.name, []).append((one.start, one.end))
    ends = {name: np.array(rows) for name, rows in of_class.items()}
    for own in ours:
        if own.name in ends:
            shares = _overlaps(own, *ends[own.name].T)
            best = int(shares.argmax())
            if shares[best] >= least:
                taken.add((own.name, best))
    return len(taken)


def _overlaps(one: Segment, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    both = np.minimum(one.end, ends) - np.maximum(one.start, starts)
    return np.maximum(both, 0) / (np.maximum(one.end, ends) - np.minimum(one.start, starts))


def segments_weighted(counts: Sequence[RecordingCounts]) -> WeightedMetric:
    """Returns the metrics as functions of how often each recording counts: frames and segments of all are pooled, the edit
    score is the mean of the recordings'."""
    edit = np.array([one.edit for one in counts])
    tops = {"frame_accuracy": np.array([one.right for one in counts]), "edit_score": np.nan_to_num(edit)}
    bottoms = {"frame_accuracy": np.array([one.frames for one in counts]), "edit_score": ~np.isnan(edit)}
    for percent in OVERLAPS:
        tops[f"f1_{percent}"] = np.array([2 * one.hits[percent] for one in counts])
        bottoms[f"f1_{percent}"] = np.array([one.true + one.predicted for one in counts])
    return ratios_of_sums(tops, bottoms)
