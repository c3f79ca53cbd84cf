"""Rotations and rigid motions: quaternions (w, x, y, z), matrices, the nearest rotation and the mean of several.

Right-handed, for column vectors. Where a function takes arrays of either library, numpy gives numpy and torch gives
torch (differentiable); nothing here imports torch before a tensor comes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

Array = TypeVar("Array", np.ndarray, "Tensor")


def normalize_quaternion(
    quaternion: Tensor,  # [..., 4]
    least: float = 1e-8,
) -> Tensor:  # [..., 4]
    """Returns the quaternions at unit length; shorter ones than `least` are divided by that, so zero stays zero.

    >>> import torch
    >>> normalize_quaternion(torch.tensor([0.0, 3.0, 0.0, 4.0]))
    tensor([0.0000, 0.6000, 0.0000, 0.8000])
    """
    return quaternion / quaternion.norm(dim=-1, keepdim=True).clamp(min=least)


def multiply_quaternions(
    a: Tensor,  # [..., 4]
    b: Tensor,  # [..., 4]
) -> Tensor:  # [..., 4]
    """Returns the Hamilton product a b: the rotation b followed by a. Shapes broadcast.

    >>> import torch
    >>> i, j = torch.tensor([0.0, 1, 0, 0]), torch.tensor([0.0, 0, 1, 0])
    >>> multiply_quaternions(i, j), multiply_quaternions(j, i)
    (tensor([0., 0., 0., 1.]), tensor([ 0.,  0.,  0., -1.]))
    """
    import torch

    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


def quaternion_to_matrix(
    quaternion: Array,  # [..., 4], unit
) -> Array:  # [..., 3, 3]
    """Returns the rotation matrices of unit quaternions; of a zero quaternion the identity.

    >>> quaternion_to_matrix(np.array([0.0, 0.0, 0.0, 1.0])).tolist()  # half a turn about z
    [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    w, x, y, z = np.moveaxis(quaternion, -1, 0) if isinstance(quaternion, np.ndarray) else quaternion.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return _stack(rows, quaternion).reshape(*quaternion.shape[:-1], 3, 3)


def rotate_by_quaternion(
    quaternion: Tensor,  # [..., 4], unit
    vector: Tensor,  # [..., 3]
) -> Tensor:  # [..., 3]
    """Returns the vectors turned by unit quaternions: v + 2 (w (u x v) + u x (u x v)), u = (x, y, z). Shapes broadcast.

    >>> import torch
    >>> rotate_by_quaternion(torch.tensor([0.0, 0, 0, 1]), torch.tensor([1.0, 2, 3]))  # half a turn about z
    tensor([-1., -2.,  3.])
    """
    import torch

    w, axis = quaternion[..., :1], quaternion[..., 1:]
    axis, vector = torch.broadcast_tensors(axis, vector)
    cross = torch.linalg.cross(axis, vector)
    return vector + 2 * (w * cross + torch.linalg.cross(axis, cross))


def axis_rotation(
    axis: np.ndarray,  # [3], unit
    angles: np.ndarray,  # [F], radians
) -> np.ndarray:  # [F, 3, 3]
    """Returns the rotations about an axis, anticlockwise seen from its tip, by Rodrigues' formula.

    >>> axis_rotation(np.array([0.0, 0.0, 1.0]), np.array([np.pi / 2])).round().tolist()
    [[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]]
    """
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sine, cosine = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    return np.eye(3) + sine * cross + (1 - cosine) * (cross @ cross)


def rotation_matrix(
    vector: np.ndarray,  # [..., 3]
) -> np.ndarray:  # [..., 3, 3]
    """Returns the rotations by rotation vectors: about each one's direction, by its length in radians.

    >>> rotation_matrix(np.array([0.0, 0.0, np.pi / 2])).round().tolist()
    [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix().reshape(*vector.shape, 3)


def rotation_vector(
    matrix: np.ndarray,  # [..., 3, 3]
) -> np.ndarray:  # [..., 3]
    """Returns the rotation vectors, at most pi long, of rotations (or of the rotations nearest to matrices).

    >>> rotation_vector(rotation_matrix(np.array([0.1, 0.2, 0.3]))).round(6).tolist()
    [0.1, 0.2, 0.3]
    """
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_rotvec().reshape(matrix.shape[:-1])


def nearest_rotation(
    matrix: Array,  # [..., 3, 3]
) -> Array:  # [..., 3, 3]
    """Returns the rotation R, det +1, that is nearest to M = U S V^T in the Frobenius norm: U diag(1, 1, det(U V^T)) V^T.

    Kabsch 1976 with the sign of Umeyama 1991. No single answer exists where M has rank 1 or less, or a reflection's two
    least singular values are equal; one of the nearest is returned then. numpy or torch.

    >>> nearest_rotation(np.diag([2.0, 0.5, -1.0])).tolist()
    [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]
    """
    if isinstance(matrix, np.ndarray):
        linalg, join = np.linalg, np.concatenate
    else:
        import torch

        linalg, join = torch.linalg, torch.cat
    left, _, right = linalg.svd(matrix)
    return join([left[..., :2], left[..., 2:] * linalg.det(left @ right)[..., None, None]], -1) @ right


def mean_rotation(
    rotations: Array,  # [..., M, 3, 3]
    weights: Array,  # [..., M]
) -> Array:  # [..., 3, 3]
    """Returns the weighted chordal mean (Hartley et al. 2013): the rotation nearest to the weighted sum.

    >>> turns = quaternion_to_matrix(np.array([[np.cos(a), 0, 0, np.sin(a)] for a in (0.1, 0.3)]))  # by 0.2 and 0.6
    >>> mean = mean_rotation(turns, np.ones(2))
    >>> round(float(np.arctan2(mean[1, 0], mean[0, 0])), 12)
    0.4
    """
    return nearest_rotation((weights[..., None, None] * rotations).sum(-3))


def motion_matrix(
    rotation: Array,  # [..., 3, 3]
    translation: Array,  # [..., 3]
) -> Array:  # [..., 4, 4]
    """Returns rigid motions as matrices for homogeneous column vectors: x_target = M x_source.

    >>> (motion_matrix(np.eye(3), np.array([1.0, 2.0, 3.0])) @ [0.0, 0.0, 0.0, 1.0]).tolist()
    [1.0, 2.0, 3.0, 1.0]
    """
    if isinstance(rotation, np.ndarray):
        matrix = np.zeros((*rotation.shape[:-2], 4, 4), rotation.dtype)
        matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = rotation, translation, 1.0
        return matrix
    import torch

    top = torch.cat([rotation, translation[..., None]], -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1.0
    return torch.cat([top, bottom], -2)


def _stack(rows: list[Array], like: Array) -> Array:
    if isinstance(like, np.ndarray):
        return np.stack(rows, -1)
    import torch

    return torch.stack(rows, -1)
