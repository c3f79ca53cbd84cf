"""Doubts about a table of true segments: classes that are never predicted, and frames counted in another way than ours."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from dpcli.errors import DataError
from dpcli.evaluate.results import list_names
from dpcli.runtime.progress import log
from dpcli.store.tables.segments import Segment, Segments

_LEAST = 2  # gaps of one frame that tell ends which belong to their segment
_SHORT = 0.5  # of the predicted frames: a truth that ends before may be in seconds


def check_classes(predicted: Segments, true: Segments, names: Sequence[str], truth: str) -> None:
    """Warns of true classes that are not among those predicted: none of their frames can be right.

    names: the recordings that both have; truth: the true table as it was named. Raises DataError where no class is, or
    where two differ in capitals alone.
    """
    said = {*predicted.class_names, *_classes(predicted, names)} - {""}
    given = _classes(true, names) - {""}
    if given and said and not given & said:
        raise DataError(
            f"{truth}: its classes ({list_names(sorted(given))}) are none of those predicted ({list_names(sorted(said))}); "
            "spell them alike"
        )
    lower = {name.casefold(): name for name in sorted(said)}
    strange = sorted(given - said)
    for name in strange:
        if name.casefold() in lower:
            raise DataError(f"{truth}: its class {name!r} is predicted as {lower[name.casefold()]!r}; spell them alike")
    if strange and said:
        log.warn(
            f"{truth}: nothing is predicted to be {list_names(strange)}, so their frames count as wrong; where they mean that"
            " nothing happens, leave the class empty"
        )


def doubts_of_frames(predicted: Segments, true: Segments, names: Sequence[str]) -> Iterator[str]:
    """Yields, in words, what makes it likely that the true frames count in another way: ends that belong to their segments,
    a count from 1, or seconds. names: the recordings that both have.
    """
    tables = [true.recordings[name] for name in names]
    gaps = [after.start - one.end for own in tables for one, after in zip(own, own[1:])]
    if 0 not in gaps and gaps.count(1) >= max(_LEAST, len(gaps) / 2):
        one = next(one for own in tables for one, after in zip(own, own[1:]) if after.start - one.end == 1)
        yield (
            f"its ends seem to belong to their segments ({_frames(one)}, and the next begins at {one.end + 1}); `end` is one"
            " past the last frame: add 1"
        )
    if all(own[0].start == 1 for own in tables) and (len(tables) > 1 or 1 in gaps):
        yield "its frames seem to count from 1, as all recordings begin there; frames count from 0: take 1 off each start"
    ends = [(name, true.recordings[name][-1].end, predicted.recordings[name][-1].end) for name in names]
    late = [f"{name} (frame {end}, predicted to {own})" for name, end, own in ends if end > own]
    if late:
        yield (
            f"names frames behind the last predicted one in {list_names(late)}; frames of another rate, counted from 1, or those"
            " too that `dpc prepare` left out since they showed nothing?"
        )
    elif ends and all(end <= _SHORT * own for _, end, own in ends):
        name, end, own = ends[0]
        yield f"ends at frame {end} of {name}, predicted to {own}, and early in all; are these frames, not seconds?"


def _classes(table: Segments, names: Sequence[str]) -> set[str]:
    return {one.name for name in names for one in table.recordings[name]}


def _frames(one: Segment) -> str:
    return f"{one.start} to {one.end}"
