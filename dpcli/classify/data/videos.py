"""The choice of the videos that a command works on, and the messages about them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dpcli.classify.data.clips import ClipSource
from dpcli.classify.data.validation_split import carve_validation, labeled, people_of
from dpcli.classify.network.config import CROSS
from dpcli.classify.network.model_file import ModelInfo
from dpcli.counted import counted
from dpcli.errors import REORDER, DataError, UsageError
from dpcli.path_names import first_names
from dpcli.runtime import provenance
from dpcli.runtime.progress import log
from dpcli.store import CloudsReader

SILENT = 2.0  # seconds without a frame that are told
_JUMP = 10  # times the usual step from frame to frame, at least: slow cameras are no news


def select_videos(reader: CloudsReader, split: str, info: ModelInfo, model_name: str) -> list[int]:
    """Returns the sequences of a split, of all for `all`; `auto` is the test split where there is one, `validation` is
    `held_out` where no sample has that name. Raises DataError when there are none."""
    wanted = split
    if split == "validation" and split not in reader.splits:
        return held_out(reader, info, model_name)
    if split == "auto":
        wanted = "test" if "test" in reader.splits else "all"
    chosen = [i for i, name in enumerate(reader.splits) if wanted == "all" or name == wanted]
    if not chosen:
        raise DataError(f"{reader.path}: no sample of split {wanted!r}; it has {sorted(set(reader.splits))}")
    if split == "auto":
        log.info(f"split {wanted!r}: {len(chosen)} of {counted(len(reader), 'video')} (--split chooses)")
        _tell_trained(reader, chosen, model_name)
    return chosen


def _tell_trained(reader: CloudsReader, chosen: list[int], model_name: str) -> None:
    """Warns where videos that train are among those that were chosen for want of test videos."""
    count = sum(reader.splits[i] == "train" for i in chosen)
    if count:
        log.warn(
            f"{reader.path}: no video is of the split 'test', so all are scored; {count} of {len(chosen)} are of the split 'train',"
            f" and what {model_name} learned from comes out better than new videos do: score others (--split names a split), or"
            " hold some out before training (`dpc prepare split`)"
        )


def held_out(reader: CloudsReader, info: ModelInfo, model_name: str) -> list[int]:
    """Returns the training videos that the model's training held out for validation, by the rule and seed in its notes.

    Raises UsageError when it held none out; raises DataError when the rule needs the file it was trained on and this is another.
    """
    rule = str(info.notes.get("validation", "none"))
    if rule == "none":
        raise UsageError(
            f"--split validation: {model_name} held no video out (--validation none); ask for another split"
        )
    if rule == CROSS:
        raise UsageError(
            f"--split validation: {model_name} learned from all videos, each judged by members that never saw it; the log of its"
            " training has their accuracy (ask for another split)"
        )
    if rule.startswith("subjects:"):
        people = people_of(rule)
        found = [i for i in labeled(reader, "train") if int(reader.subjects[i]) in people]
        if not found:
            raise DataError(
                f"{reader.path}: shows none of the people whom {model_name} held out ({rule}) in its split 'train'; predict on the"
                " file that it was trained on, or ask for another split"
            )
        return found
    if info.notes.get("data") != provenance.file_digest(reader.path):
        raise DataError(
            f"{reader.path}: not the file that {model_name} was trained on, and its validation videos were drawn "
            f"from that (--validation {rule}); predict on that file"
        )
    return carve_validation(reader, rule, int(info.notes.get("seed", 0)))[1]


def check_classes(reader: CloudsReader, info: ModelInfo, model_name: str) -> None:
    """Raises DataError, which names the first class in which the file and the model differ, or, in a file that names no
    classes, the first label that the model has no class for."""
    unknown = np.flatnonzero(reader.labels >= len(info.class_names))
    if not reader.class_names and len(unknown):
        first = int(unknown[0])
        raise DataError(
            f"{reader.path}: label {reader.labels[first]} of {reader.names[first]!r}, and no names of classes;"
            f" {model_name} has {counted(len(info.class_names), 'class')}, 0 to {len(info.class_names) - 1}; write"
            " `class_names` into the file, or the model's numbers, or -1 where a video shows none of its classes"
        )
    if reader.class_names and reader.class_names != info.class_names:
        pairs = zip(reader.class_names + [""] * 99, info.class_names + [""] * 99)
        index, (mine, theirs) = next((i, pair) for i, pair in enumerate(pairs) if pair[0] != pair[1])
        why = (
            f"the model was trained for other classes; `dpc classify train ... --init {model_name}` makes one for yours"
        )
        if {*reader.class_names} <= {*info.class_names}:
            why = f"it has these classes at other places; {REORDER}"
        if not mine and index == len(reader.class_names):
            have = f"{counted(index, 'class')}, the first of the {len(info.class_names)} of {model_name}"
            raise DataError(f"{reader.path}: {have}; a map with all of them adds the others: {REORDER}")
        raise DataError(f"{reader.path}: class {index} is {mine!r}, in {model_name} it is {theirs!r}; {why}")


def report_backward(reader: CloudsReader, sequences: list[int]) -> None:
    """Counts and names the videos whose time runs back, with a message: their frames are taken in the file's order."""
    times = ((i, reader.times(i)) for i in sequences)
    names = [reader.names[i] for i, time in times if time is not None and not (np.diff(time) >= 0).all()]
    if names:
        log.warn(
            f"{reader.path}: time runs back in {len(names)} of {counted(len(sequences), 'video')}: {first_names(names)}"
            "; frames are taken in the file's order (is a recording cut wrongly?)"
        )


def report_gaps(reader: CloudsReader, sequences: Sequence[int]) -> None:
    """Counts and names the videos in which seconds passed without a frame, with a message: what a network takes for
    neighbors in time was none. Videos of a low rate have none, nor those whose time runs back."""
    found = {}
    for i in sequences:
        steps = np.diff(time) if (time := reader.times(i)) is not None else np.zeros(0)
        if len(steps) and (steps >= 0).all() and steps.max() > max(SILENT, _JUMP * np.median(steps)):
            found[i] = int(steps.argmax()), float(steps.max())
    if found:
        longest = max(found, key=lambda i: found[i][1])
        frame, seconds = found[longest]
        log.warn(
            f"{reader.path}: no frame for over {SILENT:g} s within {len(found)} of {counted(len(sequences), 'video')}:"
            f" {first_names([reader.names[i] for i in found])} (at most {seconds:.3g} s, after frame {frame} of {reader.names[longest]});"
            " the frames before and after count as neighbors: cut such recordings there"
        )


def report_short(source: ClipSource) -> None:
    """Names the videos that are dropped or padded, and those with frames without points, with a message each."""
    frames = source.config.num_frames
    longer = "each frame shown several times" if source.timing == "uniform" else "padded by holding the last frame"
    for names, what in ((source.dropped, "dropped"), (source.padded, longer)):
        if names:
            log.info(f"{counted(len(names), 'video')} of fewer than {frames} frames, {what}: {first_names(names)}")
    if source.timing != "slots":
        report_empty(source.reader, source.sequences)


def report_empty(reader: CloudsReader, sequences: Sequence[int]) -> None:
    """Counts the frames without points, which clips show as points at the origin, and names their videos, with a message."""
    ends = np.cumsum(reader.frame_counts)
    of = np.searchsorted(ends, np.flatnonzero(reader.frame_sizes == 0), side="right")
    counts = np.bincount(of, minlength=len(ends))
    found = {i: int(counts[i]) for i in sequences if counts[i]}
    if found:
        log.warn(
            f"{reader.path}: {counted(sum(found.values()), 'frame')} without points in {counted(len(found), 'video')}"
            f" taken as points at the origin: {first_names([reader.names[i] for i in found])}"
        )
