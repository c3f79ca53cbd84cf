"""Pictures of a mesh by ray casting: textures, vertex colors, soft light that stays with the world, straight alpha."""

from __future__ import annotations

import numpy as np

from dpcli.ops.open3d_import import load_open3d
from dpcli.prepare.meshes.animated_mesh import AnimatedMesh, Material, Texture
from dpcli.prepare.meshes.gltf_material import to_linear, to_srgb

# unit, where the light comes from: above, in front, a little to the right
_LIGHT = np.array([0.37, 0.74, 0.56], np.float32)
_DECODED = to_linear(np.arange(256) / 255).astype(np.float32)
_LAYERS = 1024  # most surfaces that one ray passes through: shells of fur and leaves are dozens
_NUDGE = 1e-4  # a ray goes on this far behind a transparent surface


class FrameCaster:
    """Draws one frame of an AnimatedMesh from any camera.

    shading: 0 shows plain colors, 1 full light and shade. Triangles that are `one_sided` are not seen from behind.
    """

    def __init__(self, mesh: AnimatedMesh, frame: int, shading: float = 0.5) -> None:
        self.mesh, self.shading = mesh, shading
        self.positions, self.normals = mesh.positions[frame], mesh.normals[frame]
        a, b, c = (self.positions[mesh.triangles[:, k]] for k in range(3))
        plain = mesh.one_sided is None and mesh.faceted is None
        self._across = None if plain else np.cross(b - a, c - a)
        if not plain and mesh.turned is not None:
            self._across[mesh.turned[frame]] *= -1
        open3d = load_open3d()
        self._tensor = open3d.core.Tensor
        self._scene = open3d.t.geometry.RaycastingScene(nthreads=1)  # one process per CPU is the parallelism
        self._scene.add_triangles(
            self._tensor(np.ascontiguousarray(self.positions, np.float32)),
            self._tensor(np.ascontiguousarray(mesh.triangles, np.uint32)),
        )

    def picture(
        self,
        intrinsics: np.ndarray,  # f64 (3,3)
        world_to_camera: np.ndarray,  # f64 (4,4), OpenCV axes
        size: tuple[int, int],  # width, height
        samples: int = 2,
    ) -> np.ndarray:
        """Draws RGBA u8 (H,W,4), straight alpha, sRGB; samples x samples rays per pixel, colors averaged as they are
        shown (splats are blended in sRGB, too). What is empty is 0 0 0 0.
        """
        width, height = size
        image = np.zeros((height, width, 4), np.uint8)
        rows, columns = self._window(intrinsics, world_to_camera, size)
        if rows.start >= rows.stop or columns.start >= columns.stop:
            return image
        rays = world_rays(intrinsics, world_to_camera, rows, columns, samples)
        seen = self._look(rays.reshape(-1, 6))
        shape = (rows.stop - rows.start, samples, columns.stop - columns.start, samples, 4)
        total = seen.reshape(shape).sum((1, 3))  # premultiplied
        alpha = total[..., 3:]
        color = np.divide(total[..., :3], alpha, out=np.zeros_like(total[..., :3]), where=alpha > 0)
        straight = np.concatenate([color, alpha / samples**2], axis=-1)
        straight[alpha[..., 0] * 255 < 0.5 * samples**2] = 0
        image[rows, columns] = np.rint(255 * np.clip(straight, 0, 1)).astype(np.uint8)
        return image

    def all_hits(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Returns every hit of rays f32 (N,6), the hits of a ray from near to far: ray i64 (H), rising, distance f32 (H),
        triangle i64 (H), and the weights f32 (H,3) of its corners.
        """
        hits = self._scene.list_intersections(self._tensor(rays))
        ray, distance = hits["ray_ids"].numpy().astype(np.int64), hits["t_hit"].numpy()
        order = np.lexsort((distance, ray))
        u, v = hits["primitive_uvs"].numpy()[order].T
        triangle = hits["primitive_ids"].numpy()[order].astype(np.int64)
        return ray[order], distance[order], triangle, np.stack([1 - u - v, u, v], axis=1)

    def _window(self, intrinsics: np.ndarray, pose: np.ndarray, size: tuple[int, int]) -> tuple[slice, slice]:
        """Returns rows and columns that the object can touch; the whole picture when some of it is behind the camera."""
        points = self.positions.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        if points[:, 2].min() < 1e-3:
            return slice(0, size[1]), slice(0, size[0])
        pixels = points[:, :2] / points[:, 2:] * intrinsics[[0, 1], [0, 1]] + intrinsics[:2, 2]
        low = np.clip(np.floor(pixels.min(0)) - 1, 0, size).astype(int)
        high = np.clip(np.ceil(pixels.max(0)) + 1, 0, size).astype(int)
        return slice(low[1], high[1]), slice(low[0], high[0])

    def _look(self, rays: np.ndarray) -> np.ndarray:
        """Returns premultiplied sRGB and alpha f32 (N,4) of rays f32 (N,6), front to back."""
        result = np.zeros((len(rays), 4), np.float32)
        left = np.arange(len(rays))  # rays that still see something
        through = np.ones(len(rays), np.float32)
        for _ in range(_LAYERS):
            hits = self._scene.cast_rays(self._tensor(rays))
            distance = hits["t_hit"].numpy()
            hit = np.isfinite(distance)
            left, rays, through, distance = left[hit], rays[hit], through[hit], distance[hit]
            if not len(left):
                break
            triangle = hits["primitive_ids"].numpy()[hit].astype(np.int64)
            u, v = hits["primitive_uvs"].numpy()[hit].T
            color = self.surface(triangle, np.stack([1 - u - v, u, v], axis=1), rays[:, 3:])
            result[left, :3] += (through * color[:, 3])[:, None] * color[:, :3]
            result[left, 3] += through * color[:, 3]
            through = through * (1 - color[:, 3])
            on = through > 1 / 255
            if not on.any():
                break
            left, through, rays = left[on], through[on], rays[on].copy()
            rays[:, :3] += (distance[on] + _NUDGE)[:, None] * rays[:, 3:]
        return result

    def surface(self, triangle: np.ndarray, weights: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Returns sRGB and alpha f32 (N,4) of points on triangles, lit; direction: where the rays go."""
        mesh, corners = self.mesh, self.mesh.triangles[triangle]
        color = surface_color(mesh, mesh.material[triangle], corners, weights)
        if self.shading and not all(m.unlit for m in mesh.materials):
            color[:, :3] *= self._light(triangle, corners, weights, direction)[:, None]
        if any(any(m.emission) for m in mesh.materials):
            color[:, :3] += emitted(mesh, mesh.material[triangle], corners, weights)
        if mesh.one_sided is not None:
            behind = np.einsum("na,na->n", self._across[triangle], direction) > 0
            color[behind & mesh.one_sided[triangle], 3] = 0
        color[:, :3] = to_srgb(np.clip(color[:, :3], 0, 1))
        return color

    def _light(
        self, triangle: np.ndarray, corners: np.ndarray, weights: np.ndarray, direction: np.ndarray
    ) -> np.ndarray:
        """Returns how much light (N) comes from each point, 1 on a plain or unlit surface."""
        normal = np.einsum("nk,nka->na", weights, self.normals[corners])
        if self.mesh.faceted is not None:
            normal = np.where(self.mesh.faceted[triangle, None], _unit(self._across[triangle]), normal)
        facing = np.where(np.einsum("na,na->n", normal, direction) > 0, -1, 1)
        return light_on(self.mesh, triangle, facing[:, None] * normal, self.shading)


def light_on(mesh: AnimatedMesh, triangle: np.ndarray, normal: np.ndarray, shading: float) -> np.ndarray:
    """Returns how much light f32 (N) comes from points of triangles i64 (N) with normals (N,3), 1 where they are unlit."""
    length = np.sqrt(np.einsum("na,na->n", normal, normal))
    half = 0.5 + 0.5 * (normal @ _LIGHT) / np.maximum(length, 1e-9)
    light = 1 - shading * (0.7 - 0.8 * half)  # wraps around: no side is black, as under an open sky
    unlit = np.array([m.unlit for m in mesh.materials])
    return np.where(unlit[mesh.material[triangle]], 1, light).astype(np.float32)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Returns f32 (N,3) of length 1, 0 where they have none."""
    vectors = vectors.astype(np.float64)
    return (vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)).astype(np.float32)


def world_rays(intrinsics: np.ndarray, pose: np.ndarray, rows: slice, columns: slice, samples: int) -> np.ndarray:
    """Returns rays f32 (rows, samples, columns, samples, 6): origin and unit direction, pixel centers at +0.5."""
    y = np.arange(rows.start * samples, rows.stop * samples).reshape(-1, samples)
    x = np.arange(columns.start * samples, columns.stop * samples).reshape(-1, samples)
    y, x = (y + 0.5) / samples, (x + 0.5) / samples
    across, down, ahead = np.linalg.inv(intrinsics).T @ pose[:3, :3]  # direction = x across + y down + ahead
    direction = (y[..., None] * down + ahead)[:, :, None, None] + x[..., None] * across
    rays = np.empty((*direction.shape[:-1], 6), np.float32)
    rays[..., :3] = -pose[:3, :3].T @ pose[:3, 3]
    rays[..., 3:] = direction / np.sqrt(np.einsum("...a,...a->...", direction, direction))[..., None]
    return rays


def surface_color(mesh: AnimatedMesh, material: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Returns linear RGBA f32 (N,4), unlit, of points by the vertices i64 (N,3) around them and their weights (N,3).

    Base color factor x vertex color x texture; alpha is 1 where the material is opaque, 0 or 1 where it is masked.
    """
    color = np.array([m.color for m in mesh.materials], np.float32)[material]
    if (mesh.color != 1).any():
        color *= np.einsum("nk,nka->na", weights, mesh.color[corners])
    uv = None
    for index, entry in enumerate(mesh.materials):
        if entry.texture is None and entry.blend == "opaque":
            continue
        here = slice(None) if len(mesh.materials) == 1 else material == index
        if entry.texture is not None:
            uv = np.einsum("nk,nka->na", weights, mesh.uv[corners]) if uv is None else uv
            color[here] *= sample_texture(entry.texture, uv[here])
        color[here, 3] = _alpha(entry, color[here, 3])
    color[np.array([m.blend == "opaque" for m in mesh.materials])[material], 3] = 1
    return color


def emitted(mesh: AnimatedMesh, material: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Returns the linear RGB f32 (N,3) that points give off by themselves; arguments as for `surface_color`."""
    light = np.array([m.emission for m in mesh.materials], np.float32)[material]
    uv = mesh.uv if mesh.emission_uv is None else mesh.emission_uv
    for index, entry in enumerate(mesh.materials):
        if entry.emission_texture is not None:
            here = material == index
            place = np.einsum("nk,nka->na", weights[here], uv[corners[here]])
            light[here] *= sample_texture(entry.emission_texture, place)[:, :3]
    return light


def _alpha(material: Material, alpha: np.ndarray) -> np.ndarray:
    return (alpha >= material.cutoff).astype(np.float32) if material.blend == "mask" else np.clip(alpha, 0, 1)


def sample_texture(texture: Texture, uv: np.ndarray) -> np.ndarray:
    """Looks up linear RGBA f32 (N,4); uv (N,2) with v downwards, (0, 0) the upper left corner.

    Between pixels it is bilinear, unless the texture shows the nearest.
    """
    if texture.change is not None:
        uv = uv @ texture.change[:, :2].T + texture.change[:, 2]
    height, width = texture.pixels.shape[:2]
    if texture.nearest:
        column, row = (np.floor(uv[:, axis] * size).astype(np.int64) for axis, size in ((0, width), (1, height)))
        return _linear(texture, _wrapped(row, height, texture.wrap[1]), _wrapped(column, width, texture.wrap[0]))
    x, y = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = (x - x0)[:, None].astype(np.float32), (y - y0)[:, None].astype(np.float32)
    xs = [_wrapped(x0 + k, width, texture.wrap[0]) for k in (0, 1)]
    ys = [_wrapped(y0 + k, height, texture.wrap[1]) for k in (0, 1)]
    above, below = ((1 - fx) * _linear(texture, row, xs[0]) + fx * _linear(texture, row, xs[1]) for row in ys)
    return (1 - fy) * above + fy * below


def _linear(texture: Texture, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Returns linear RGBA f32 (N,4) of pixels; a table is decoded, not the picture, which also travels to workers."""
    encoded = texture.pixels[row, column]
    decoded = _DECODED[encoded]
    decoded[:, 3] = encoded[:, 3] / np.float32(255)
    return decoded


def _wrapped(index: np.ndarray, size: int, how: str) -> np.ndarray:
    if how == "clamp":
        return np.clip(index, 0, size - 1)
    if how == "mirror":
        index = index % (2 * size)
        return np.where(index < size, index, 2 * size - 1 - index)
    return index % size
