"""Rounds of training pictures as tensors, made by other processes while the network learns from those before."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from dpcli.generate4d.shape.silhouette import ball_thickness
from dpcli.runtime.pool import ordered_map


class Views(Protocol):
    """Holds N pictures: rgba u8 (N,4,S,S) and depth f16 (N,4,S,S), NaN where there is no such layer."""

    rgba: np.ndarray
    depth: np.ndarray


MakeViews = Callable[[int, int], Views]  # (number of the round, count): the pictures of the round, picklable


class Batch(NamedTuple):
    """Holds pictures (B,5,S,S) as `ShapeNetwork` takes them and their layers (B,4,S,S), NaN where there is none."""

    pictures: Tensor
    depth: Tensor


@dataclass(frozen=True)
class Round:
    """Holds the pictures of a round in few bytes: rgba u8, thickness f16 (N,S,S), depth f16."""

    rgba: np.ndarray
    thickness: np.ndarray
    depth: np.ndarray

    def take(self, rows: np.ndarray) -> Batch:
        """Returns the pictures of these rows."""
        rgba = torch.from_numpy(self.rgba[rows]).float() / 255
        half = torch.from_numpy(self.thickness[rows]).float()[:, None]
        pictures = torch.cat([rgba[:, :3] * rgba[:, 3:], rgba[:, 3:], half], 1)
        return Batch(pictures, torch.from_numpy(self.depth[rows]).float())


def make_round(make: MakeViews, count: int, number: int) -> Round:
    """Makes a round and inflates its silhouettes."""
    views = make(number, count)
    half = np.stack([ball_thickness(alpha > 127) for alpha in views.rgba[:, 3]]) / views.rgba.shape[-1]
    return Round(views.rgba, half.astype(np.float16), views.depth)


class Window:
    """Holds the newest rounds; a batch is drawn from all of them alike."""

    def __init__(self, rounds: Iterator[Round], kept: int) -> None:
        self._rounds, self._held = rounds, deque(maxlen=kept)

    def advance(self) -> None:
        """Takes the next round; waits until it is made."""
        self._held.append(next(self._rounds))

    def draw(self, count: int, rng: np.random.Generator) -> Batch:
        """Draws `count` pictures, each mirrored every second time."""
        which = np.sort(rng.integers(len(self._held), size=count))
        parts = []
        for index in np.unique(which):
            own = self._held[index]
            parts.append(own.take(rng.integers(len(own.rgba), size=int((which == index).sum()))))
        order = torch.from_numpy(rng.permutation(count))
        pictures, depth = (torch.cat(tensors)[order] for tensors in zip(*parts))
        mirrored = torch.from_numpy(rng.random(count) < 0.5)[:, None, None, None]
        return Batch(*(torch.where(mirrored, x.flip(-1), x) for x in (pictures, depth)))


@contextmanager
def open_window(make: MakeViews, count: int, kept: int, at: int, end: int, jobs: int) -> Iterator[Window]:
    """Opens the window as it stands before round `at` is taken; `end`: the number of rounds. jobs: processes that make them."""
    made = ordered_map(partial(make_round, make, count), range(max(at - kept + 1, 0), end), jobs)
    try:
        window = Window((_whole(result) for _, result in made), kept)
        for _ in range(min(at, kept - 1)):
            window.advance()
        yield window
    finally:
        made.close()  # type: ignore[attr-defined]


def _whole(result: Round | Exception) -> Round:
    """Returns a round; raises what went wrong in making it."""
    if isinstance(result, Exception):
        raise result
    return result
