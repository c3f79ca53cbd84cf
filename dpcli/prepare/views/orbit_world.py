"""Maps a capture's own world into ours: y up, the object at the origin in a sphere of known radius, azimuth 0 in
front.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.errors import DataError
from dpcli.runtime.progress import log

OBJECT_RADIUS = 0.75  # of the sphere around the object over all frames: the default camera sees 0.83 whole
_NEAREST = 1e-6  # of the scene's size: what is nearer lies in a camera
_SAME, _TURNED = 1e-3, 0.1  # of the scene's size: cameras in one place; and radians: what they are turned by there
_PARALLEL = 0.01  # how much shorter than 1 the mean of rays is that go one way
_LEVEL = 0.05  # of the picture's right along the upright: 3 degrees of roll
_ASKEW = 0.1  # the same at which z can't be the upright of cameras that stand level about another axis
_CLEAR = 0.3  # how far upwards the pictures' up points in the mean, at least, for its sign to be told
_AXES = np.eye(3)[[2, 1, 0]]  # z first


@dataclass(frozen=True)
class Similarity:
    """Maps x' = scale * rotation (x - center); rotation f64 (3,3), center f64 (3)."""

    scale: float
    rotation: np.ndarray
    center: np.ndarray

    def points(self, points: np.ndarray) -> np.ndarray:
        """Maps points (...,3) to f64 (...,3)."""
        return self.scale * (np.asarray(points, np.float64) - self.center) @ self.rotation.T

    def pose(self, world_to_camera: np.ndarray) -> np.ndarray:
        """Returns f64 (4,4) of the same camera in the new world: every point keeps its pixel, depths are scaled."""
        pose = np.eye(4)
        pose[:3, :3] = world_to_camera[:3, :3] @ self.rotation.T
        pose[:3, 3] = self.scale * (world_to_camera[:3, :3] @ self.center + world_to_camera[:3, 3])
        return pose


def camera_centers(poses: np.ndarray) -> np.ndarray:
    """Returns the positions f64 (V,3) of world_to_camera (V,4,4)."""
    return -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])


def up_direction(poses: np.ndarray) -> np.ndarray:
    """Returns the unit vector (3) that points up in a world of upright cameras, world_to_camera (V,4,4).

    The normal of the plane that the cameras stand in, where they stand in one (a ring); else the mean of their
    pictures' up directions.
    """
    mean = -poses[:, 1, :3].mean(axis=0)
    centers = camera_centers(poses)
    if len(poses) >= 3:
        _, spread, axes = np.linalg.svd(centers - centers.mean(axis=0), full_matrices=False)
        normal = axes[2] * np.sign(axes[2] @ mean)
        if spread[2] < 0.1 * spread[1] and normal @ mean > 0.5 * np.linalg.norm(mean):
            return normal / np.linalg.norm(normal)
    return mean / np.linalg.norm(mean)


def up_of_cameras(name: str, poses: np.ndarray) -> np.ndarray:
    """Returns the upright f64 (3) of poses world_to_camera f64 (V,4,4), OpenCV axes; the log says where it isn't z.

    Whoever films an object holds the camera level: the right of its pictures is level, and their up points upwards. name:
    of the file, for the log.
    """
    right, up = poses[:, 0, :3], -poses[:, 1, :3]
    roll, rise = np.abs(right @ _AXES.T).max(0), (up @ _AXES.T).mean(0)
    if roll[0] <= _ASKEW and rise[0] > -_CLEAR:
        return _AXES[0]
    level = [k for k in range(3) if roll[k] <= _LEVEL and abs(rise[k]) >= _CLEAR]
    if level:  # of two, as where one camera looks along an axis, the one that its pictures' up follows more
        axis = max(level, key=lambda k: abs(rise[k]))
        sign = float(np.sign(rise[axis]))
        log.info(f"{name}: {'-' if sign < 0 else ''}{'zyx'[axis]} is up, as all cameras stand level about it")
        return sign * _AXES[axis]
    if (leaning := up.mean(0) @ _AXES[0]) < _CLEAR:
        log.warn(
            f"{name}: z is taken for up, as in Blender, though up in the pictures is hardly up in it ({leaning:.2f} in the mean);"
            ' turn the poses, or name the upright: "up": [x, y, z]'
        )
    return _AXES[0]


def into_orbit(up: np.ndarray, reference: np.ndarray, center: np.ndarray, radius: float) -> Similarity:
    """Returns the similarity that puts `center` at the origin, `up` on +y, the camera `reference` (4,4) at azimuth 0.

    radius: of the object in its own world; becomes OBJECT_RADIUS. A camera straight above keeps its picture's up as
    the direction away from azimuth 0.
    """
    up = up / np.linalg.norm(up)
    position = -reference[:3, :3].T @ reference[:3, 3]
    front = position - center - ((position - center) @ up) * up
    if np.linalg.norm(front) < 1e-6 * np.linalg.norm(position - center):
        front = reference[1, :3] - (reference[1, :3] @ up) * up
    front = front / np.linalg.norm(front)
    return Similarity(
        OBJECT_RADIUS / radius, np.stack([np.cross(up, front), up, front]), np.asarray(center, np.float64)
    )


def _require_places(poses: np.ndarray) -> None:
    """Raises DataError for cameras that stand in one place and are turned differently, as those of inverted poses do."""
    centers, turned = camera_centers(poses), poses[:, :3, :3] @ poses[0, :3, :3].T
    angles = np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1))
    if np.ptp(centers, axis=0).max() <= _SAME * np.abs(centers).max() and angles.max() > _TURNED:
        raise DataError(
            f"its {len(poses)} cameras stand in one place, turned differently; expected poses of the cameras in the world"
            " (camera to world), are they inverted?"
        )


def _in_front(center: np.ndarray, poses: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Returns the center f64 (3) of an object; one that isn't before all cameras is put there where no ray tells how far it is.

    Raises DataError when the rays f64 (V,3) differ, so that cameras look at several things, or away from each other.
    """
    depths = poses[:, 2, :3] @ center + poses[:, 2, 3]
    if depths.min() > _NEAREST * max(np.abs(center).max(), 1.0):
        return center
    together = rays.mean(axis=0)
    if np.linalg.norm(together) < 1 - _PARALLEL:
        raise DataError(
            "the cameras don't look at one object in front of all of them; do the poses belong to other pictures?"
        )
    return center + (1 - depths.min()) * together


def sphere_of_silhouettes(
    intrinsics: np.ndarray, poses: np.ndarray, boxes: list[tuple[int, int, int, int]]
) -> tuple[np.ndarray, float]:
    """Returns center f64 (3) and radius of an object known by its boxes (left, top, right, bottom) in V pictures.

    The center is the point nearest to the rays through the boxes' middles (for parallel rays: nearest to the world's
    origin besides, or somewhere before the cameras); the radius is the largest extent of a box around it, at its depth.
    Raises DataError where poses can't be those of cameras around an object.
    """
    centers = camera_centers(poses)
    middles = np.array([((left + right) / 2, (top + bottom) / 2, 1) for left, top, right, bottom in boxes])
    rays = np.einsum("vji,vj->vi", poses[:, :3, :3], np.einsum("vij,vj->vi", np.linalg.inv(intrinsics), middles))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    system = across.sum(axis=0) + 1e-6 * np.eye(3)
    center = _in_front(np.linalg.solve(system, np.einsum("vij,vj->i", across, centers)), poses, rays)
    _require_places(poses)
    radius = 0.0
    for camera, pose, (left, top, right, bottom) in zip(intrinsics, poses, boxes, strict=True):
        seen = pose[:3, :3] @ center + pose[:3, 3]
        u, v = (camera @ seen)[:2] / seen[2]
        reach = max(
            (right - u) / camera[0, 0], (u - left) / camera[0, 0], (bottom - v) / camera[1, 1], (v - top) / camera[1, 1]
        )
        radius = max(radius, float(reach * seen[2]))
    return center, radius


def shares_of_boxes(
    intrinsics: np.ndarray, poses: np.ndarray, boxes: list[tuple[int, int, int, int]], sizes: list[tuple[int, int]]
) -> np.ndarray:
    """Returns f64 (V): the share of each box's width or height, whichever is less, that the other views leave possible.

    The object lies in every pyramid of a camera and its box (left, top, right, bottom, taken one pixel wider, open where it
    touches its picture of `sizes` (width, height)) and reaches each side of each box, so with right cameras all are 1. How
    far the pyramids' common part reaches in a picture is a linear-fractional program, made linear by fixing the depth.
    """
    from scipy.optimize import linprog

    seen = intrinsics @ poses[:, :3]
    planes = []
    for view, box, size in zip(seen, boxes, sizes, strict=True):
        planes.append(view[2])
        for axis in (0, 1):
            low, high = box[axis], box[axis + 2]
            if low > 0:
                planes.append(view[axis] - (low - 1) * view[2])
            if high < size[axis]:
                planes.append((high + 1) * view[2] - view[axis])
    inside = np.array(planes)
    inside /= np.linalg.norm(inside, axis=1, keepdims=True)
    bounds = [(None, None)] * 3 + [(0, None)]  # a point, scaled so that its depth is 1, and the scale
    shares = np.ones(len(seen))
    for number, (view, box) in enumerate(zip(seen, boxes, strict=True)):
        for axis in (0, 1):
            middle, extent = (box[axis] + box[axis + 2]) / 2, box[axis + 2] - box[axis]
            across = (view[axis] - middle * view[2]) / extent  # -0.5 to 0.5 within the box
            reach = 0.0
            for sign in (-1, 1):
                most = linprog(
                    -sign * across, A_ub=-inside, b_ub=np.zeros(len(inside)), A_eq=view[2:], b_eq=[1], bounds=bounds
                )
                reach += min(-most.fun, 0.5) if most.status == 0 else 0.0 if most.status == 2 else 0.5
            shares[number] = min(shares[number], max(reach, 0.0))
    return shares
