"""A triangle mesh that moves: what glTF files and procedural creatures become before they are filmed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dpcli.prepare.bounding_sphere import bounding_sphere

SHRUNK = 0.01  # of the largest reach in the clip: what is smaller shows nothing


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

    @property
    def is_clear(self) -> bool:
        """Returns whether its alpha leaves nothing to be seen, whatever texture it has."""
        alpha = self.color[3]
        return (self.blend == "blend" and alpha == 0) or (self.blend == "mask" and alpha < self.cutoff)


@dataclass(frozen=True)
class AnimatedMesh:
    """Holds T frames of V vertices and F triangles, baked; B bones.

    time: f64 (T) seconds. positions, normals: f32 (T,V,3). triangles: i64 (F,3). material: i64 (F) into `materials`.
    color: linear RGBA f32 (V,4). uv: f32 (V,2), v downwards. bones i64 and weights f32 (V,J): skinning, sums 1.
    bone_pose: f64 (T,B,4,4) bone to world. bone_parent: i64 (B), -1 for roots; parents may come after children.
    emission_uv: f32 (V,2) where the emission's textures are looked up, None: at uv. one_sided: bool (F) triangles that
    are not seen from behind, None: all are seen from both sides. faceted: bool (F) triangles that are lit by the plane they
    lie in, not by the normals of their corners, None: none. turned: bool (T,F) which triangles are mirrored in a frame, so that
    their front is where they run clockwise, None: none.
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
    emission_uv: np.ndarray | None = None
    one_sided: np.ndarray | None = None
    faceted: np.ndarray | None = None
    turned: np.ndarray | None = None

    @property
    def num_frames(self) -> int:
        """Returns the number of frames."""
        return len(self.time)

    def areas(self, frame: int) -> np.ndarray:
        """Returns the areas f64 (F) of the triangles in a frame, 0 where their material leaves nothing to be seen."""
        a, b, c = (self.positions[frame][self.triangles[:, k]].astype(np.float64) for k in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        clear = np.array([material.is_clear for material in self.materials], bool)
        return np.where(clear[self.material], 0.0, area) if clear.any() else area

    def shown(self) -> np.ndarray:
        """Returns bool (T,F): whether a triangle shows something in a frame, above 1/10,000 of its largest area in the clip."""
        areas = np.stack([self.areas(frame) for frame in range(self.num_frames)])
        return areas > SHRUNK**2 * areas.max(0)

    def seen_corners(self) -> np.ndarray:
        """Returns bool (T,V): whether a vertex is a corner of a triangle that shows something in a frame.

        What is shrunk to nothing then, is never seen or has no area doesn't count, nor do vertices without triangles.
        """
        seen = np.zeros(self.positions.shape[:2], bool)
        for frame, triangles in enumerate(self.shown()):
            seen[frame, self.triangles[triangles]] = True
        return seen

    def frames(self, start: int, stop: int) -> AnimatedMesh:
        """Returns frames start to stop - 1 alone; small enough to send to another process."""
        cut = slice(start, stop)
        kept = {key: getattr(self, key)[cut] for key in ("time", "positions", "normals", "bone_pose")}
        return replace(self, **kept, turned=None if self.turned is None else self.turned[cut])

    def moved(self, rotation: np.ndarray, shift: np.ndarray, scale: float) -> AnimatedMesh:
        """Applies x -> scale R x + shift; shift (3), or (T,3): one per frame."""
        shift = np.broadcast_to(np.asarray(shift, np.float64), (self.num_frames, 3))
        change = np.tile(np.eye(4), (self.num_frames, 1, 1))
        change[:, :3, :3], change[:, :3, 3] = scale * rotation, shift
        positions = scale * (self.positions @ rotation.T) + shift[:, None]
        normals = (self.normals @ rotation.T).astype(np.float32)
        pose = change[:, None] @ self.bone_pose
        return replace(self, positions=positions.astype(np.float32), normals=normals, bone_pose=pose)


def normalized(mesh: AnimatedMesh, radius: float, yaw: float = 0.0, travel: bool = True) -> AnimatedMesh:
    """Returns the mesh in a ball of this radius around the origin, over all frames together; what is hidden doesn't count.

    yaw: radians about the upright, y. travel=False: takes out the level (x, z) motion of the middle, as on a treadmill.
    """
    seen = mesh.seen_corners()
    seen[:, np.unique(mesh.triangles)] |= not seen.any()  # nothing has an area: drawing points will refuse it
    if not travel:
        middle = _middles(mesh.positions, seen) * [1, 0, 1]
        mesh = mesh.moved(np.eye(3), middle[0] - middle, 1.0)
    center, size = bounding_sphere(mesh.positions[seen])
    cosine, sine = np.cos(yaw), np.sin(yaw)
    rotation = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    scale = radius / max(size, 1e-300)
    return mesh.moved(rotation, -scale * rotation @ center, scale)


def _middles(positions: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Returns the mean f64 (T,3) of the vertices seen (T,V) in each frame; where none is, that of the frame before or after."""
    filled = np.flatnonzero(seen.any(1))
    means = np.stack([positions[frame, seen[frame]].mean(0, dtype=np.float64) for frame in filled])
    return means[np.clip(np.searchsorted(filled, np.arange(len(seen)), side="right") - 1, 0, None)]
