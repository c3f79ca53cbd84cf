"""Findings made small: fewer damages, then fewer bytes that differ from the undamaged file (delta debugging, Zeller 2002)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TypeVar

T = TypeVar("T")


class Budget:
    """Counts tries down, and seconds; the limited test says no once none is left."""

    def __init__(self, tries: int, seconds: float) -> None:
        self.left, self.until = tries, time.monotonic() + seconds

    def limited(self, test: Callable[[Sequence[T]], bool]) -> Callable[[Sequence[T]], bool]:
        def tried(parts: Sequence[T]) -> bool:
            self.left -= 1
            return self.left >= 0 and time.monotonic() < self.until and test(parts)

        return tried


def minimal(parts: Sequence[T], test: Callable[[Sequence[T]], bool]) -> list[T]:
    """A list of parts, in their order, that passes the test and of which no part alone can be left out (ddmin).

    The whole list must pass. Where the test says no for want of a budget, the best so far is returned.
    """
    parts, cuts = list(parts), 2
    while len(parts) > 1:
        size = -(-len(parts) // cuts)
        without = (parts[:at] + parts[at + size :] for at in range(0, len(parts), size))
        smaller = next((rest for rest in without if test(rest)), None)
        if smaller is not None:
            parts, cuts = smaller, max(cuts - 1, 2)
        elif size == 1:
            break
        else:
            cuts = min(2 * cuts, len(parts))
    return parts


def differences(old: bytes, new: bytes) -> list[tuple[int, int, bytes]]:
    """The edits (start, stop in the old, bytes of the new) that turn one into the other; equal lengths: byte by byte."""
    if len(old) == len(new):
        return [(k, k + 1, new[k : k + 1]) for k in range(len(old)) if old[k] != new[k]]
    begin = next((k for k, (a, b) in enumerate(zip(old, new)) if a != b), min(len(old), len(new)))
    end = (
        next((k for k, (a, b) in enumerate(zip(old[: begin - 1 : -1], new[: begin - 1 : -1])) if a != b), 0)
        if begin
        else 0
    )
    end = min(end, len(old) - begin, len(new) - begin)
    return [(begin, len(old) - end, new[begin : len(new) - end])]


def edited(old: bytes, edits: Sequence[tuple[int, int, bytes]]) -> bytes:
    """The old bytes with the edits made, which are in the order of their places and do not overlap."""
    pieces, at = [], 0
    for start, stop, content in edits:
        pieces += [old[at:start], content]
        at = stop
    return b"".join([*pieces, old[at:]])
