"""A spinning lidar among triangles: one ray for each beam and step of the turn, range noise, drop-out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.ops.open3d_import import load_open3d
from dpcli.prepare.meshes.surface_points import raycasting_scene


@dataclass(frozen=True)
class Lidar:
    """Holds the beams (their elevations, degrees, the highest first), steps of a turn, height and farthest range (m)."""

    elevations: tuple[float, ...]
    steps: int
    far: float = 100.0
    height: float = 1.73


LIDARS = {
    64: Lidar((*np.linspace(2, -8.33, 32), *np.linspace(-8.87, -24.33, 32)), 2000, 120.0),  # Velodyne HDL-64E
    32: Lidar(tuple(np.linspace(10.67, -30.67, 32)), 2160, 100.0, 1.84),  # HDL-32E
    16: Lidar(tuple(np.linspace(15, -15, 16)), 1800, 100.0),  # VLP-16
}


def lidar_rays(lidar: Lidar, rng: np.random.Generator) -> np.ndarray:
    """Returns the unit directions f32 (steps * beams,3), x ahead and z up, from a random first step on."""
    turn = 2 * np.pi * (np.arange(lidar.steps) + rng.uniform()) / lidar.steps
    azimuth, elevation = np.meshgrid(turn, np.radians(lidar.elevations), indexing="ij")
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1)
    return rays.reshape(-1, 3).astype(np.float32)


def scan(
    triangles: np.ndarray, lidar: Lidar, noise: float, dropout: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Returns points f32 (N,3) and the triangle i64 (N) of each, as a lidar at the origin sees triangles (T,3,3).

    noise: standard deviation of ranges, meters. dropout: share of the rays lost anywhere; those that meet a surface
    at a small angle or far away are lost more often.
    """
    scene, rays = raycasting_scene(triangles), lidar_rays(lidar, rng)
    hits = scene.cast_rays(load_open3d().core.Tensor(np.concatenate([np.zeros_like(rays), rays], 1)))
    reach = hits["t_hit"].numpy()
    facing = np.abs((hits["primitive_normals"].numpy() * rays).sum(1))
    lost = dropout + 0.5 * np.exp(-facing / 0.05) + 0.3 * (np.minimum(reach, lidar.far) / lidar.far) ** 2
    seen = (reach < lidar.far) & (reach > 1.0) & (rng.uniform(size=len(rays)) > lost)
    measured = reach[seen] + rng.normal(0, noise, seen.sum()).astype(np.float32)
    return rays[seen] * measured[:, None], hits["primitive_ids"].numpy()[seen].astype(np.int64)
