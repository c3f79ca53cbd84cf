"""The orbit convention: where the camera stands, what it sees, and back again."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpcli.ops.cameras import orbit_of, orbit_pose, pinhole


def _project(point, pose, intrinsics):
    camera = pose[:3, :3] @ point + pose[:3, 3]
    pixel = intrinsics @ camera
    return pixel[:2] / pixel[2], camera[2]


@pytest.mark.parametrize(
    ("azimuth", "elevation", "center"),
    [(0, 0, (0, 0, 2)), (90, 0, (2, 0, 0)), (180, 0, (0, 0, -2)), (0, 90, (0, 2, 0)), (-90, 0, (-2, 0, 0))],
)
def test_the_camera_stands_where_the_convention_says(azimuth, elevation, center):
    pose = orbit_pose(np.deg2rad(azimuth), np.deg2rad(elevation), 2.0)
    np.testing.assert_allclose(-pose[:3, :3].T @ pose[:3, 3], center, atol=1e-12)


def test_up_is_up_and_right_is_right_in_the_picture():
    pose, intrinsics = orbit_pose(0.0, 0.0), pinhole(np.deg2rad(49.1), 100, 80)
    (center, depth), (up, _), (right, _) = (
        _project(np.array(p, float), pose, intrinsics) for p in ((0, 0, 0), (0, 0.2, 0), (0.2, 0, 0))
    )
    np.testing.assert_allclose(center, (50, 40))
    assert depth == pytest.approx(2.0) and up[1] < 40 and up[0] == pytest.approx(50) and right[0] > 50


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(0.1, 10))
def test_orbit_of_inverts_orbit_pose(azimuth, elevation, radius):
    pose = orbit_pose(azimuth, elevation, radius)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(orbit_of(pose), (azimuth, elevation, radius), atol=1e-6)


def test_the_field_of_view_spans_the_height():
    intrinsics = pinhole(np.deg2rad(60.0), 64, 32)
    top = intrinsics @ np.array([0.0, -np.tan(np.deg2rad(30.0)), 1.0])
    assert top[1] == pytest.approx(0.0, abs=1e-12)
