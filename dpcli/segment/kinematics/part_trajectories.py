"""Makes the motions of all pairs of frames one: each part's motion from frame 0 to every frame."""

from __future__ import annotations

from collections import defaultdict, deque
from dataclasses import dataclass

import numpy as np

from dpcli.errors import DataError
from dpcli.ops.rotations import nearest_rotation
from dpcli.segment.rigid_motions import HOLD, bring_to_rest, fit_motions, move
from dpcli.segment.thinning import thin_evenly
from dpcli.store import CloudSequence, PartsSample

_ROUNDS = 20  # of averaging; it settles in a few
_FITS = 3  # of the motions to the tracks' mean places; these change little by then
_LEAST = 3  # points that a part needs in a frame for its motion to mean something


@dataclass(frozen=True)
class Trajectories:
    """Holds K parts that occur, over T frames.

    ids i (K): their numbers in the file. motion f64 (T,K,4,4): from frame 0 to frame t, the identity at t = 0. seen bool
    (T,K): whether the frame has points of the part; where it has none the motion is a guess. disagreement f64 (K): root
    mean square distance, over the pairs of frames, between where a pair's own motion puts the part and where `motion`
    does, in length_unit: what is known of the noise.
    """

    ids: np.ndarray
    motion: np.ndarray
    seen: np.ndarray
    disagreement: np.ndarray


def part_trajectories(sequence: CloudSequence, said: PartsSample) -> Trajectories:
    """Returns one motion from frame 0 for each part and frame that fits the motions of all pairs, both ways.

    Motions are averaged over the pairs that lead to a frame, again and again (chordal means, projected to rotations), from
    a start along the fewest pairs. Points with an identity tell each frame's motion without those of pairs, whose errors add
    up. Raises DataError for several parts in a single frame, and where a frame is reached by no pair.
    """
    ids = np.unique(sequence.part[sequence.part >= 0])
    if sequence.num_frames < 2 and len(ids) > 1:
        raise DataError(f"{sequence.name!r}: one frame only, which shows no motion; joints need two or more")
    counts = np.array([[(part == k).sum() for k in ids] for part in _frames_of(sequence.part, sequence)])
    edges = [(int(i), int(j), m[ids].astype(np.float64)) for (i, j), m in zip(said.pairs, said.motion, strict=True)]
    edges += [(j, i, np.linalg.inv(motion)) for i, j, motion in edges]
    motion = _along_fewest_pairs(sequence, edges, len(ids))
    seen = counts >= _LEAST
    for _ in range(_ROUNDS if len(edges) > 2 * (sequence.num_frames - 1) else 0):
        motion = _averaged(motion, edges, seen)
    if sequence.track is not None:
        motion = np.stack([_by_tracks(sequence, int(part), motion[:, k]) for k, part in enumerate(ids)], 1)
    return Trajectories(ids, motion, seen, _disagreement(sequence, ids, motion, edges, seen))


def _frames_of(values: np.ndarray, sequence: CloudSequence) -> list[np.ndarray]:
    return np.split(values, sequence.frame_offsets[1:-1])


def _along_fewest_pairs(sequence: CloudSequence, edges: list, parts: int) -> np.ndarray:
    motion, leading = np.tile(np.eye(4), (sequence.num_frames, parts, 1, 1)), defaultdict(list)
    for source, target, step in edges:
        leading[source].append((target, step))
    reached, queue = {0}, deque([0])
    while queue:
        here = queue.popleft()
        for target, step in leading[here]:
            if target not in reached:
                motion[target] = step @ motion[here]
                reached.add(target)
                queue.append(target)
    if lost := set(range(sequence.num_frames)) - reached:
        raise DataError(
            f"{sequence.name!r}: no pair of frames leads to frame {min(lost)}, so its motion is unknown; predict again with "
            "pairs of successive frames"
        )
    return motion


def _averaged(motion: np.ndarray, edges: list, seen: np.ndarray) -> np.ndarray:
    """Returns the motions after one round: in each frame the mean of what the pairs that lead there say."""
    total, weight = np.zeros_like(motion), np.zeros(motion.shape[:2])
    for source, target, step in edges:
        counts = (seen[source] & seen[target]) + 1e-3
        total[target] += counts[:, None, None] * (step @ motion[source])
        weight[target] += counts
    mean = total / np.maximum(weight, 1e-9)[..., None, None]
    mean[0] = np.eye(4)
    mean[..., :3, :3] = nearest_rotation(mean[..., :3, :3])
    return mean


def _by_tracks(sequence: CloudSequence, part: int, motion: np.ndarray) -> np.ndarray:
    """Returns the motions (T,4,4) that take a part's tracks, at their mean places, nearest to where each frame has them.

    motion: where it starts, which stays in frames of too few tracks.
    """
    clouds, own = _frames_of(sequence.points, sequence), _frames_of(sequence.part == part, sequence)
    clouds = [cloud[inside].astype(np.float64) for cloud, inside in zip(clouds, own, strict=True)]
    _, row, count = np.unique(sequence.track[sequence.part == part], return_inverse=True, return_counts=True)
    rows, motion = np.split(row, np.cumsum([len(cloud) for cloud in clouds])[:-1]), motion.copy()
    for _ in range(_FITS):
        back = np.concatenate([bring_to_rest(cloud, m) for cloud, m in zip(clouds, motion)])
        mean = np.stack([np.bincount(row, axis) for axis in back.T], 1) / count[:, None]
        for t, (cloud, at) in enumerate(zip(clouds, rows)):
            if len(cloud) >= HOLD:
                motion[t, :3] = fit_motions(mean[at][None], cloud[None])[0]
    return motion @ np.linalg.inv(motion[0])


def _disagreement(
    sequence: CloudSequence, ids: np.ndarray, motion: np.ndarray, edges: list, seen: np.ndarray
) -> np.ndarray:
    squares, count = np.zeros(len(ids)), np.zeros(len(ids))
    for k, part in enumerate(ids):
        points = points_at_start(sequence, int(part), motion[:, k], 64)
        for source, target, step in edges:
            if seen[source, k] and seen[target, k]:
                gap = move(step[k] @ motion[source, k], points) - move(motion[target, k], points)
                squares[k] += (gap**2).sum(1).mean()
                count[k] += 1
    return np.sqrt(squares / np.maximum(count, 1))


def points_at_start(sequence: CloudSequence, part: int, motion: np.ndarray, most: int | None = None) -> np.ndarray:
    """Returns the points of a part, from all frames, where they were in frame 0, f64 (M,3); evenly thinned to `most`.

    motion f64 (T,4,4): from frame 0 to each frame.
    """
    clouds = []
    for t, (points, ids) in enumerate(zip(_frames_of(sequence.points, sequence), _frames_of(sequence.part, sequence))):
        own = points[ids == part].astype(np.float64)
        clouds.append(bring_to_rest(own, motion[t]))
    joined = np.concatenate(clouds)
    return joined if most is None else thin_evenly(joined, most)
