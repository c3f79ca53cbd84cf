"""Fewer points per frame: random, farthest point or voxel sampling."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dpcli.errors import UsageError
from dpcli.prepare.reader import offsets
from dpcli.store import CloudSequence

METHODS = ("random", "fps", "voxel")
_SEARCH_STEPS = 20
_CLOSE_ENOUGH = 1.05  # this many times more cubes than points: the rest is drawn at random


@dataclass(frozen=True)
class Thinning:
    """Keeps at most ``points`` points per frame, chosen by ``sampling``; smaller frames are kept whole. 0 = keep all."""

    points: int = 0
    sampling: str = "random"

    def __post_init__(self) -> None:
        if self.points < 0:
            raise UsageError(f"--points {self.points}: expected 0 (keep all) or more")
        if self.sampling not in METHODS:
            raise UsageError(f"--sampling {self.sampling}: expected one of {', '.join(METHODS)}")

    def choose(self, cloud: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Returns indices i64 (min(N, points)) into one frame f32 (N,3).

        ``random`` and ``voxel`` keep the frame's own order. ``fps`` starts at point 0 and keeps the order of
        choice, so that every prefix of the frame is a farthest point sample too.
        """
        if self.sampling == "fps":
            from dpcli.ops import fps_numpy

            return np.asarray(fps_numpy(cloud, self.points))
        if self.sampling == "random":
            return self._draw(len(cloud), rng)
        candidates = voxel_representatives(cloud, self.points)
        return candidates[self._draw(len(candidates), rng)]

    def _choose_again(self, frame: np.ndarray, rank: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Returns indices i64 (min(N, points)) into one frame f32 (N,3): first of the points of rank 0 or more, i64 (N), the
        lowest, then what `choose` takes of the others.
        """
        if len(frame) <= self.points:
            return np.arange(len(frame))
        again = np.flatnonzero(rank >= 0)
        index = again[np.argsort(rank[again])][: self.points]
        others = np.setdiff1d(np.arange(len(frame)), index)
        if more := self.points - len(index):
            index = np.concatenate([index, others[replace(self, points=more).choose(frame[others], rng)]])
        return index if self.sampling == "fps" else np.sort(index)

    def _draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        return np.sort(rng.choice(count, self.points, replace=False))

    def apply(self, sequence: CloudSequence, rng: np.random.Generator) -> CloudSequence:
        """Returns the sequence with each frame thinned; per-point fields follow their points.

        Points with identities keep them: those chosen in an earlier frame come first, and only what they leave is drawn.
        """
        counts = np.diff(sequence.frame_offsets)
        if self.points == 0 or counts.max(initial=0) <= self.points:
            return sequence
        chosen = []
        tracks = None if sequence.track is None else np.unique(sequence.track, return_inverse=True)[1].reshape(-1)
        rank = np.full(0 if tracks is None else tracks.max() + 1, -1)  # of a track: how many were chosen before it
        known = 0
        for start, count in zip(sequence.frame_offsets[:-1], counts, strict=True):
            frame = sequence.points[start : start + count]
            if tracks is None:
                index = self.choose(frame, rng) if count > self.points else np.arange(count)
            else:
                own = tracks[start : start + count]
                index = self._choose_again(frame, rank[own], rng)
                fresh = own[index][rank[own[index]] < 0]
                rank[fresh] = known + np.arange(len(fresh))
                known += len(fresh)
            chosen.append(index + start)
        sequence.take_points(np.concatenate(chosen), offsets(np.array([len(c) for c in chosen], np.int64)))
        return sequence


def voxel_representatives(cloud: np.ndarray, points: int) -> np.ndarray:
    """Returns one point per occupied cube of the coarsest grid found that still has at least ``points`` occupied cubes.

    cloud: f32 (N,3), N >= points -> sorted indices i64 (M), points <= M <= N; the first point of a cube stands for it.

    >>> cloud = np.array([[0, 0, 0], [0.1, 0, 0], [1, 0, 0], [1.1, 0, 0]], np.float32)
    >>> voxel_representatives(cloud, 2).tolist()
    [0, 2]
    """
    shifted = cloud - cloud.min(0)
    extent = float(shifted.max())
    best = np.arange(len(cloud))
    fine, coarse, edge = 0.0, extent, extent / np.sqrt(points)
    for _ in range(_SEARCH_STEPS if extent > 0 else 0):
        first = _first_in_voxel(shifted, edge)
        if len(first) < points:
            coarse = edge
        else:
            fine, best = edge, first
            if len(first) <= points * _CLOSE_ENOUGH:
                break
        # a depth camera sees surfaces: the number of occupied cubes goes like 1 / edge^2
        guess = edge * np.sqrt(len(first) / (points * (1 + _CLOSE_ENOUGH) / 2))
        edge = guess if fine < guess < coarse else (fine + coarse) / 2
    return best


def _first_in_voxel(shifted: np.ndarray, edge: float) -> np.ndarray:
    cell = (shifted / np.float32(edge)).astype(np.int64)
    size = cell.max(0) + 1
    key = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    return np.sort(np.unique(key, return_index=True)[1])
