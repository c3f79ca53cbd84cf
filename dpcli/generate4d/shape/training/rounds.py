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
from torch.nn import functional

from dpcli.generate4d.shape.silhouette import ball_thickness
from dpcli.runtime.pool import ordered_map

_FIRST = 4  # rounds before the first step


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
        """Draws `count` pictures, each changed at random as `vary` does."""
        which = np.sort(rng.integers(len(self._held), size=count))
        parts = []
        for index in np.unique(which):
            own = self._held[index]
            parts.append(own.take(rng.integers(len(own.rgba), size=int((which == index).sum()))))
        order = torch.from_numpy(rng.permutation(count))
        return vary(Batch(*(torch.cat(tensors)[order] for tensors in zip(*parts))), rng)


def vary(batch: Batch, rng: np.random.Generator) -> Batch:
    """Returns pictures that are mirrored every second time, stretched, rolled and recolored: no two uses are the same."""
    count, size = len(batch.pictures), batch.pictures.shape[-1]
    stretch, roll = np.exp(0.1 * rng.normal(size=(count, 2))), 0.1 * rng.normal(size=count)
    mirror = np.where(rng.random(count) < 0.5, -1.0, 1.0)
    change = np.zeros((count, 2, 3), np.float32)
    change[:, 0, 0], change[:, 0, 1] = mirror * stretch[:, 0] * np.cos(roll), -stretch[:, 0] * np.sin(roll)
    change[:, 1, 0], change[:, 1, 1] = mirror * stretch[:, 1] * np.sin(roll), stretch[:, 1] * np.cos(roll)
    grid = functional.affine_grid(torch.from_numpy(change), [count, 1, size, size], align_corners=False)
    stacked = torch.cat([batch.pictures, batch.depth + 9], 1)  # beyond the border is 0, which no depth is then
    moved = functional.grid_sample(stacked, grid, mode="nearest", align_corners=False)
    depth = torch.where(moved[:, 5:] == 0, torch.nan, moved[:, 5:] - 9)
    mix = 0.7 * np.eye(3) + 0.3 * rng.normal(size=(count, 3, 3))
    color = torch.einsum("nij,njhw->nihw", torch.from_numpy(mix).float(), moved[:, :3]).clamp(0, 1)
    return Batch(torch.cat([color, moved[:, 3:5]], 1), depth)


@contextmanager
def open_window(make: MakeViews, count: int, kept: int, at: int, end: int, jobs: int) -> Iterator[Window]:
    """Opens the window as it stands before round `at` is taken; `end`: the number of rounds. jobs: processes that make them.

    The first rounds are taken at once, so that no training begins on few pictures.
    """
    first = min(kept, _FIRST) - 1
    at += first
    made = ordered_map(partial(make_round, make, count), range(max(at - kept + 1, 0), end + first), jobs)
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
