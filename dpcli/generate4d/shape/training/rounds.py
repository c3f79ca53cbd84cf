"""Rounds of training pictures as tensors, made by other processes while the network learns from those before."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from dpcli.generate4d.shape.silhouette import ball_thicknesses
from dpcli.runtime.pool import ordered_map

_FIRST = 4  # rounds before the first step


class Models(Protocol):
    """Holds what a round shows; it is picklable."""

    def draw(self, device: torch.device | str) -> tuple[Tensor, Tensor]:
        """Draws N pictures on a device: rgba u8 (N,4,S,S) and depth f16 (N,4,S,S), NaN where there is no such layer."""


MakeModels = Callable[[int, int], Models]  # (number of the round, count of its pictures), picklable


class Sources(NamedTuple):
    """Holds what makes the models of a training: to learn from, to validate on, and both kinds that the confidence tells apart."""

    learned: MakeModels
    held: MakeModels
    creatures: MakeModels
    things: MakeModels


class Batch(NamedTuple):
    """Holds pictures (B,5,S,S) as `ShapeNetwork` takes them and their layers (B,4,S,S), NaN where there is none."""

    pictures: Tensor
    depth: Tensor


class Kept(NamedTuple):
    """Holds the pictures that judge a network: those of held-out models, and those (N,5,S,S) of creatures and of things."""

    held: Batch
    creatures: Tensor
    things: Tensor

    def to(self, device: torch.device) -> Kept:
        """Returns the pictures on a device."""
        return Kept(Batch(*(x.to(device) for x in self.held)), self.creatures.to(device), self.things.to(device))


@dataclass(frozen=True)
class Round:
    """Holds the pictures of a round in few bytes: rgba u8, thickness f16 (N,S,S), depth f16."""

    rgba: Tensor
    thickness: Tensor
    depth: Tensor

    def __reduce__(self) -> tuple[Any, ...]:
        """Makes the round travel between processes as arrays: of tensors torch would make a file in shared memory each."""
        return _of_arrays, (self.rgba.numpy(), self.thickness.numpy(), self.depth.numpy())

    def take(self, rows: np.ndarray) -> Batch:
        """Returns the pictures of these rows."""
        index = torch.from_numpy(rows).to(self.rgba.device)
        rgba = self.rgba[index].float() / 255
        pictures = torch.cat([rgba[:, :3] * rgba[:, 3:], rgba[:, 3:], self.thickness[index].float()[:, None]], 1)
        return Batch(pictures, self.depth[index].float())


def _of_arrays(*arrays: np.ndarray) -> Round:
    return Round(*map(torch.from_numpy, arrays))


def draw_round(models: Models, device: torch.device | str = "cpu") -> Round:
    """Draws a round and inflates its silhouettes."""
    rgba, depth = models.draw(device)
    return Round(rgba, (ball_thicknesses(rgba[:, 3] > 127) / rgba.shape[-1]).half(), depth)


def _make(make: MakeModels, count: int, drawn: bool, number: int) -> Round | Models:
    """Makes the models of a round, and its pictures where they are drawn by the same process."""
    models = make(number, count)
    return draw_round(models) if drawn else models


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
        order = torch.from_numpy(rng.permutation(count)).to(parts[0].depth.device)
        return vary(Batch(*(torch.cat(tensors)[order] for tensors in zip(*parts))), rng)


def vary(batch: Batch, rng: np.random.Generator) -> Batch:
    """Returns pictures that are mirrored every second time, stretched, rolled and recolored: no two uses are the same."""
    count, size, device = len(batch.pictures), batch.pictures.shape[-1], batch.pictures.device
    stretch, roll = np.exp(0.1 * rng.normal(size=(count, 2))), 0.1 * rng.normal(size=count)
    mirror = np.where(rng.random(count) < 0.5, -1.0, 1.0)
    change = np.zeros((count, 2, 3), np.float32)
    change[:, 0, 0], change[:, 0, 1] = mirror * stretch[:, 0] * np.cos(roll), -stretch[:, 0] * np.sin(roll)
    change[:, 1, 0], change[:, 1, 1] = mirror * stretch[:, 1] * np.sin(roll), stretch[:, 1] * np.cos(roll)
    grid = functional.affine_grid(torch.from_numpy(change).to(device), [count, 1, size, size], align_corners=False)
    stacked = torch.cat([batch.pictures, batch.depth + 9], 1)  # beyond the border is 0, which no depth is then
    moved = functional.grid_sample(stacked, grid, mode="nearest", align_corners=False)
    depth = torch.where(moved[:, 5:] == 0, torch.nan, moved[:, 5:] - 9)
    mix = 0.7 * np.eye(3) + 0.3 * rng.normal(size=(count, 3, 3))
    color = torch.einsum("nij,njhw->nihw", torch.from_numpy(mix).float().to(device), moved[:, :3]).clamp(0, 1)
    return Batch(torch.cat([color, moved[:, 3:5]], 1), depth)


@contextmanager
def open_window(
    make: MakeModels, count: int, kept: int, at: int, end: int, jobs: int, device: torch.device | str = "cpu"
) -> Iterator[Window]:
    """Opens the window as it stands before round `at` is taken; `end`: the number of rounds. jobs: processes that make them.

    The first rounds are taken at once, so that no training begins on few pictures. On a GPU this process draws them there.
    """
    drawn = torch.device(device).type == "cpu"
    first = min(kept, _FIRST) - 1
    at += first
    numbers = range(max(at - kept + 1, 0), end + first)
    with closing(ordered_map(partial(_make, make, count, drawn), numbers, jobs)) as made:
        whole = (_whole(result) for _, result in made)
        window = Window(whole if drawn else (draw_round(models, device) for models in whole), kept)
        for _ in range(min(at, kept - 1)):
            window.advance()
        yield window


def _whole(result: Any) -> Any:
    """Returns what was made; raises what went wrong in making it."""
    if isinstance(result, Exception):
        raise result
    return result
