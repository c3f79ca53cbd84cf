"""Ego-motion: the sensor's own motion between frames, by point-to-plane ICP on what stands."""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from dpcli.ops.open3d_import import load_open3d
from dpcli.segment.rigid_motions import move

_SCALES = ((1.0, 3.0), (0.5, 1.2), (0.3, 0.5))  # voxel and farthest partner, meters
_STEP = 2.5  # meters between the starts of the search
_STEPS = {0: 20, 1: 20, 2: 30}
_BETTER = 0.97  # of the distances at rest that a motion must leave, or the sensor stood
_DIGITS = 9  # of a motion that are kept: Open3D adds in the order in which threads end, and the last digits differ
_ACROSS = 0.08  # mean square of the normals along the level direction that they show least, if they show it well
_NEAR = 0.5  # meters from the other frame's surface at which a point is as far away as it counts
_MET = 0.15  # meters from that surface below which a point has a partner
OVERLAP = 0.35  # share of points with a partner below which two frames are not of one place


def register_frames(frames: list[np.ndarray], ground: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pose of each frame, f64 (T,4,4), frame to frame 0's coordinates, and the overlap f64 (T-1) of neighbors.

    frames: f64 (N_t,3), z up, meters; ground: bool (N_t). ICP starts at the same motion as before, at no motion, and
    at some motions around. Frames without overlap stay where the motion before takes them.
    """
    clouds = [_thin_frame(frame, own) for frame, own in zip(frames, ground)]
    poses, shares, before = [np.eye(4)], [], np.eye(4)
    for source, target in zip(clouds[1:], clouds):
        motion, share = _register_pair(source, target, before)
        shares.append(share)
        before = motion if share >= OVERLAP else before
        poses.append(poses[-1] @ before)
    return np.stack(poses), np.array(shares)


def shows_the_way(points: np.ndarray, ground: np.ndarray) -> bool:
    """Returns whether a frame f64 (N,3), z up, has surfaces across every level direction, which tell how far a sensor moved.

    Corridors, guardrails and open land hardly have any. ground: bool (N).
    """
    normals = np.asarray(_thin_frame(points, ground)[1].normals)[:, :2]
    return bool(np.linalg.eigvalsh(normals.T @ normals / max(len(normals), 1))[0] >= _ACROSS)


def _thin_frame(points: np.ndarray, ground: np.ndarray) -> list:
    """Returns the frame at every scale with normals; ground is kept in larger voxels, since it says nothing of the way."""
    open3d = load_open3d()
    clouds = []
    for voxel, _ in _SCALES:
        cloud = open3d.geometry.PointCloud()
        for own, size in ((points[~ground], voxel), (points[ground], 3 * voxel)):
            cloud += open3d.geometry.PointCloud(open3d.utility.Vector3dVector(own)).voxel_down_sample(size)
        cloud.estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(3 * voxel, 20))
        clouds.append(cloud)
    return clouds


def _register_pair(source: list, target: list, before: np.ndarray) -> tuple[np.ndarray, float]:
    """Returns the motion f64 (4,4) of the source onto the target, and the share of its points with a partner there."""
    if min(len(source[-1].points), len(target[-1].points)) < 10:
        return before, 0.0
    starts = [before, np.eye(4)]
    for x, y in product((-_STEP, 0, _STEP), repeat=2):
        start = before.copy()
        start[:2, 3] += x, y
        starts.append(start)
    tree = cKDTree(np.asarray(target[1].points))
    found = [_icp(source[0], target[0], start, 0) for start in starts]
    some = sorted(found, key=lambda motion: _away(source[1], target[1], tree, motion).mean())[:2]
    ends = []
    for motion in some:
        for scale in (1, 2):
            motion = _icp(source[scale], target[scale], motion, scale)
        ends.append((_away(source[1], target[1], tree, motion), motion))
    away, motion = min(ends, key=lambda end: end[0].mean())
    rest = _away(source[1], target[1], tree, np.eye(4))
    met = np.minimum(away, rest) < _NEAR
    if away[met].sum() >= _BETTER * rest[met].sum():
        away, motion = rest, np.eye(4)
    return motion, float((away < _MET).mean())


def _icp(source, target, start: np.ndarray, scale: int) -> np.ndarray:
    registration = load_open3d().pipelines.registration
    farthest = _SCALES[scale][1]
    loss = registration.TransformationEstimationPointToPlane(registration.TukeyLoss(farthest / 2))
    criteria = registration.ICPConvergenceCriteria(1e-6, 1e-6, _STEPS[scale])
    found = registration.registration_icp(source, target, farthest, start, loss, criteria).transformation
    return np.round(found, _DIGITS) + 0.0  # no -0


def _away(source, target, tree: cKDTree, motion: np.ndarray) -> np.ndarray:
    """Returns the distances (N) of the source's points to the target's surface, cut at `_NEAR`.

    To the surface, because the beams move with the sensor: their rings on the ground and on walls lie on one another where
    no motion is assumed, and those of a solid-state lidar, which differ from frame to frame, pass one another.
    """
    moved = move(motion, np.asarray(source.points))
    distance, partner = tree.query(moved, distance_upper_bound=2 * _NEAR)
    met = np.isfinite(distance)
    partner = partner[met]
    away = np.full(len(moved), _NEAR)
    across = (moved[met] - np.asarray(target.points)[partner]) * np.asarray(target.normals)[partner]
    away[met] = np.minimum(np.abs(across.sum(1)), _NEAR)
    return away
