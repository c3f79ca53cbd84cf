"""The icosahedron's 60 rotations, a rotation group, made from two of them, and the index tables a group convolution needs.

Convention: a feature f(x, a) belongs to point x and rotation R_a. Turning the cloud by a group element g gives
f'(g x, g a) = f(x, a) (thesis 4.4.1): features move to other points *and* other group elements, nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from dpcli.ops.rotations import axis_rotation

_GOLDEN = (1 + 5**0.5) / 2
_CLOSE = 1e-6  # rotations of the group differ by 0.6 and more in some entry, rounding by 1e-15


@dataclass(frozen=True)
class RotationGroup:
    """Holds a finite group of rotations with the tables of its products.

    rotations f64 (G,3,3), the identity first; product i64 (G,G): index of R_a R_b; inverse i64 (G); nearby i64 (Q): the
    elements a group convolution reaches from each a, as a Q, closed under inversion.
    """

    rotations: np.ndarray
    product: np.ndarray
    inverse: np.ndarray
    nearby: np.ndarray

    def __len__(self) -> int:
        return len(self.rotations)

    def rotations_like(self, tensor: torch.Tensor) -> torch.Tensor:
        """Returns the rotations (G,3,3) on a tensor's device, in its precision."""
        return torch.as_tensor(self.rotations, dtype=tensor.dtype, device=tensor.device)


def find_rotation(rotations: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Returns the index i64 (...) of every wanted (...,3,3) among rotations (G,3,3).

    Raises ValueError when one is not there.
    """
    distance = np.abs(wanted[..., None, :, :] - rotations).max((-1, -2))
    if distance.size and distance.min(-1).max() > _CLOSE:
        raise ValueError("a rotation is not an element of the group")
    return distance.argmin(-1)


def vertices() -> np.ndarray:
    """Returns the icosahedron's 12 vertices, unit vectors f64 (12,3)."""
    cyclic = [np.roll([0.0, a, b * _GOLDEN], shift) for shift in range(3) for a in (1, -1) for b in (1, -1)]
    return np.array(cyclic) / np.hypot(1, _GOLDEN)


def _faces() -> np.ndarray:
    """Returns the centers of the 20 faces, unit vectors: every three vertices that touch one another."""
    points = vertices()
    touch = np.isclose(points @ points.T, 1 / 5**0.5)
    found = [
        points[[i, j, k]].sum(0)
        for i in range(12)
        for j in range(i)
        for k in range(j)
        if touch[i, j] and touch[j, k] and touch[i, k]
    ]
    return np.array([f / np.linalg.norm(f) for f in found])


@lru_cache
def icosahedral_group() -> RotationGroup:
    """Returns the 60 rotations that map an icosahedron to itself.

    They are 1 identity, 24 fifth-turns, 20 third-turns and 15 half-turns. Closes the turns by 72 degrees about a vertex
    and by 120 degrees about one of its faces under products. `nearby` are the 12 elements that map a face to itself or
    to one of its three neighbors (EPN, Chen et al. 2021).

    >>> group = icosahedral_group()
    >>> len(group), len(np.unique(group.product)), len(group.nearby)  # products of elements are elements
    (60, 60, 12)
    >>> bool((group.product[np.arange(60), group.inverse] == 0).all())
    True
    """
    faces, points = _faces(), vertices()
    face = faces[np.argmax(faces @ points[0])]
    turns = [axis_rotation(axis, np.radians([turn]))[0] for axis, turn in ((points[0], 72), (face, 120))]
    rotations = [np.eye(3)]
    for element in rotations:  # grows while we walk it, until no product is new
        for turn in turns:
            candidate = turn @ element
            if min(np.abs(candidate - known).max() for known in rotations) > _CLOSE:
                rotations.append(candidate)
    stacked = np.array(rotations)
    reach = np.flatnonzero(stacked @ face @ face > 5**0.5 / 3 - 1e-6)
    return _with_tables(stacked, reach)


@lru_cache
def trivial_group() -> RotationGroup:
    """Returns the identity alone: every layer becomes its ordinary, not equivariant counterpart (an ablation)."""
    return _with_tables(np.eye(3)[None], np.array([0]))


def _with_tables(rotations: np.ndarray, nearby: np.ndarray) -> RotationGroup:
    """Returns the group with its tables; nearby: indices of the elements that a convolution reaches."""
    product = find_rotation(rotations, rotations[:, None] @ rotations[None])
    return RotationGroup(rotations, product, np.argmin(product, axis=1), nearby)


GROUPS = {"icosahedral": icosahedral_group, "trivial": trivial_group}
