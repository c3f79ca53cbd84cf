"""The segments of one recording: a window that slides over it, its scores, and the best cuts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dpcli.classify.confidence import Confidence, log_probabilities
from dpcli.classify.data.clips import frames_with_columns
from dpcli.classify.segments.decoding import best_path, runs
from dpcli.classify.stream.sliding_window import Prediction, StreamPredictor
from dpcli.runtime.progress import Progress
from dpcli.store import CloudSequence, CloudsReader
from dpcli.store.tables.segments import Segment

_CHANGE = 0.3  # what a change of class costs, in windows of full certainty; docs/experiments/classify.md, 2026-11-28
_BLOCK = 256  # frames of a recording in memory at a time


@dataclass(frozen=True)
class Cutting:
    """Says how a recording is cut. window: frames that one prediction sees. shortest: frames a segment lasts at least."""

    window: int
    hop: int
    shortest: int
    confidence: Confidence


@dataclass(frozen=True)
class WindowScores:
    """Holds the scores of a recording's windows in order: the last frame of each i64 (N), and the fused scores f32 (N,C).

    frames: of the recording. time: f64 (frames), seconds, None where the recording has none.
    """

    last: np.ndarray
    scores: np.ndarray
    frames: int
    time: np.ndarray | None = None


def score_windows(predictor: StreamPredictor, reader: CloudsReader, sequence: int, bar: Progress) -> WindowScores:
    """Returns what the windows of a recording say; some hundred frames are in memory at a time."""
    most = int(reader.frame_counts[sequence]) // predictor.hop + 1
    last, scores = np.zeros(most, np.int64), np.zeros((most, len(predictor.info.class_names)), np.float32)
    made, times, columns = 0, [], predictor.info.config.column_fields

    def predictions() -> Iterator[Prediction | None]:
        for block in _blocks(reader, sequence, columns):
            times.append(block.time)
            yield from map(predictor.add, frames_with_columns(block, columns))
            bar.advance(block.num_frames)
        yield predictor.finish()

    for one in filter(None, predictions()):
        last[made], scores[made], made = one.frame, one.scores[0], made + 1
    time = None if times[0] is None else np.concatenate(times)
    return WindowScores(last[:made], scores[:made], predictor.window.count, time)


def _blocks(reader: CloudsReader, sequence: int, columns: tuple[str, ...]) -> Iterator[CloudSequence]:
    count = int(reader.frame_counts[sequence])
    fields = [name for name in ("time", *columns) if name in reader.fields]
    for start in range(0, count, _BLOCK):
        yield reader.read(sequence, slice(start, min(start + _BLOCK, count)), fields=fields)


def cut(found: WindowScores, class_names: Sequence[str], how: Cutting) -> list[Segment]:
    """Returns the segments of a recording in order, without gaps; the class "" is nothing.

    A window is evidence for the `hop` frames around its middle, the first and last ones also for the ends. The windows that see
    a frame are window / hop, so each counts hop / window: the sum is the evidence of windows that don't overlap. Nothing
    competes as a class whose probability is always the threshold.
    """
    probabilities = how.confidence.of(found.scores)
    evidence = log_probabilities(probabilities)
    nothing = np.log(how.confidence.threshold) if how.confidence.threshold > 0 else -np.inf
    evidence = np.column_stack([evidence, np.full(len(evidence), nothing)])
    least = max(1, -(-how.shortest // how.hop))  # steps of a hop each
    certain = -np.log(max(how.confidence.threshold, 1 / len(class_names)))  # what chance has, where nothing is rejected
    path = best_path(evidence * min(1.0, how.hop / how.window), least, _CHANGE * certain)
    return [_segment(found, probabilities, class_names, how, *run, int(path[run[0]])) for run in runs(path)]


def _segment(
    found: WindowScores,
    probabilities: np.ndarray,
    class_names: Sequence[str],
    how: Cutting,
    first: int,
    end: int,
    label: int,
) -> Segment:
    """Returns the segment of the windows `first` to `end` (one past the last); its confidence is their mean."""
    named = label < len(class_names)
    own = probabilities[first:end]
    sure = own[:, label] if named else 1 - own.max(-1)
    start, stop = _edge(found, how, first), _edge(found, how, end)
    seconds = None if found.time is None else (float(found.time[start]), float(found.time[stop - 1]))
    return Segment(start, stop, class_names[label] if named else "", float(sure.mean()), seconds)


def _edge(found: WindowScores, how: Cutting, at: int) -> int:
    """Returns the frame at which the windows before number `at` hand over to it: halfway between their middles."""
    if at == 0:
        return 0
    if at == len(found.last):
        return found.frames
    middle = (found.last[at - 1] + found.last[at]) / 2 - (how.window - 1) / 2
    return math.floor(middle + 1)  # halves go up everywhere, so that hops between two edges keep their length
