"""The skin of a made-up animal: one smooth surface around its shapes, hung on its bones, painted at random."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np

from dpcli.prepare.meshes.animated_mesh import AnimatedMesh, Material
from dpcli.prepare.meshes.gltf_material import to_linear
from dpcli.prepare.meshes.skinning import skin, vertex_normals
from dpcli.prepare.synthetic.creature import Creature, Shape
from dpcli.prepare.synthetic.surface_nets import surface_nets

_SMOOTH = 0.012  # how far shapes melt into each other
_BINDING = 0.006  # how far from a joint both bones carry the skin
_REACH = 8 * _SMOOTH  # beyond this a shape adds nothing to the field that could be seen


@dataclass(frozen=True)
class Skin:
    """Holds vertices f64 (V,3), triangles i64 (F,3), color linear RGBA f32 (V,4), bones i64 (V,4), weights f32 (V,4)."""

    vertices: np.ndarray
    triangles: np.ndarray
    color: np.ndarray
    bones: np.ndarray
    weights: np.ndarray


def animated_creature(animal: Creature, body: Skin, pose: np.ndarray, *, name: str, time: np.ndarray) -> AnimatedMesh:
    """Returns the skin moved by its bones. pose f64 (T,B,4,4): each bone's motion from rest; time f64 (T) seconds."""
    normals = vertex_normals(body.vertices, body.triangles)
    positions, normals = skin(body.vertices, normals, body.bones, body.weights, pose)
    return AnimatedMesh(
        name=name,
        time=time,
        positions=positions,
        normals=normals,
        triangles=body.triangles,
        material=np.zeros(len(body.triangles), np.int64),
        materials=(Material(),),
        color=body.color,
        uv=np.zeros((len(body.vertices), 2), np.float32),
        bones=body.bones,
        weights=body.weights,
        bone_pose=pose,
        bone_parent=np.array([bone.parent for bone in animal.bones]),
    )


def make_skin(animal: Creature, rng: np.random.Generator, cells: int = 120) -> Skin:
    """Makes the painted skin; ``cells`` along the longest side of the grid it is cut from."""
    vertices, triangles = _mesh(animal, cells)
    distance = np.stack([shape_distance(vertices, shape) for shape in animal.shapes], axis=1)
    bones, weights = _bind(animal, distance / [shape.flat for shape in animal.shapes])
    color = _paint(animal, vertices, distance, rng)
    parts = [Skin(vertices, triangles, color, bones, weights)]
    parts += [_eye(animal, *eye) for eye in animal.eyes]
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])
    joined = (np.concatenate([getattr(part, key) for part in parts]) for key in ("color", "bones", "weights"))
    triangles = np.concatenate([part.triangles + start for part, start in zip(parts, starts)])
    return Skin(np.concatenate([part.vertices for part in parts]), triangles, *joined)


def shape_distance(points: np.ndarray, shape: Shape) -> np.ndarray:
    """Returns about how far points (N,3) are outside a shape, negative inside; exact in sign."""
    offset, axis = points - shape.a, shape.b - shape.a
    if shape.flat < 1:
        normal = np.array(shape.normal) / np.linalg.norm(shape.normal)
        offset = offset + (1 / shape.flat - 1) * (offset @ normal)[:, None] * normal
        axis = axis + (1 / shape.flat - 1) * (axis @ normal) * normal
    s = np.clip(offset @ axis / max(axis @ axis, 1e-12), 0, 1)
    gap = np.linalg.norm(offset - s[:, None] * axis, axis=1) - (shape.ra + s * (shape.rb - shape.ra))
    return gap * shape.flat


def smooth_union(points: np.ndarray, shapes: list[Shape]) -> np.ndarray:
    """Returns the smooth union of shapes, -k log sum exp(-d / k); negative inside."""
    total = sum(np.exp(-np.maximum(shape_distance(points, shape), -0.3) / _SMOOTH) for shape in shapes)
    return -_SMOOTH * np.log(np.maximum(total, 1e-300))


def _mesh(animal: Creature, cells: int) -> tuple[np.ndarray, np.ndarray]:
    ends = np.stack([[shape.a, shape.b] for shape in animal.shapes])
    radii = np.array([[shape.ra, shape.rb] for shape in animal.shapes])[..., None]
    low, high = (ends - radii).min((0, 1)) - 0.04, (ends + radii).max((0, 1)) + 0.04
    step = (high - low).max() / cells
    axes = [np.arange(a, b + step, step) for a, b in zip(low, high)]
    total = np.zeros([len(axis) for axis in axes])
    for shape in animal.shapes:  # each only where it matters
        reach = max(shape.ra, shape.rb) + _REACH / shape.flat
        first, last = np.minimum(shape.a, shape.b) - reach, np.maximum(shape.a, shape.b) + reach
        box = tuple(slice(*np.searchsorted(axis, (a, b))) for axis, a, b in zip(axes, first, last))
        grid = np.stack(np.meshgrid(*(axis[cut] for axis, cut in zip(axes, box)), indexing="ij"), axis=-1)
        near = np.exp(-np.maximum(shape_distance(grid.reshape(-1, 3), shape), -0.3) / _SMOOTH)
        total[box] += near.reshape(grid.shape[:3])
    vertices, triangles = surface_nets(-_SMOOTH * np.log(np.maximum(total, 1e-30)))
    return low + step * vertices, triangles


def _bind(animal: Creature, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Hangs each vertex on the bone of the nearest shape, near a joint also on that bone's parent and children."""
    owner = np.array([shape.bone for shape in animal.shapes])
    per_bone = np.stack(
        [distance[:, owner == index].min(1, initial=np.inf) for index in range(len(animal.bones))], axis=1
    )
    nearest = per_bone.argmin(1)
    parent = np.array([bone.parent for bone in animal.bones])
    index = np.arange(len(parent))
    linked = (index[:, None] == index) | (parent[:, None] == index) | (parent == index[:, None])
    gap = np.where(linked[nearest], per_bone - per_bone.min(1, keepdims=True), np.inf)
    weights = np.exp(-gap / _BINDING)
    bones = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(weights, bones, axis=1)
    weights[weights < 0.01] = 0
    return bones, (weights / weights.sum(1, keepdims=True)).astype(np.float32)


def _paint(animal: Creature, vertices: np.ndarray, distance: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Paints linear RGBA f32 (V,4): a coat with a pale belly and spots, stripes or patches; dark feet, colored fins,
    horn.
    """
    hue = rng.uniform(0.03, 0.12) if animal.kind == "quadruped" else rng.uniform(0, 1)
    coat = np.array(colorsys.hsv_to_rgb(hue, rng.uniform(0.45, 0.75), rng.uniform(0.6, 0.85)))
    mark = coat * rng.uniform(0.25, 0.45) if rng.random() < 0.6 else 0.3 * coat + 0.68
    fin = np.array(colorsys.hsv_to_rgb((hue + rng.uniform(0.3, 0.7)) % 1, 0.5, 0.75))
    pale = 0.35 * coat + 0.6
    dark, horn = np.array([0.14, 0.12, 0.11]), np.array([0.93, 0.62, 0.2])
    y = vertices[:, 1] - np.median(vertices[:, 1]) if animal.kind != "quadruped" else vertices[:, 1] - 0.95 * animal.leg
    color = coat + np.clip(0.5 - 14 * y, 0, 1)[:, None] * (pale - coat)
    amount = _pattern(vertices, rng)[:, None]
    color = color + amount * (mark - color)
    paint = np.array([shape.paint for shape in animal.shapes])[distance.argmin(1)]
    stripes = 0.85 + 0.15 * np.sin(90 * (vertices @ rng.normal(size=3)))[:, None]
    for name, value in (("dark", dark), ("horn", horn), ("fin", (0.6 * fin + 0.4 * coat) * stripes)):
        color = np.where((paint == name)[:, None], value, color)
    return np.concatenate([to_linear(np.clip(color, 0, 1)), np.ones((len(color), 1))], axis=1).astype(np.float32)


def _pattern(vertices: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Returns how much of the marking's color each vertex has, 0..1."""
    kind, scale = rng.choice(["spots", "stripes", "patches"]), rng.uniform(0.8, 1.25)
    waves, phases = rng.normal(size=(24, 3)), rng.uniform(0, 2 * np.pi, 24)
    noise = np.sin((22 if kind == "spots" else 8) * scale * vertices @ waves.T + phases).sum(1) / np.sqrt(12)
    if kind == "stripes":
        noise = 1.6 * np.sin(42 * scale * vertices[:, 2] + 1.2 * noise)
    return np.clip(6 * (noise - 0.7) + 0.5, 0, 1)


def _eye(animal: Creature, bone: int, center: np.ndarray, direction: np.ndarray, radius: float) -> Skin:
    """Returns a dark ball with a glint, half sunk into the head where the direction leaves it."""
    direction = direction / np.linalg.norm(direction)
    along = np.linspace(0, 0.3, 301)
    inside = smooth_union(center + along[:, None] * direction, animal.shapes) < 0
    place = center + (along[int(np.argmin(inside))] - 0.3 * radius) * direction
    side = np.stack(np.meshgrid(*[np.linspace(-1.3, 1.3, 14)] * 3, indexing="ij"), axis=-1)
    unit, triangles = surface_nets(np.linalg.norm(side, axis=-1) - 1)
    unit = unit * (2.6 / 13) - 1.3
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    glint = (direction + [0, 0.6, 0.25]) / np.linalg.norm(direction + [0, 0.6, 0.25])
    color = np.where((unit @ glint > 0.88)[:, None], 0.95, 0.012) * np.ones(3)
    color = np.concatenate([color, np.ones((len(unit), 1))], axis=1).astype(np.float32)
    bones, weights = np.zeros((len(unit), 4), np.int64), np.zeros((len(unit), 4), np.float32)
    bones[:, 0], weights[:, 0] = bone, 1
    return Skin(place + radius * unit, triangles, color, bones, weights)
