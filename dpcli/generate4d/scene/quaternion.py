"""Unit quaternions (w, x, y, z) in torch: only what moving Gaussians needs."""

from __future__ import annotations

import torch
from torch import Tensor


def normalize(
    quaternion: Tensor,  # [..., 4]
) -> Tensor:  # [..., 4]
    """Unit length; a zero quaternion stays finite."""
    return quaternion / quaternion.norm(dim=-1, keepdim=True).clamp(min=1e-8)


def multiply(
    a: Tensor,  # [..., 4]
    b: Tensor,  # [..., 4]
) -> Tensor:  # [..., 4]
    """Hamilton product: the rotation b followed by a."""
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


def to_matrix(
    quaternion: Tensor,  # [..., 4], unit
) -> Tensor:  # [..., 3, 3]
    """Rotation matrix of a unit quaternion."""
    w, x, y, z = quaternion.unbind(-1)
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
    return torch.stack(rows, -1).reshape(*quaternion.shape[:-1], 3, 3)


def rotate(
    quaternion: Tensor,  # [..., 4], unit
    vector: Tensor,  # [..., 3]
) -> Tensor:  # [..., 3]
    """The vector turned by the quaternion; shapes broadcast."""
    w, axis = quaternion[..., :1], quaternion[..., 1:]
    axis, vector = torch.broadcast_tensors(axis, vector)
    cross = torch.linalg.cross(axis, vector)
    return vector + 2 * (w * cross + torch.linalg.cross(axis, cross))
