"""The kernel points of a spherical convolution: where its weights sit, and how the group's rotations permute them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from dpcli.segment.network.icosahedron import GROUPS, vertices


@dataclass(frozen=True)
class KernelPoints:
    """Holds kernel points (K,3) of radius 1 seen from every rotation of a group.

    orbit f64 (D,3): the distinct positions among all R_a k; slot i64 (G,K): where R_a k is in the orbit. A kernel that
    the group maps to itself has D = K: then neighbors are weighed once for all rotations.
    """

    points: np.ndarray
    orbit: np.ndarray
    slot: np.ndarray

    @property
    def closed(self) -> bool:
        """Returns whether the group maps the kernel to itself."""
        return len(self.orbit) == len(self.points)


@lru_cache
def kernel_points(name: str, group: str) -> KernelPoints:
    """Returns the kernel points of a kind, seen from every rotation of the group.

    name: `vertices`, the center and an icosahedron's 12 vertices, closed under its rotations; `uniform`, the center and
    23 points spread over the sphere, as EPN and the release use them.
    """
    points = np.concatenate([np.zeros((1, 3)), vertices() if name == "vertices" else _spread(23)])
    rotated = np.einsum("gij,kj->gki", GROUPS[group]().rotations, points)
    orbit = list(points)
    slot = np.empty(rotated.shape[:2], np.int64)
    for place in np.ndindex(*slot.shape):
        distance = np.abs(np.array(orbit) - rotated[place]).max(-1)
        slot[place] = distance.argmin() if distance.min() < 1e-6 else len(orbit)
        if slot[place] == len(orbit):
            orbit.append(rotated[place])
    return KernelPoints(points, np.array(orbit), slot)


def _spread(count: int, steps: int = 2000) -> np.ndarray:
    """Returns unit vectors (count,3) that keep apart: charges on a sphere that repel one another, from a spiral."""
    height = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    points = np.stack([np.sqrt(1 - height**2) * np.cos(angle), np.sqrt(1 - height**2) * np.sin(angle), height], 1)
    for _ in range(steps):
        apart = points[:, None] - points
        squared = (apart**2).sum(-1) + np.eye(count)
        points = points + 2e-3 * (apart / squared[..., None] ** 1.5).sum(1)
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points - points.mean(0)
