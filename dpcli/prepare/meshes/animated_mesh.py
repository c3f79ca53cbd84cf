"""A triangle mesh that moves: what glTF files and procedural creatures become before they are filmed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np


@dataclass(frozen=True)
class Texture:
    """Holds a picture on a surface: sRGB u8 (H,W,4), alpha in the last channel; wrap: repeat | mirror | clamp.

    change: f64 (2,3) affine map of the coordinates before they are looked up, or None. nearest: pixels are squares.
    """

    pixels: np.ndarray
    wrap: tuple[str, str] = ("repeat", "repeat")
    change: np.ndarray | None = None
    nearest: bool = False


@dataclass(frozen=True)
class Material:
    """Holds color, a linear RGBA factor; blend: opaque | mask | blend, with `cutoff` for mask; unlit: no shading.

    emission: linear RGB that is added to what the light shows, times `emission_texture`.
    """

    color: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    texture: Texture | None = None
    blend: str = "opaque"
    cutoff: float = 0.5
    unlit: bool = False
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emission_texture: Texture | None = None


@dataclass(frozen=True)
class AnimatedMesh:
    """Holds T frames of V vertices and F triangles, baked; B bones.

    time: f64 (T) seconds. positions, normals: f32 (T,V,3). triangles: i64 (F,3). material: i64 (F) into `materials`.
    color: linear RGBA f32 (V,4). uv: f32 (V,2), v downwards. bones i64 and weights f32 (V,J): skinning, sums 1.
    bone_pose: f64 (T,B,4,4) bone to world. bone_parent: i64 (B), -1 for roots; parents may come after children.
    emission_uv: f32 (V,2) where the emission's textures are looked up, None: at uv. one_sided: bool (F) triangles that
    are not seen from behind, None: all are seen from both sides.
    """

    name: str
    time: np.ndarray
    positions: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    material: np.ndarray
    materials: tuple[Material, ...]
    color: np.ndarray
    uv: np.ndarray
    bones: np.ndarray
    weights: np.ndarray
    bone_pose: np.ndarray
    bone_parent: np.ndarray
    bone_name: tuple[str, ...] = field(default=())
    emission_uv: np.ndarray | None = None
    one_sided: np.ndarray | None = None

    @property
    def num_frames(self) -> int:
        """Returns the number of frames."""
        return len(self.time)

    def frames(self, start: int, stop: int) -> AnimatedMesh:
        """Returns frames start to stop - 1 alone; small enough to send to another process."""
        cut = slice(start, stop)
        kept = {key: getattr(self, key)[cut] for key in ("time", "positions", "normals", "bone_pose")}
        return replace(self, **kept)

    def moved(self, rotation: np.ndarray, shift: np.ndarray, scale: float) -> AnimatedMesh:
        """Applies x -> scale R x + shift; shift (3), or (T,3): one per frame."""
        shift = np.broadcast_to(np.asarray(shift, np.float64), (self.num_frames, 3))
        change = np.tile(np.eye(4), (self.num_frames, 1, 1))
        change[:, :3, :3], change[:, :3, 3] = scale * rotation, shift
        positions = scale * (self.positions @ rotation.T) + shift[:, None]
        normals = (self.normals @ rotation.T).astype(np.float32)
        pose = change[:, None] @ self.bone_pose
        return replace(self, positions=positions.astype(np.float32), normals=normals, bone_pose=pose)


def bounding_sphere(points: np.ndarray, steps: int = 300) -> tuple[np.ndarray, float]:
    """Returns center f64 (3) and radius of a small ball that holds points (N,3).

    Badoiu and Clarkson (2003): step i moves the center by 1/(i+1) toward the farthest point; within 1/sqrt(steps)
    of the smallest ball. Started at the middle of the box, it ends far closer than that.
    """
    points = np.asarray(points, np.float64)
    outer = _extreme(points)
    center = (outer.min(0) + outer.max(0)) / 2
    for step in range(steps):
        farthest = outer[((outer - center) ** 2).sum(1).argmax()]
        center = center + (farthest - center) / (step + 5)
    return center, float(np.sqrt(((points - center) ** 2).sum(1).max()))


def normalized(mesh: AnimatedMesh, radius: float, yaw: float = 0.0, travel: bool = True) -> AnimatedMesh:
    """Returns the mesh in a ball of this radius around the origin, over all frames together.

    yaw: radians about the upright, y. travel=False: takes out the level (x, z) motion of the middle, as on a treadmill.
    """
    if not travel:
        middle = mesh.positions.mean(axis=1, dtype=np.float64) * [1, 0, 1]
        mesh = mesh.moved(np.eye(3), middle[0] - middle, 1.0)
    corners = np.unique(mesh.triangles)
    center, size = bounding_sphere(mesh.positions[:, corners].reshape(-1, 3))
    cosine, sine = np.cos(yaw), np.sin(yaw)
    rotation = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    scale = radius / max(size, 1e-12)
    return mesh.moved(rotation, -scale * rotation @ center, scale)


def _extreme(points: np.ndarray, directions: int = 512) -> np.ndarray:
    """Returns the points that can touch a bounding ball, nearly: the farthest in each of many directions; millions are
    slow.
    """
    if len(points) < 2_000:
        return points
    k = np.arange(directions) + 0.5
    polar, azimuth = np.arccos(1 - 2 * k / directions), np.pi * (1 + 5**0.5) * k  # a Fibonacci lattice on the sphere
    lattice = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)])
    return points[np.unique([(points @ direction).argmax() for direction in lattice.T.astype(points.dtype)])]
