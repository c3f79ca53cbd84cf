"""Points on an articulated object: spread over its whole surface, or what one camera sees of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dpcli.ops.open3d_import import load_open3d

_IMAGE_SIDES = (96, 192, 384, 768)  # pixels: the first that sees enough points is taken


@dataclass(frozen=True)
class SurfacePoints:
    """Holds points by where they lie: triangle i64 (N) and the weights f64 (N,3) of its corners."""

    triangle: np.ndarray
    weights: np.ndarray


def choose_on_surface(areas: np.ndarray, count: int, rng: np.random.Generator) -> SurfacePoints:
    """Draws ``count`` points, uniform over the surface, in random order. areas f64 (T), at least one positive.

    Systematic sampling over the triangles in their order, so a part's number of points differs by less than one from
    its share of the area (a plain draw would leave small parts without any).
    """
    ends = np.cumsum(areas)
    marks = (np.arange(count) + rng.random()) * (ends[-1] / count)
    triangle = np.minimum(np.searchsorted(ends, marks, side="right"), np.flatnonzero(areas)[-1])
    triangle = rng.permutation(triangle)
    u, v = np.sqrt(rng.random(count)), rng.random(count)
    return SurfacePoints(triangle, np.stack([1 - u, u * (1 - v), u * v], axis=1))


def points_on(triangles: np.ndarray, chosen: SurfacePoints) -> np.ndarray:
    """Returns where the chosen points are, f64 (N,3), in the frame the triangles (T,3,3) are given in."""
    return (triangles[chosen.triangle] * chosen.weights[..., None]).sum(1)


@dataclass(frozen=True)
class Camera:
    """Looks from ``eye`` (3) at the origin and sees a square of ``half`` x distance each way; a pinhole camera."""

    eye: np.ndarray
    half: float

    @classmethod
    def random(cls, radius: float, upright: bool, rng: np.random.Generator) -> Camera:
        """Draws a camera on a sphere about the origin, far enough to see a ball of this radius whole.

        Any direction; when the object stands upright (z up), 15 degrees below to 60 degrees above its horizon.
        """
        sine = rng.uniform(np.sin(np.radians(-15)), np.sin(np.radians(60))) if upright else rng.uniform(-1, 1)
        azimuth, cosine = rng.uniform(0, 2 * np.pi), np.sqrt(1 - sine**2)
        direction = np.array([cosine * np.cos(azimuth), cosine * np.sin(azimuth), sine])
        distance = 4 * radius
        return cls(distance * direction, float(np.tan(np.arcsin(radius / distance))))

    def rays(self, side: int, rng: np.random.Generator) -> np.ndarray:
        """Returns one ray through a random place of each of side x side pixels: origin and direction, f32 (side^2,6)."""
        ahead = -self.eye / np.linalg.norm(self.eye)
        right = np.cross(ahead, np.eye(3)[np.abs(ahead).argmin()])
        right /= np.linalg.norm(right)
        down = np.cross(ahead, right)
        pixel = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), axis=-1).reshape(-1, 2)
        y, x = (((pixel + rng.random(pixel.shape)) / side * 2 - 1) * self.half).T
        direction = ahead + x[:, None] * right + y[:, None] * down
        return np.concatenate([np.broadcast_to(self.eye, direction.shape), direction], axis=1).astype(np.float32)


def choose_visible(
    triangles: np.ndarray, poses: np.ndarray, camera: Camera, count: int, rng: np.random.Generator
) -> SurfacePoints:
    """Draws at most ``count`` points that the camera sees, at random from its pixels.

    triangles f64 (T,3,3), poses f64 (T,4,4): where each triangle stands.
    """
    scene = raycasting_scene(triangles @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3])
    for side in _IMAGE_SIDES:
        seen = first_hits(scene, camera.rays(side, rng))
        if len(seen.triangle) >= count:
            break
    chosen = rng.permutation(len(seen.triangle))[:count]
    return SurfacePoints(seen.triangle[chosen], seen.weights[chosen])


def raycasting_scene(triangles: np.ndarray) -> Any:
    """Returns Open3D's scene of triangles (T,3,3), in which rays are cast by one thread: one process per CPU is the parallelism."""
    open3d = load_open3d()
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    corners = np.ascontiguousarray(triangles.reshape(-1, 3), np.float32)
    faces = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
    scene.add_triangles(open3d.core.Tensor(corners), open3d.core.Tensor(faces))
    return scene


def first_hits(scene: Any, rays: np.ndarray) -> SurfacePoints:
    """Returns where rays f32 (R,6), origin and direction, first meet the triangles of a scene; those that meet none are left out."""
    hits = scene.cast_rays(load_open3d().core.Tensor(rays))
    seen = np.flatnonzero(np.isfinite(hits["t_hit"].numpy()))
    uv = hits["primitive_uvs"].numpy()[seen].astype(np.float64)
    weights = np.stack([1 - uv.sum(1), uv[:, 0], uv[:, 1]], axis=1)
    return SurfacePoints(hits["primitive_ids"].numpy()[seen].astype(np.int64), weights)
