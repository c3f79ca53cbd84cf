"""Points followed through the frames by flow: their motion, that less the dominant one, and labels that stay with them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

Flows = Mapping[tuple[int, int], np.ndarray]  # (t, u) -> displacement (N_t,3) of frame t's points toward frame u
_ROUNDS = 10  # of the robust fit of the dominant motion


def follow(frames: Sequence[np.ndarray], flows: Flows, t: int) -> np.ndarray:
    """Returns the displacement f64 (N_t,U,3) of frame t's points to the U other frames that flows lead to.

    The frames are in their order. Direct flow is taken where there is one; else the flow of the frame last reached,
    interpolated from its three nearest points.
    """
    reached = {t: np.asarray(frames[t], np.float64)}
    while True:
        steps = [(v != t, abs(v - u), v, u) for v, u in flows if v in reached and u not in reached and len(frames[v])]
        if not steps:
            break
        _, _, v, u = min(steps)
        flow = flows[v, u] if v == t else _interpolated(reached[v], frames[v], flows[v, u])
        reached[u] = reached[v] + flow
    others = [reached[u] - reached[t] for u in sorted(reached) if u != t]
    return np.stack(others, 1) if others else np.zeros((len(frames[t]), 0, 3))


def _interpolated(query: np.ndarray, points: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Returns the values of points (N,3) at the query (M,3), from the three nearest."""
    import torch

    from dpcli.ops import three_nn_interpolate

    tensors = (torch.from_numpy(np.ascontiguousarray(a, np.float32))[None] for a in (query, points, values))
    return three_nn_interpolate(*tensors)[0].numpy()


def residual_motion(points: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Returns the motion f64 (N,U,3) less the dominant rigid motion to each frame.

    The fit reweights its points by their distance from it (Geman & McClure), so the larger part decides.
    """
    import torch

    from dpcli.ops.rigid import weighted_kabsch

    source = torch.from_numpy(np.repeat(np.asarray(points, np.float64)[None], motion.shape[1], 0))
    target = source + torch.from_numpy(np.asarray(motion, np.float64)).transpose(0, 1)
    weights = torch.ones_like(source[..., :1])
    left = torch.zeros_like(source)
    for _ in range(_ROUNDS if motion.shape[1] else 0):
        rotation, translation = weighted_kabsch(source, target, weights)
        left = target - source @ rotation[:, 0].mT - translation
        squared = left.square().sum(-1, keepdim=True)
        scale = squared.median(1, keepdim=True).values.clamp(min=1e-8)
        weights = (1 + squared / scale).pow(-2)
    return left.transpose(0, 1).numpy()


def consistent_labels(
    frames: Sequence[np.ndarray], flows: Flows, labels: Sequence[np.ndarray], max_parts: int
) -> list[np.ndarray]:
    """Returns the labels (T of (N_t)) with ids renamed so that a part keeps the id of the frame before.

    The frame before is carried along by the flow (either direction; without one, left in place) and parts are paired
    such that the sum of IoU is largest (Hungarian). A part without partner gets an id not used so far, while there are
    some below max_parts. The first frame counts by size, the largest is 0.
    """
    renamed: list[np.ndarray] = []
    before, seen = -1, 0
    for t, own in enumerate(labels):
        ids = np.full(int(own.max(initial=-1)) + 1, -1)
        if before >= 0 and len(own):
            carried = _carried_labels(frames, flows, before, t, renamed[before])
            ids = _matched(own, carried)
        order = np.argsort(-np.bincount(own, minlength=len(ids)), kind="stable")
        for part in order[ids[order] < 0]:
            free = [i for i in range(max(seen, max_parts)) if i not in ids]
            ids[part] = next((i for i in free if i >= seen), free[0])
            seen = max(seen, ids[part] + 1)
        renamed.append(ids[own])
        before = t if len(own) else before
    return renamed


def _carried_labels(frames: Sequence[np.ndarray], flows: Flows, before: int, t: int, labels: np.ndarray) -> np.ndarray:
    """Returns, for each point of frame t, the label of the nearest point of the frame before."""
    source, query = frames[before], frames[t]
    if (before, t) in flows:
        source = source + flows[before, t]
    elif (t, before) in flows:
        query = query + flows[t, before]
    return labels[find_nearest(source, query)[1]]


def _matched(own: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Returns, for each id of own (0..K-1), the id of other that it is paired with, -1 for none."""
    from scipy.optimize import linear_sum_assignment

    shared = np.zeros((own.max() + 1, other.max() + 1))
    np.add.at(shared, (own, other), 1)
    union = shared.sum(1, keepdims=True) + shared.sum(0) - shared
    rows, columns = linear_sum_assignment(-shared / np.maximum(union, 1))
    ids = np.full(len(shared), -1)
    good = shared[rows, columns] > 0
    ids[rows[good]] = columns[good]
    return ids


def find_nearest(points: np.ndarray, query: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the distances (M) to the nearest of points (N,D) from every query (M,D), and their indices (M)."""
    from scipy.spatial import cKDTree

    return cKDTree(points).query(query)
