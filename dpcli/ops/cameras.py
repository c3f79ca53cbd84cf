"""Pinhole cameras on an orbit: one convention for data readers, fitting, rendering and scoring.

World: right-handed, y up. Azimuth 0 looks from +z, positive azimuth moves toward +x; positive elevation moves up (+y).
Cameras: OpenCV axes (x right, y down, z forward), pixel centers at +0.5. Angles in radians.
"""

from __future__ import annotations

import numpy as np

DEFAULT_RADIUS = 2.0  # of an unknown camera: what Zero123-type models assume (SC4D, DreamGaussian)
DEFAULT_FOVY = np.deg2rad(49.1)


def orbit_pose(azimuth: float, elevation: float, radius: float = DEFAULT_RADIUS) -> np.ndarray:
    """Returns world_to_camera f64 (4,4) of a camera at (azimuth, elevation, radius) that looks at the origin, upright.

    >>> pose = orbit_pose(0.0, 0.0, radius=2.0)
    >>> (pose @ [0.0, 0.0, 0.0, 1.0]).tolist()  # the origin lies two units in front of it
    [0.0, 0.0, 2.0, 1.0]
    """
    position = radius * np.array(
        [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
    )
    forward = -position / np.linalg.norm(position)
    right = np.array([np.cos(azimuth), 0.0, -np.sin(azimuth)])  # stays defined straight above and below
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ position
    return pose


def orbit_of(world_to_camera: np.ndarray) -> tuple[float, float, float]:
    """Returns (azimuth, elevation, radius) of a camera's center; the inverse of `orbit_pose` for cameras that look at the origin.

    >>> [round(value, 9) for value in orbit_of(orbit_pose(0.5, -0.25, 3.0))]
    [0.5, -0.25, 3.0]
    """
    x, y, z = -world_to_camera[:3, :3].T @ world_to_camera[:3, 3]
    radius = float(np.sqrt(x * x + y * y + z * z))
    return float(np.arctan2(x, z)), float(np.arcsin(y / radius)) if radius else 0.0, radius


def pinhole(fovy: float, width: int, height: int) -> np.ndarray:
    """Returns intrinsics f64 (3,3) of a centered pinhole camera with square pixels; fovy: vertical field of view.

    >>> pinhole(np.pi / 2, 640, 480).round(9).tolist()
    [[240.0, 0.0, 320.0], [0.0, 240.0, 240.0], [0.0, 0.0, 1.0]]
    """
    focal = 0.5 * height / np.tan(0.5 * fovy)
    return np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
