"""Frames whose points have an identity: correspondences are exact, and bodies are fitted to them directly."""

from __future__ import annotations

import numpy as np

from dpcli.ops import fps_numpy
from dpcli.segment.flow.motion_proposals import cluster_patches
from dpcli.segment.multibody.frames import Frames, Trajectory, move, relative_motion
from dpcli.segment.multibody.hypotheses import Hypothesis, keep_different

_FEWEST = 4  # common points that can hold a motion
_PATCHES = (12, 40)  # of a frame, whose motions are hypotheses


class TrackedFrames(Frames):
    """Holds frames whose points are the same from frame to frame, as `tracks` i64 (n_t) say; they may begin and end.

    flexible: the deviation from a rigid motion that counts one half. A point without a counterpart in a partner frame
    isn't compared with it.
    """

    def __init__(self, clouds: list[np.ndarray], tracks: list[np.ndarray], flexible: float) -> None:
        super().__init__(clouds)
        self.scale = flexible
        found = [[_match(tracks[t], tracks[u]) for u in others] for t, others in enumerate(self.partners)]
        self.matched = np.concatenate([np.stack([at >= 0 for at in row], 1) for row in found])
        index = np.concatenate(
            [np.stack([at + self.starts[u] for at, u in zip(row, us)], 1) for row, us in zip(found, self.partners)]
        )
        self.counterpart = np.where(self.matched, index, np.arange(len(index))[:, None]).astype(np.int32)

    def explain(self, trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
        """Returns costs f32 (N) of all points under one trajectory and their counterparts i32 (N,partners)."""
        cost = np.zeros(len(self.points), np.float32)
        for t, others in enumerate(self.partners):
            own = self.slice(t)
            for column, u in enumerate(others):
                moved = move(relative_motion(trajectory, t, u), self.points[own])
                squared = ((moved - self.points[self.counterpart[own, column]]) ** 2).sum(1)
                cost[own] += squared / (squared + self.scale**2) * self.matched[own, column]
        return cost / np.maximum(self.matched.sum(1), 1), self.counterpart

    def fit(self, trajectory: Trajectory, inside: np.ndarray, own: bool, tight: float) -> Trajectory:
        """Returns a body's trajectory, frame after frame fitted (Kabsch) to its points (mask (N)) of other frames."""
        trajectory = trajectory.copy()
        for u in range(len(self)):
            source, target = [], []
            for t in self.partners[u]:
                rows, column = self.slice(t), self.partners[t].index(u) if u in self.partners[t] else None
                if column is not None:
                    both = inside[rows] & self.matched[rows, column]
                    source.append(_back(trajectory[t], self.points[rows][both]))
                    target.append(self.points[self.counterpart[rows, column][both]])
            if source and sum(map(len, source)) >= _FEWEST:
                trajectory[u] = _fit(np.concatenate(source), np.concatenate(target))
        return trajectory


def _match(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Returns where each of the one's identities is in the other, -1 where it isn't."""
    order = np.argsort(other, kind="stable")
    place = np.clip(np.searchsorted(other[order], one), 0, len(other) - 1)
    return np.where(other[order][place] == one, order[place], -1)


def _back(motion: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Returns points (n,3) moved by the inverse of a motion (3,4)."""
    return (points - motion[:, 3]) @ motion[:, :3]


def _fit(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Returns the rigid motion (3,4) that takes source (n,3) nearest to target (n,3), in the least squares."""
    a, b = source.mean(0), target.mean(0)
    left, _, right = np.linalg.svd((target - b).T @ (source - a))
    left[:, 2] *= np.linalg.det(left @ right)
    rotation = left @ right
    return np.concatenate([rotation, (b - rotation @ a)[:, None]], 1)


def patch_hypotheses(frames: TrackedFrames) -> list[Hypothesis]:
    """Returns different bodies among the motions of the whole and of patches of two sizes in three frames."""
    found = []
    for t in sorted({0, len(frames) // 2, len(frames) - 1}):
        rows = np.arange(frames.starts[t], frames.starts[t + 1])
        patches = [np.zeros(len(rows), np.int64), *(cluster_patches(frames.points[rows], k) for k in _PATCHES)]
        found += [
            Hypothesis(t, frames.points[rows[patch == k]], _spread_motion(frames, t, rows[patch == k]))
            for patch in patches
            for k in range(patch.max() + 1)
            if (patch == k).sum() >= _FEWEST
        ]
    return keep_different(frames, found)


def _spread_motion(frames: TrackedFrames, t: int, rows: np.ndarray) -> Trajectory:
    """Returns the trajectory of some points of frame t: fitted outward, from each frame to its partner nearest to t."""
    trajectory = np.tile(np.eye(3, 4), (len(frames), 1, 1))
    held = {t: rows}
    for u in sorted(range(len(frames)), key=lambda u: abs(u - t)):
        if u == t:
            continue
        before = u - 1 if u > t else u + 1
        column = frames.partners[before].index(u)
        own = held[before][frames.matched[held[before], column]]
        held[u] = frames.counterpart[own, column]
        trajectory[u] = trajectory[before]
        if len(own) >= _FEWEST:
            trajectory[u] = _fit(_back(trajectory[before], frames.points[own]), frames.points[held[u]])
    return trajectory


def thin_tracks(clouds: list[np.ndarray], tracks: list[np.ndarray], most: int) -> list[np.ndarray]:
    """Returns indices of at most `most` points of each frame (n_t,3), the same tracks in all as far as they go.

    They are the farthest points of the first frame; later ones add farthest points among those not seen before.
    """
    chosen, seen = np.zeros(0, np.int64), np.zeros(0, np.int64)
    kept = []
    for cloud, track in zip(clouds, tracks):
        here, new = np.flatnonzero(np.isin(track, chosen)), np.flatnonzero(~np.isin(track, seen))
        room = min(most - len(here), -(-most * len(new) // max(len(cloud), 1)))
        if room > 0 and len(new):
            more = new if len(new) <= room else new[fps_numpy(np.float32(cloud[new]), room)]
            chosen, here = np.concatenate([chosen, track[more]]), np.sort(np.concatenate([here, more]))
        seen = np.union1d(seen, track)
        kept.append(here[:most])
    return kept
