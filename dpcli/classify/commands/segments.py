"""`dpc classify predict --segments`: which action is when in long recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dpcli.classify.commands.model_task import ModelTask
from dpcli.classify.confidence import choose_confidence
from dpcli.classify.data.clips import check_columns
from dpcli.classify.data.likeness import tell_unlike_file
from dpcli.classify.data.videos import check_classes, report_empty, report_gaps, select_videos
from dpcli.classify.network.model_file import ModelInfo, load_model
from dpcli.classify.segments.recording import Cutting, WindowScores, cut, score_windows
from dpcli.classify.stream.sliding_window import StreamPredictor, window_size
from dpcli.counted import counted
from dpcli.errors import UsageError
from dpcli.path_names import first_names
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.runtime.whole_file import refuse_existing, write_whole
from dpcli.store import CloudsReader, input_file
from dpcli.store.tables.segments import SUFFIXES, Segment, Segments, segments_text

_HOPS_IN_WINDOW = 4  # predictions that see a frame, by default


@dataclass(frozen=True)
class SegmentOptions:
    """Says how recordings are cut: hop and shortest in frames, None: a quarter of the window and all of it; the rest as in a stream."""

    hop: int | None = None
    window: int | None = None
    shortest: int | None = None
    reject_below: str | None = None


def predict_segments(task: ModelTask, options: SegmentOptions) -> tuple[Segments, str]:
    """Returns the segments of all recordings and, as text, the file that holds them, which is written unless it is `-`.

    Raises UsageError for options that don't fit the model and for an output that exists, DataError for bad recordings.
    """
    suffix = _suffix(task)
    model, info = load_model(task.model, task.backbone)
    how = _cutting(info, options, task.model)
    device = choose_device(task.device)
    with input_file(task.data) as path:
        reader = CloudsReader(path)
        check_classes(reader, info, task.model)
        check_columns(reader, info.config)
        chosen = select_videos(reader, task.split, info, task.model)
        tell_unlike_file(reader, chosen, info, task.model)
        _tell_odd(reader, chosen, info, how.window)
        keep_freed_memory()
        recordings = {}
        with Progress("classify predict --segments", int(reader.frame_counts[chosen].sum()), "frame") as bar:
            for i in chosen:
                predictor = StreamPredictor(model, info, window=how.window, hop=how.hop, seed=task.seed, device=device)
                scored = _with_true_times(score_windows(predictor, reader, i, bar), reader.names[i])
                recordings[reader.names[i]] = cut(scored, info.class_names, how)
        entry = provenance.record(_record(task, info, how), task.seed, {"clouds": path})
        found = Segments(recordings, info.class_names, [*reader.provenance, entry])
    text = segments_text(found, suffix)
    if task.output != "-":
        write_whole(Path(str(task.output)), text.encode())
    return found, text


def _tell_odd(reader: CloudsReader, chosen: Sequence[int], info: ModelInfo, window: int) -> None:
    """Counts and names the recordings that one window sees whole, those in which seconds passed without a frame, and those with frames
    without points, with a message each."""
    short = [reader.names[i] for i in chosen if reader.frame_counts[i] < window]
    if short:
        log.info(
            f"{counted(len(short), 'recording')} of fewer than {counted(window, 'frame')}, a window, so one segment each:"
            f" {first_names(short)}"
        )
    report_gaps(reader, chosen)
    if info.timing != "slots":
        report_empty(reader, chosen)


def _suffix(task: ModelTask) -> str:
    """Returns the form of the output. Raises UsageError for another, and for a file that exists and may not be replaced."""
    if task.output == "-":
        return ".csv"
    path = Path(str(task.output))
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(f"-o {path}: segments are written as {' or '.join(SUFFIXES)}; name such a file")
    refuse_existing(path, task.force)
    return path.suffix.lower()


def _cutting(info: ModelInfo, options: SegmentOptions, model: str) -> Cutting:
    """Returns how to cut for this model. Raises UsageError for what can't be."""
    window = window_size(info, options.window)
    hop = options.hop or max(1, window // _HOPS_IN_WINDOW)
    if hop > window:
        raise UsageError(
            f"--hop {hop}: the window has {window} frames, and those between two windows would never be seen"
        )
    shortest = window if options.shortest is None else options.shortest
    if shortest < 1:
        raise UsageError(f"--shortest {shortest}: expected at least 1 frame")
    return Cutting(window, hop, shortest, choose_confidence(info.notes, options.reject_below, model))


def _with_true_times(found: WindowScores, name: str) -> WindowScores:
    """Returns the scores without times where these don't rise, and says so: a frame's number is then all that tells when."""
    if found.time is None:
        return found
    steps = np.diff(found.time)
    back = np.flatnonzero(~(steps >= 0))  # NaN, too
    if not len(back):
        return found
    at = int(back[0]) + 1
    log.warn(
        f"{name}: time runs back {counted(len(back), 'time')}, first at frame {at} ({found.time[at - 1]:g} s, then {found.time[at]:g} s);"
        " frames are taken in their order, and no seconds are written"
    )
    return replace(found, time=None)


def _record(task: ModelTask, info: ModelInfo, how: Cutting) -> dict[str, object]:
    """Returns what shapes the segments, for their provenance."""
    return {
        "segments": {"window": how.window, "hop": how.hop, "shortest": how.shortest},
        "confidence": how.confidence.notes(),
        "split": task.split,
        **task.model_record(info),
    }


def segment_counts(recordings: dict[str, list[Segment]]) -> tuple[int, int]:
    """Returns how many segments show an action, and how many nothing."""
    names = [one.name for own in recordings.values() for one in own]
    return sum(map(bool, names)), names.count("")
