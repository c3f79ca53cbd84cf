"""Rotations against scipy, in numpy and in torch, and to the bit where both libraries do the same arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dpcli.ops.rotations import (
    axis_rotation,
    mean_rotation,
    motion_matrix,
    multiply_quaternions,
    nearest_rotation,
    normalize_quaternion,
    quaternion_to_matrix,
    rotate_by_quaternion,
)

BOTH = [np.asarray, torch.tensor]


def drawn(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Quaternions (w, x, y, z) and the matrices that scipy makes of them."""
    turns = Rotation.random(count, random_state=seed)
    return turns.as_quat()[:, [3, 0, 1, 2]], turns.as_matrix()


def test_quaternions_turn_and_multiply_as_scipy_says():
    (a, first), (b, second) = drawn(20, 1), drawn(20, 2)
    vectors = np.random.default_rng(3).normal(size=(20, 3))
    one, two = torch.tensor(a), torch.tensor(b)
    np.testing.assert_allclose(quaternion_to_matrix(multiply_quaternions(one, two)), first @ second, atol=1e-12)
    turned = rotate_by_quaternion(one, torch.tensor(vectors))
    np.testing.assert_allclose(turned, np.einsum("nij,nj->ni", first, vectors), atol=1e-12)
    lengths = torch.linspace(0.01, 9, 20, dtype=one.dtype)[:, None]
    np.testing.assert_allclose(normalize_quaternion(one * lengths), a, atol=1e-12)
    assert normalize_quaternion(torch.zeros(4)).tolist() == [0, 0, 0, 0]


def test_numpy_and_torch_have_one_definition_of_a_quaternion_s_matrix():
    quaternions, matrices = drawn(50, 4)
    found = quaternion_to_matrix(quaternions)
    np.testing.assert_allclose(found, matrices, atol=1e-12)
    np.testing.assert_array_equal(quaternion_to_matrix(torch.tensor(quaternions)).numpy(), found)
    assert quaternion_to_matrix(np.zeros((2, 4))).tolist() == [np.eye(3).tolist()] * 2


@pytest.mark.parametrize("kind", BOTH)
def test_no_rotation_is_nearer_than_the_nearest(kind):
    matrices = np.random.default_rng(5).normal(size=(30, 3, 3))  # half of them reflections
    near = np.asarray(nearest_rotation(kind(matrices)))
    np.testing.assert_allclose(near @ near.transpose(0, 2, 1), np.broadcast_to(np.eye(3), near.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(near), 1, atol=1e-12)
    distance = np.linalg.norm(matrices - near, axis=(1, 2))
    for _, others in (drawn(30, seed) for seed in range(40)):
        small = Rotation.from_matrix(others) ** 0.05
        for rival in (others, small.as_matrix() @ near):
            assert (np.linalg.norm(matrices - rival, axis=(1, 2)) >= distance - 1e-12).all()


@pytest.mark.parametrize("kind", BOTH)
def test_the_mean_of_rotations_is_scipy_s(kind):
    _, matrices = drawn(24, 6)
    weights = np.random.default_rng(7).random((4, 6))
    found = mean_rotation(kind(matrices.reshape(4, 6, 3, 3)), kind(weights))
    for group, share, mean in zip(matrices.reshape(4, 6, 3, 3), weights, np.asarray(found), strict=True):
        np.testing.assert_allclose(mean, Rotation.from_matrix(group).mean(share).as_matrix(), atol=1e-9)


@pytest.mark.parametrize("kind", BOTH)
def test_a_motion_s_matrix_moves_points(kind):
    _, matrices = drawn(3, 8)
    shift, points = np.random.default_rng(9).normal(size=(2, 3, 3))
    moved = np.asarray(motion_matrix(kind(matrices), kind(shift))) @ np.append(points, np.ones((3, 1)), 1)[..., None]
    expected = np.einsum("nij,nj->ni", matrices, points) + shift
    np.testing.assert_allclose(moved[..., 0], np.append(expected, np.ones((3, 1)), 1), atol=1e-12)


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 0.1), st.floats(-4, 4))
def test_axis_rotation_is_the_matrix_exponential(axis, angle):
    from scipy.linalg import expm

    x, y, z = axis = np.array(axis) / np.linalg.norm(axis)
    expected = expm(angle * np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
    np.testing.assert_allclose(axis_rotation(axis, np.array([angle]))[0], expected, atol=1e-10)
