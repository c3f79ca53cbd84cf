"""All ways of estimating the scene flow between two frames, behind the same functions: icp, nearest, a trained network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dpcli.errors import UsageError
from dpcli.ops import fps_numpy, gather_points, knn
from dpcli.segment.flow.rigid_bodies import Bodies, BodySearch, find_bodies
from dpcli.segment.rigid_motions import invert, move_each

METHODS = ("icp", "nearest")
_FEWEST, _MOST = 16, 1024  # points of a frame that ICP works with


def find_estimator(method: str) -> Path | None:
    """Returns the weights file of a trained estimator, or None for the methods that need none.

    The network is read at once, so that a damaged file ends a command before its work, and kept for the first pair.
    Raises UsageError for an unknown name, DataError for a damaged file.
    """
    if method in METHODS:
        return None
    if not Path(method).exists():
        raise UsageError(f"--flow {method}: expected {', '.join(METHODS)}, or a trained estimator's file or folder")
    from dpcli.segment.flow.model_file import find_flow_model, load_flow_model

    path = find_flow_model(method)
    load_flow_model(path)
    return path


def estimate_flow(points1: Tensor, points2: Tensor, method: str = "icp", *, device: str = "cpu") -> Tensor:
    """Returns the flow (B,N,3) f32 that takes points1 (B,N,3) to where they are in the second frame, points2 (B,M,3).

    method "nearest": to the nearest point, ties to the lowest index. "icp": few rigid bodies found by propose and
    verify (`find_bodies`), each point moved by its own. Anything else is the file or run folder of a trained estimator
    (`dpc segment flow`), run on `device`. Deterministic; the result lies on the inputs' device and carries no gradient.
    Raises UsageError for an unknown name, DataError for a damaged file, ValueError for shapes that don't fit.
    """
    if points1.ndim != 3 or points1.shape[-1] != 3 or points1.shape[::2] != points2.shape[::2]:
        raise ValueError(f"points must be (B,N,3) and (B,M,3), but are {tuple(points1.shape)}, {tuple(points2.shape)}")
    first, second = points1.detach().float(), points2.detach().float()
    if method == "nearest":
        _, nearest = knn(first, second, 1)
        return gather_points(second, nearest[..., 0]) - first
    if method == "icp":
        pairs = zip(first.cpu().numpy(), second.cpu().numpy())
        return torch.from_numpy(np.stack([estimate_body_flow(*pair) for pair in pairs])).to(points1.device)
    find_estimator(method)
    from dpcli.segment.flow.model_file import trained_flow

    return trained_flow(first, second, method, device)


def estimate_flow_both_ways(
    first: Tensor, second: Tensor, method: str, *, device: str = "cpu"
) -> tuple[Tensor, Tensor]:
    """Returns the flow forth (N,3) and back (M,3) between two frames (N,3), (M,3), by the methods of `estimate_flow`.

    ICP runs once: its bodies' motions are inverted for the way back, and each point of frame 2 belongs to the body of
    the nearest point that was moved there, so that both frames tell of the same bodies.
    """
    if method != "icp":
        both = ((first, second), (second, first))
        forth, back = (estimate_flow(a[None], b[None], method=method, device=device)[0] for a, b in both)
        return forth, back
    from scipy.spatial import cKDTree

    one, two = (cloud.numpy().astype(np.float64) for cloud in (first, second))
    bodies = find_bodies_at_any_scale(one, two)
    moved = move_each(bodies.motion[bodies.label], one)
    label = bodies.label[cKDTree(moved).query(two)[1]]
    back = move_each(invert(bodies.motion)[label], two) - two
    return torch.from_numpy(np.float32(moved - one)), torch.from_numpy(np.float32(back))


def estimate_body_flow(points1: np.ndarray, points2: np.ndarray, search: BodySearch | None = None) -> np.ndarray:
    """Returns the flow f32 (N,3) of the rigid bodies of points1 (N,3), found toward points2 (M,3); any unit of length.

    Clouds of more than 1,024 points are thinned by farthest points for the search; every point then takes the body of
    the nearest one kept. Below 16 points, or without extent, all points shift by the difference of the means.
    """
    bodies = find_bodies_at_any_scale(points1, points2, search)
    return (move_each(bodies.motion[bodies.label], points1.astype(np.float64)) - points1).astype(np.float32)


def find_bodies_at_any_scale(points1: np.ndarray, points2: np.ndarray, search: BodySearch | None = None) -> Bodies:
    """Returns what `find_bodies` finds for clouds (N,3), (M,3) of any size and unit: labels (N), motions f64 (K,3,4)."""
    center = points1.mean(0, dtype=np.float64)
    size = 2 * np.sqrt(((points1 - center) ** 2).sum(1).max())
    if min(len(points1), len(points2)) < _FEWEST or not size > 0:
        shift = points2.mean(0, dtype=np.float64) - center
        motion = np.concatenate([np.eye(3), shift[:, None]], 1)[None]
        return Bodies(np.zeros(len(points1), np.int64), motion)
    kept1, kept2 = _thin(points1), _thin(points2)
    bodies = find_bodies((points1[kept1] - center) / size, (points2[kept2] - center) / size, search)
    rotation = bodies.motion[:, :, :3]
    offset = size * bodies.motion[:, :, 3] + center - rotation @ center
    label = bodies.label
    if len(kept1) < len(points1):
        from scipy.spatial import cKDTree

        label = label[cKDTree(points1[kept1]).query(points1)[1]]
    return Bodies(label, np.concatenate([rotation, offset[:, :, None]], 2), bodies.energy, bodies.cost)


def _thin(points: np.ndarray) -> np.ndarray:
    """Returns the indices of at most 1,024 farthest points."""
    return np.arange(len(points)) if len(points) <= _MOST else fps_numpy(points, _MOST)
