"""Videos that are in a file more than once, and a warning where a copy judges what learned from the other.

A recording that was exported twice, or that is both in the folder of the training and of the test videos, is recognized because it
was seen: the accuracy then says nothing about new videos.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence

import numpy as np

from dpcli.classify.data.validation_split import class_table
from dpcli.counted import counted
from dpcli.path_names import first_names
from dpcli.runtime.progress import log
from dpcli.store import CloudsReader

_TELLING = 8  # points of a video, at least: fewer may be equal by chance, as a radar rounds what it measures


def copy_groups(reader: CloudsReader, sequences: Iterable[int]) -> list[list[int]]:
    """Returns the groups, of two or more sequences each, whose frames have the same points in the same order."""
    some = np.array(sorted(set(sequences)), np.int64)
    groups: dict[object, list[int]] = {}
    if len(some):
        shapes = np.stack([reader.frame_counts[some], reader.point_counts[some]], 1)
        _, of, counts = np.unique(shapes, axis=0, return_inverse=True, return_counts=True)
        for i in some[(counts[of.ravel()] > 1) & (shapes[:, 1] >= _TELLING)].tolist():
            video = reader.read(i, fields=())
            content = hashlib.blake2b(np.ascontiguousarray(video.points).tobytes())
            content.update(np.diff(video.frame_offsets).tobytes())
            groups.setdefault(content.digest(), []).append(i)
    return [group for group in groups.values() if len(group) > 1]


def tell_copies(reader: CloudsReader, rounds: Sequence[tuple[Sequence[int], Sequence[int]]]) -> None:
    """Warns of videos that are judged after a copy of them was learned from, and of copies with different labels.

    rounds: sequences that are learned from, and those that are judged by what learned.
    """
    groups = copy_groups(reader, (i for learned, judged in rounds for i in (*learned, *judged)))
    if not groups:
        return
    of = {i: number for number, group in enumerate(groups) for i in group}
    seen: dict[int, int] = {}  # of a judged video, one that was learned from
    for learned, judged in rounds:
        known = {of[i]: int(i) for i in learned if i in of}
        seen |= {int(i): known[of[i]] for i in judged if of.get(i) in known}
    names = reader.names
    if seen:
        log.warn(
            f"{reader.path}: {counted(len(seen), 'video')} that {'is' if len(seen) == 1 else 'are'} judged, by validation or as a test,"
            " after a copy with the same points was learned from, so the accuracy is higher than that of new videos:"
            f" {first_names([f'{names[i]} = {names[k]}' for i, k in seen.items()])}; leave one of each pair out"
        )
    mixed = [group for group in groups if len({int(reader.labels[i]) for i in group}) > 1]
    if mixed:
        classes = class_table(reader)
        shown = [" = ".join(f"{names[i]} ({classes[reader.labels[i]]})" for i in group) for group in mixed]
        log.warn(
            f"{reader.path}: the same points under different labels, of which one must be wrong: {first_names(shown)}"
        )
