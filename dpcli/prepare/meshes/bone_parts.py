"""True tracks and rigid parts of an animated mesh: points carried by the surface, bones that move as one body."""

from __future__ import annotations

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.meshes.animated_mesh import SHRUNK, AnimatedMesh
from dpcli.prepare.meshes.gltf_nodes import parents_first
from dpcli.prepare.meshes.surface_points import SurfacePoints, choose_on_surface


def choose_points(mesh: AnimatedMesh, count: int, rng: np.random.Generator) -> SurfacePoints:
    """Draws ``count`` points, uniform over the surface of the first frame and of what is hidden there.

    A triangle that is never seen gets none; one that is shrunk then, below a hundredth of what it becomes, counts with
    its largest area in the clip.
    """
    areas = [mesh.areas(frame) for frame in range(mesh.num_frames)]
    largest = np.max(areas, axis=0)
    if not largest.any():
        raise DataError(f"{mesh.name}: no triangle has an area in any frame; expected a surface")
    return choose_on_surface(np.where(areas[0] < SHRUNK * largest, largest, areas[0]), count, rng)


def hidden_points(mesh: AnimatedMesh, points: SurfacePoints) -> np.ndarray:
    """Returns bool (T,M): in which frames a point's triangle is shrunk to nothing, below 1/10,000 of its largest area."""
    return ~mesh.shown()[:, points.triangle]


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
    track: np.ndarray,  # (T,M,3) the points
    tolerance: float,  # in units of length
    smallest: int,  # points
) -> np.ndarray:
    """Returns the rigid part i16 (M) of each point: 0, 1, ... in the order of their first bones.

    Bones are one part when, over the whole clip, the part carries a bone's points (root mean square) to within
    ``tolerance`` of where the bone carries them: its ancestors' part if it does, else the one that does it best; a
    part moves as its first bone. A bone's motion counts from frame 0, or, where its points are shrunk to a point then,
    from where they reach farthest. Then parts of fewer than ``smallest`` points, the smallest first, join the part that
    carries their points best. Bones without points don't count.
    """
    starts = _starts(track, bone, len(parent))
    motions = {start: pose @ np.linalg.pinv(pose[start]) for start in set(starts.tolist())}  # start -> frame t
    group = np.full(len(parent), -1)
    found: list[int] = []  # the first bones of the parts
    for index in parents_first(parent):
        above = group[parent[index]] if parent[index] >= 0 else -1
        motion, points = motions[starts[index]], track[starts[index], bone == index].astype(np.float64)
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
        motion, points = motions[starts[least]], track[starts[least], part == least].astype(np.float64)
        rest = [other for other in ids if other != least]
        gaps = [motion_distance(motion[:, least], motion[:, other], points) for other in rest]
        part[part == least] = rest[int(np.argmin(gaps))]


def _starts(track: np.ndarray, bone: np.ndarray, bones: int) -> np.ndarray:
    """Returns the frame i64 (B) that each bone's motion counts from."""
    starts = np.zeros(bones, np.int64)
    for index in np.unique(bone):
        reach = np.linalg.norm(np.ptp(track[:, bone == index], axis=1), axis=1)
        starts[index] = reach.argmax() if reach[0] < SHRUNK * reach.max() else 0
    return starts


def motion_distance(one: np.ndarray, other: np.ndarray, points: np.ndarray) -> float:
    """Returns how far apart two motions (T,4,4) carry points (N,3): root mean square over the points, largest over
    time.
    """
    difference = one - other
    apart = points @ difference[:, :3, :3].transpose(0, 2, 1) + difference[:, None, :3, 3]
    return float(np.sqrt((apart**2).sum(-1).mean(1)).max())
