"""Pictures of meshes with all their layers: where the ray of each pixel enters and leaves the object, once or twice.

They teach a network the shape that one picture hides. Lengths are relative to the picture, see `LayeredViews`. Every triangle
is rasterized, many pictures at a time, by torch: on a GPU the pictures cost nothing beside the meshes they show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dpcli.ops.cameras import orbit_pose
from dpcli.prepare.bounding_sphere import bounding_sphere
from dpcli.prepare.meshes.animated_mesh import AnimatedMesh
from dpcli.prepare.meshes.gltf_material import to_srgb
from dpcli.prepare.meshes.raycast import emitted, light_on, surface_color
from dpcli.prepare.views.orbit_world import OBJECT_RADIUS

_LEAST_GAP = 0.01  # of the picture's side: what lies closer is one body
_LEAST_SHOWN = 0.02  # of the pixels of a picture
_WAVES = 3  # random waves of a warp


class LayeredViews(NamedTuple):
    """Holds N square pictures, each cut out around the object.

    rgba: u8 (N,4,S,S). depth: f16 (N,4,S,S) front_1, back_1, front_2, back_2 along the camera's z, 0 at the middle of the
    ball around the object; the unit is the side of the picture at that distance. NaN: no such layer.
    """

    rgba: Tensor
    depth: Tensor


@dataclass(frozen=True)
class PosedMesh:
    """Holds a mesh in P poses, each in a ball of radius 0.75 about the origin.

    vertices: f32 (P,V,3). triangles: i32 (F,3), counterclockwise seen from outside. colors: sRGB u8 (P,F,3,3) of the
    corners, lit.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    colors: np.ndarray


def posed(mesh: AnimatedMesh, rng: np.random.Generator) -> PosedMesh | None:
    """Returns the frames of a mesh, each in its ball and under a light of its own; None where no frame has any size."""
    used = np.unique(mesh.triangles)
    corners, triangle = mesh.triangles.reshape(-1), np.arange(len(mesh.triangles)).repeat(3)
    weights = np.eye(3, dtype=np.float32)[np.tile(np.arange(3), len(mesh.triangles))]
    around = mesh.triangles[triangle]
    plain = surface_color(mesh, mesh.material[triangle], around, weights)[:, :3]
    shine = emitted(mesh, mesh.material[triangle], around, weights)
    vertices, colors = [], []
    for frame in range(mesh.num_frames):
        center, radius = bounding_sphere(mesh.positions[frame][used])
        shading = float(rng.uniform(0.2, 0.8))
        if not radius > 0:
            continue
        moved = (OBJECT_RADIUS / radius) * (mesh.positions[frame] - center)
        lit = plain * light_on(mesh, triangle, mesh.normals[frame][corners], shading)[:, None] + shine
        vertices.append(moved.astype(np.float32))
        colors.append(np.rint(255 * to_srgb(np.clip(lit, 0, 1))).astype(np.uint8).reshape(-1, 3, 3))
    if not vertices:
        return None
    return PosedMesh(np.stack(vertices), mesh.triangles.astype(np.int32), np.stack(colors))


def draw_views(
    meshes: Sequence[PosedMesh],
    count: int,
    size: int,
    rng: np.random.Generator,
    *,
    warp: float = 0.0,
    device: torch.device | str = "cpu",
) -> LayeredViews:
    """Draws `count` pictures of random poses of each mesh from random cameras: any azimuth, -10 to 40 degrees of elevation.

    warp: how far smooth waves bend and swell each object, 0: not at all. Pictures that show almost nothing are left out, so
    there may be fewer.
    """
    found = [_draw(part, count, size, rng, warp, torch.device(device)) for part in _parts(meshes, count, device)]
    if not found:
        return LayeredViews(torch.zeros(0, 4, size, size, dtype=torch.uint8), torch.zeros(0, 4, size, size).half())
    return LayeredViews(*(torch.cat(parts) for parts in zip(*found)))


def _parts(meshes: Sequence[PosedMesh], count: int, device: torch.device | str) -> list[list[PosedMesh]]:
    """Returns the meshes in parts that are drawn together, so that memory is bounded."""
    most, total, parts = 1 << 20 if str(device) == "cpu" else 1 << 23, 0, []
    for mesh in meshes:
        triangles = count * len(mesh.triangles)
        if not parts or total + triangles > most:
            parts.append([])
            total = 0
        parts[-1].append(mesh)
        total += triangles
    return parts


def _draw(
    meshes: Sequence[PosedMesh], count: int, size: int, rng: np.random.Generator, warp: float, device: torch.device
) -> LayeredViews:
    views = len(meshes) * count
    frames = np.array([rng.integers(len(mesh.vertices)) for mesh in meshes for _ in range(count)])
    poses, distance = _cameras(views, rng)
    waves = _waves(views, warp, rng)
    fill, shift = rng.uniform(0.86, 0.92, views), rng.uniform(-0.02, 0.02, (views, 2))
    poses, distance, fill, shift = (
        torch.from_numpy(x.astype(np.float32)).to(device) for x in (poses, distance, fill, shift)
    )
    corners, colors, view = _triangles(meshes, frames, count, device)
    if warp:
        corners = _warped(corners, view, waves.to(device))
    camera = torch.einsum("tij,tkj->tki", poses[view, :, :3], corners) + poses[view, None, :, 3]
    flat = camera[..., :2] / camera[..., 2:]
    low, high = _bounds(flat, view, views)
    extent = (high - low).amax(1) / fill
    origin = (low + high) / 2 + extent[:, None] * (shift - 0.5)
    pixel = (flat - origin[view, None]) * (size / extent)[view, None, None]
    ray, triangle, weights, ahead, entering = _hits(pixel, camera[..., 2], view, size)
    number, side = ray // size**2, extent * distance
    depth = torch.full((views * size**2, 4), torch.nan, device=device)
    first = torch.diff(ray, prepend=ray.new_full((1,), -1)) > 0
    depth[ray[first]] = split_hits(ray, (ahead - distance[number]) / side[number], entering)
    rgba = torch.zeros(views * size**2, 4, dtype=torch.uint8, device=device)
    shown = (weights[first][..., None] * colors[triangle[first]].float()).sum(1).round().clamp(0, 255)
    rgba[ray[first], :3], rgba[ray[first], 3] = shown.to(torch.uint8), 255
    rgba, depth = (x.view(views, size, size, 4).permute(0, 3, 1, 2) for x in (rgba, depth))
    kept = (rgba[:, 3] > 0).sum((1, 2)) >= _LEAST_SHOWN * size**2
    return LayeredViews(rgba[kept].contiguous(), depth[kept].half())


def _triangles(
    meshes: Sequence[PosedMesh], frames: np.ndarray, count: int, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the triangles of `count` views of each mesh: corners f32 (T,3,3), colors u8 (T,3,3), and view i64 (T).

    frames: the pose (N) of each view. Each mesh is sent to the device once.
    """

    def joined(arrays: list[np.ndarray]) -> Tensor:
        return torch.from_numpy(np.concatenate(arrays)).to(device)

    def starts(lengths: np.ndarray) -> np.ndarray:
        return np.cumsum(lengths) - lengths

    poses, vertices = np.array([mesh.vertices.shape[:2] for mesh in meshes]).T
    faces = np.array([len(mesh.triangles) for mesh in meshes])
    mesh = np.arange(len(meshes)).repeat(count)
    bases = [  # where each view's triangles, vertices and colors begin
        starts(faces)[mesh],
        starts(poses * vertices)[mesh] + frames * vertices[mesh],
        starts(poses * faces)[mesh] + frames * faces[mesh],
    ]
    first, vertex, color = joined([np.stack(bases, 1)]).T
    length = joined([faces[mesh]])
    view = torch.repeat_interleave(length)
    own = torch.arange(len(view), device=device) - (length.cumsum(0) - length)[view]
    corner = joined([mesh.triangles for mesh in meshes])[first[view] + own].long() + vertex[view, None]
    places = joined([mesh.vertices.reshape(-1, 3) for mesh in meshes])
    colors = joined([mesh.colors.reshape(-1, 3, 3) for mesh in meshes])
    return places[corner], colors[color[view] + own], view


def _cameras(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draws poses (N,3,4), world to camera, OpenCV axes, and distances (N)."""
    elevation = np.radians(np.clip(rng.normal(5, 12, count), -10, 40))
    distance = OBJECT_RADIUS / np.sin(np.radians(rng.uniform(10, 30, count)))
    azimuth = rng.uniform(0, 2 * np.pi, count)
    return np.stack([orbit_pose(*one)[:3] for one in zip(azimuth, elevation, distance)]), distance


def _waves(count: int, warp: float, rng: np.random.Generator) -> Tensor:
    """Draws waves (N,W,7): a frequency and an amplitude per axis, and a phase. Amplitudes are `warp` over the frequency, so
    that no warp folds a surface over.
    """
    frequency = rng.normal(0, 2.5, (count, _WAVES, 3))
    amplitude = warp * rng.normal(size=(count, _WAVES, 3)) / (1 + np.linalg.norm(frequency, axis=-1, keepdims=True))
    phase = rng.uniform(0, 2 * np.pi, (count, _WAVES, 1))
    return torch.from_numpy(np.concatenate([frequency, amplitude, phase], -1).astype(np.float32))


def _warped(corners: Tensor, view: Tensor, waves: Tensor) -> Tensor:
    """Returns corners (T,3,3) displaced by the waves of their views; left and right halves (x) stay mirror images."""
    for wave in waves.unbind(1):
        own = wave[view][:, None]  # (T,1,7)
        along = (own[..., 1:3] * corners[..., 1:]).sum(-1) + own[..., 6]
        across = own[..., 0] * corners[..., 0]
        swing = torch.stack([across.sin(), across.cos(), across.cos()], -1) * along.sin()[..., None]
        corners = corners + own[..., 3:6] * swing
    return corners


def _bounds(flat: Tensor, view: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Returns the smallest and largest places (N,2) of the corners (T,3,2) of each view's triangles."""
    index = view[:, None].expand(-1, 2)
    low = flat.new_full((count, 2), torch.inf).scatter_reduce(0, index, flat.amin(1), "amin")
    return low, flat.new_full((count, 2), -torch.inf).scatter_reduce(0, index, flat.amax(1), "amax")


def _hits(pixel: Tensor, ahead: Tensor, view: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Returns all hits of the rays through the centers of pixels: ray i64 (H), rising, (view * S + row) * S + column; triangle
    i64 (H), weights of its corners (H,3), distance along the camera's z (H), rising along each ray, and entering bool (H).

    pixel (T,3,2), ahead (T,3): where the corners of triangles are in their picture, and how far in front of the camera.
    """
    low = (pixel.amin(1) - 0.5).ceil().clamp(min=0).long()
    high = (pixel.amax(1) - 0.5).floor().clamp(max=size - 1).long()
    spans = (high - low + 1).clamp(min=0)
    number = spans.prod(1)
    triangle = torch.repeat_interleave(number)
    place = torch.arange(len(triangle), device=pixel.device) - (number.cumsum(0) - number)[triangle]
    width = spans[triangle, 0]
    column, row = low[triangle, 0] + place % width, low[triangle, 1] + place // width
    a, b, c = (pixel[triangle, k] for k in range(3))
    at = torch.stack([column, row], 1) + 0.5
    area = _cross(b - a, c - a)
    weights = torch.stack([_cross(b - at, c - at), _cross(c - at, a - at), _cross(a - at, b - at)], 1) / area[:, None]
    inside = ((weights >= 0).all(1) & (area != 0)).nonzero()[:, 0]
    triangle, weights, area = triangle[inside], weights[inside], area[inside]
    weights = weights / ahead[triangle]
    distance = 1 / weights.sum(1)
    ray = (view[triangle] * size + row[inside]) * size + column[inside]
    order = distance.argsort()
    order = order[ray[order].argsort(stable=True)]
    return ray[order], triangle[order], (weights * distance[:, None])[order], distance[order], (area < 0)[order]


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def split_hits(ray: Tensor, depth: Tensor, entering: Tensor) -> Tensor:
    """Returns front_1, back_1, front_2, back_2 (R,4) of the R rays that hit something, NaN where there is one interval.

    ray i64 (H), rising; depth (H), rising along each ray; entering bool (H): the surface is seen from outside. The two
    intervals are parted at the widest gap between leaving and entering in which the ray is outside of all bodies. Where
    surfaces are open, so that a ray doesn't leave as often as it enters, any such gap may part them; where they are
    inside out, so that a ray leaves first and enters last, they are turned.
    """
    _, row, length = torch.unique_consecutive(ray, return_inverse=True, return_counts=True)
    if not len(length):
        return depth.new_zeros(0, 4)
    column = torch.arange(len(ray), device=ray.device) - (length.cumsum(0) - length)[row]
    shape, rows = (len(length), int(length.max()) + 1), torch.arange(len(length), device=ray.device)
    grid, sign = depth.new_full(shape, torch.nan), torch.zeros(shape, dtype=torch.int32, device=ray.device)
    grid[row, column], sign[row, column] = depth, entering.int() * 2 - 1
    last = length - 1
    turned = (sign[:, 0] < 0) & (sign[rows, last] > 0)
    sign = torch.where(turned[:, None], -sign, sign)
    inside = sign.cumsum(1)
    outside = (sign[:, :-1] < 0) & (sign[:, 1:] > 0) & ((inside[:, :-1] <= 0) | (inside[:, -1:] != 0))
    gap = torch.where(outside, grid.diff(dim=1).nan_to_num(), 0.0)
    widest, cut = gap.max(1)
    two = widest > _LEAST_GAP
    found = depth.new_full((len(length), 4), torch.nan)
    found[:, 0], found[:, 1] = grid[:, 0], grid[rows, torch.where(two, cut, last)]
    second = torch.stack([grid[rows, (cut + 1).clamp(max=shape[1] - 1)], grid[rows, last]], 1)
    found[:, 2:] = torch.where(two[:, None], second, torch.nan)
    return found
