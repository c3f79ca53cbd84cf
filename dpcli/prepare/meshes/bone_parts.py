"""True tracks and rigid parts of an animated mesh: points carried by the surface, bones that move as one body."""

from __future__ import annotations

import numpy as np

from dpcli.prepare.meshes.animated_mesh import AnimatedMesh
from dpcli.prepare.meshes.gltf_nodes import parents_first
from dpcli.prepare.meshes.surface_points import SurfacePoints, choose_on_surface


def choose_points(mesh: AnimatedMesh, count: int, rng: np.random.Generator) -> SurfacePoints:
    """Draws ``count`` points, uniform over the surface of the first frame."""
    a, b, c = (mesh.positions[0][mesh.triangles[:, k]].astype(np.float64) for k in range(3))
    return choose_on_surface(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2, count, rng)


def track_points(mesh: AnimatedMesh, points: SurfacePoints) -> np.ndarray:
    """Returns where the points are at every frame, f32 (T,M,3): on the very triangles that are drawn."""
    corners = mesh.triangles[points.triangle]
    return np.einsum("mk,tmka->tma", points.weights, mesh.positions[:, corners]).astype(np.float32)


def heaviest_bones(mesh: AnimatedMesh, points: SurfacePoints) -> np.ndarray:
    """Returns the bone i64 (M) with the largest weight at each point; the lowest index among equals."""
    corners = mesh.triangles[points.triangle]
    total = np.zeros((len(corners), mesh.bone_pose.shape[1]))
    rows = np.arange(len(corners))[:, None]
    for k in range(3):
        np.add.at(total, (rows, mesh.bones[corners[:, k]]), points.weights[:, k, None] * mesh.weights[corners[:, k]])
    return total.argmax(1)


def rigid_parts(
    pose: np.ndarray,  # f64 (T,B,4,4) bone to world
    parent: np.ndarray,  # i64 (B), -1 for roots
    bone: np.ndarray,  # i64 (M) the bone of each point
    first: np.ndarray,  # (M,3) the points at frame 0
    tolerance: float,  # in units of length
    smallest: int,  # points
) -> np.ndarray:
    """Returns the rigid part i16 (M) of each point: 0, 1, ... in the order of their first bones.

    Bones are one part when, over the whole clip, the part carries a bone's points (root mean square) to within
    ``tolerance`` of where the bone carries them: its ancestors' part if it does, else the one that does it best; a
    part moves as its first bone. Then parts of fewer than ``smallest`` points, the smallest first, join the part that
    carries their points best. Bones without points don't count.
    """
    motion = pose @ np.linalg.pinv(pose[:1])  # frame 0 -> frame t
    group = np.full(len(parent), -1)
    found: list[int] = []  # the first bones of the parts
    for index in parents_first(parent):
        above = group[parent[index]] if parent[index] >= 0 else -1
        points = first[bone == index]
        if not len(points):
            group[index] = above
            continue
        gaps = [motion_distance(motion[:, index], motion[:, other], points) for other in found]
        near = found[int(np.argmin(gaps))] if gaps and min(gaps) <= tolerance else index
        group[index] = above if above >= 0 and gaps[found.index(above)] <= tolerance else near
        found += [index] if group[index] == index else []
    part = group[bone]
    while True:
        ids, counts = np.unique(part, return_counts=True)
        if len(ids) < 2 or counts.min() >= smallest:
            return np.searchsorted(ids, part).astype(np.int16)
        least = ids[counts.argmin()]
        points, rest = first[part == least], [other for other in ids if other != least]
        gaps = [motion_distance(motion[:, least], motion[:, other], points) for other in rest]
        part[part == least] = rest[int(np.argmin(gaps))]


def motion_distance(one: np.ndarray, other: np.ndarray, points: np.ndarray) -> float:
    """Returns how far apart two motions (T,4,4) carry points (N,3): root mean square over the points, largest over
    time.
    """
    difference = one - other
    apart = points @ difference[:, :3, :3].transpose(0, 2, 1) + difference[:, None, :3, 3]
    return float(np.sqrt((apart**2).sum(-1).mean(1)).max())
