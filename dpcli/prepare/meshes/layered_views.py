"""Pictures of a mesh with all its layers: where the ray of each pixel enters and leaves the object, once or twice.

They teach a network the shape that one picture hides. Lengths are relative to the picture, see `LayeredViews`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.ops.cameras import orbit_pose
from dpcli.prepare.meshes.animated_mesh import AnimatedMesh, bounding_sphere
from dpcli.prepare.meshes.raycast import FrameCaster, pixel_rays

_RADIUS = 0.75  # of the ball around the object, as `filming` has it
_LEAST_GAP = 0.01  # of the picture's side: what lies closer is one body


@dataclass(frozen=True)
class LayeredViews:
    """Holds N square pictures, each cut out around the object.

    rgba: u8 (N,4,S,S). depth: f16 (N,4,S,S) front_1, back_1, front_2, back_2 along the camera's z, 0 at the middle of the
    ball around the object; the unit is the side of the picture at that distance. NaN: no such layer.
    """

    rgba: np.ndarray
    depth: np.ndarray


def draw_views(mesh: AnimatedMesh, count: int, size: int, rng: np.random.Generator) -> LayeredViews:
    """Draws `count` pictures of random frames of a mesh from random cameras: any azimuth, -10 to 40 degrees of elevation.

    Pictures that show almost nothing are left out, so there may be fewer.
    """
    found = []
    frames = np.sort(rng.integers(mesh.num_frames, size=count))
    for frame in np.unique(frames):
        corners = mesh.positions[frame][np.unique(mesh.triangles)]
        center, radius = bounding_sphere(corners)
        if not radius > 0:
            continue
        scale = _RADIUS / radius
        moved = mesh.frames(frame, frame + 1).moved(np.eye(3), -scale * center, scale)
        caster = FrameCaster(moved, 0, shading=float(rng.uniform(0.2, 0.8)))
        for _ in range(int((frames == frame).sum())):
            found.append(_draw_one(caster, size, rng))
    found = [view for view in found if view is not None]
    rgba = np.stack([view[0] for view in found]) if found else np.zeros((0, 4, size, size), np.uint8)
    depth = np.stack([view[1] for view in found]) if found else np.zeros((0, 4, size, size), np.float16)
    return LayeredViews(rgba, depth)


def _draw_one(caster: FrameCaster, size: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray] | None:
    """Draws one picture u8 (4,S,S) and its layers f16 (4,S,S), None where fewer than one pixel in fifty is covered."""
    elevation = np.radians(np.clip(rng.normal(5, 12), -10, 40))
    half_view = np.radians(rng.uniform(10, 30))
    distance = _RADIUS / np.sin(half_view)
    pose = orbit_pose(rng.uniform(0, 2 * np.pi), elevation, distance)
    intrinsics, side = _cut_out(caster.positions, pose, size, rng)
    rays = pixel_rays(intrinsics, pose, slice(0, size), slice(0, size), 1).reshape(-1, 6)
    ray, hit, triangle, weights = caster.all_hits(rays)
    first = np.diff(ray, prepend=-1) > 0
    if first.sum() < size * size / 50:
        return None
    a, b, c = (caster.positions[caster.mesh.triangles[triangle, k]] for k in range(3))
    entering = np.einsum("na,na->n", np.cross(b - a, c - a), rays[ray, 3:]) < 0
    ahead = rays[ray, 3:] @ pose[2, :3].astype(np.float32)
    depth = np.full((size * size, 4), np.nan)
    depth[ray[first]] = split_hits(ray, (hit * ahead - distance) / side, entering)
    color = caster.surface(triangle[first], weights[first], rays[ray[first], 3:])
    rgba = np.zeros((size * size, 4), np.uint8)
    rgba[ray[first]] = np.rint(255 * np.concatenate([color[:, :3], np.ones((len(color), 1))], 1))
    return rgba.T.reshape(4, size, size), depth.T.reshape(4, size, size).astype(np.float16)


def _cut_out(
    points: np.ndarray, pose: np.ndarray, size: int, rng: np.random.Generator
) -> tuple[np.ndarray, float]:  # (3, 3)
    """Returns intrinsics of a square picture whose longer side the object nearly fills, and its side at the distance of
    the world's origin.
    """
    camera = points @ pose[:3, :3].T + pose[:3, 3]
    flat = camera[:, :2] / camera[:, 2:]
    low, high = flat.min(0), flat.max(0)
    extent = (high - low).max() / rng.uniform(0.86, 0.92)
    middle = (low + high) / 2 + extent * rng.uniform(-0.02, 0.02, 2)
    focal = size / extent
    shift = size / 2 - focal * middle
    return np.array([[focal, 0, shift[0]], [0, focal, shift[1]], [0, 0, 1]]), extent * pose[2, 3]


def split_hits(ray: np.ndarray, depth: np.ndarray, entering: np.ndarray) -> np.ndarray:
    """Returns front_1, back_1, front_2, back_2 f64 (R,4) of the R rays that hit something, NaN where there is one interval.

    ray i64 (H), rising; depth (H), rising along each ray; entering bool (H): the surface is seen from outside. The two
    intervals are parted at the widest gap between leaving and entering in which the ray is outside of all bodies. Where
    surfaces are open, so that a ray doesn't leave as often as it enters, any such gap may part them; where they are
    inside out, so that a ray leaves first and enters last, they are turned.
    """
    _, row, length = np.unique(ray, return_inverse=True, return_counts=True)
    column = np.arange(len(ray)) - np.repeat(np.cumsum(length) - length, length)
    shape, rows = (len(length), int(length.max()) + 1), np.arange(len(length))
    grid, sign = np.full(shape, np.nan), np.zeros(shape, int)
    grid[row, column], sign[row, column] = depth, np.where(entering, 1, -1)
    sign[(sign[:, 0] < 0) & (sign[rows, length - 1] > 0)] *= -1
    inside = sign.cumsum(1)
    outside = (sign[:, :-1] < 0) & (sign[:, 1:] > 0) & ((inside[:, :-1] <= 0) | (inside[:, -1:] != 0))
    gap = np.where(outside, np.nan_to_num(np.diff(grid, axis=1), nan=0.0), 0.0)
    cut = gap.argmax(1)
    two, last = gap[rows, cut] > _LEAST_GAP, length - 1
    found = np.full((len(length), 4), np.nan)
    found[:, 0], found[:, 1] = grid[:, 0], grid[rows, np.where(two, cut, last)]
    found[two, 2:] = np.stack([grid[rows, cut + 1], grid[rows, last]], 1)[two]
    return found
