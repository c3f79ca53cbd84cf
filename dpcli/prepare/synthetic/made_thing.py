"""Made-up things for the training of a shape network: procedural furniture, tools and machines, and heaps of simple solids."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from dpcli.prepare.articulated.articulated_object import sample_values, transform
from dpcli.prepare.articulated.procedural.kinds import KINDS
from dpcli.prepare.articulated.procedural.solids import Builder
from dpcli.prepare.meshes.animated_mesh import AnimatedMesh, Material
from dpcli.prepare.meshes.skinning import vertex_normals

_ANYTHING = 0.4  # share of solids that are joined anyhow
_STRETCH = {True: 0.5, False: 0.2}  # spread of the logarithm of the sizes along the axes: joined anyhow, of a kind
_TUMBLED = 0.4  # share of what is joined anyhow that lies in any direction


def made_thing(rng: np.random.Generator, poses: int) -> AnimatedMesh:
    """Makes a thing of a random kind in some poses of its joints; y is up, each body has one color.

    Four in ten are solids joined anyhow, from boards on posts to heaps, since what people film is often of no kind that
    could be listed.
    """
    anyhow = rng.random() < _ANYTHING
    kind = "assembly" if anyhow else str(rng.choice(sorted(KINDS)))
    builder = Builder()
    KINDS[kind](builder, rng)
    thing = builder.build(kind)
    solids = outward(thing.triangles, thing.body_of_triangle)
    placed = [
        transform(pose[thing.body_of_triangle, None], solids)
        for pose in thing.poses(sample_values(thing, poses, 1.0, rng))
    ]
    corners = np.stack(placed).reshape(poses, -1, 3) * np.exp(_STRETCH[anyhow] * rng.normal(size=3))
    if anyhow and rng.random() < _TUMBLED:
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        corners = corners @ (turn * np.linalg.det(turn))
    corners = np.stack([corners[..., 0], corners[..., 2], -corners[..., 1]], axis=-1)
    triangles = np.arange(corners.shape[1]).reshape(-1, 3)
    body = thing.body_of_triangle.repeat(3)
    color = np.append(rng.random((thing.num_bodies, 3)), np.ones((thing.num_bodies, 1)), axis=1)
    pose = np.tile(np.eye(4), (poses, 1, 1, 1))
    return AnimatedMesh(
        name=kind,
        time=np.arange(poses, dtype=float),
        positions=corners.astype(np.float32),
        normals=np.stack([vertex_normals(frame, triangles) for frame in corners]).astype(np.float32),
        triangles=triangles,
        material=np.zeros(len(triangles), np.int64),
        materials=(Material(),),
        color=color[body].astype(np.float32),
        uv=np.zeros((len(body), 2), np.float32),
        bones=np.zeros((len(body), 1), np.int64),
        weights=np.ones((len(body), 1), np.float32),
        bone_pose=pose,
        bone_parent=np.array([-1]),
    )


def outward(triangles: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Returns triangles f64 (T,3,3) that run counterclockwise seen from outside of their solid, that is, of what hangs together
    by its edges in one body. body: i64 (T).

    Every triangle is there twice, as it is and turned around; neighbors that agree are joined, and of the two pieces that a
    triangle is in then, the one with the larger volume is taken.
    """
    keys = np.concatenate([triangles.reshape(-1, 3).round(9), body.repeat(3)[:, None]], axis=1)
    corner = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1, 3)
    edges = np.stack([corner, np.roll(corner, -1, axis=1)], axis=2).reshape(-1, 2)
    _, edge, uses = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(edge.ravel(), kind="stable")
    one, other = order[uses[edge.ravel()[order]] == 2].reshape(-1, 2).T  # where solids touch, edges have more triangles
    same = edges[one, 0] == edges[other, 1]  # neighbors that agree run along their edge in opposite ways
    count, first, second = len(triangles), one // 3, other // 3
    rows = np.concatenate([first, first + count])
    columns = np.concatenate([second + count * ~same, second + count * same])
    piece = connected_components(coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * count,) * 2), False)[1]
    both = np.concatenate([triangles, triangles[:, ::-1]])
    number = np.bincount(piece)
    center = np.stack([np.bincount(piece, both[..., k].mean(1)) / number for k in range(3)], axis=1)
    a, b, c = np.moveaxis(both - center[piece, None], 1, 0)
    volume = np.bincount(piece, np.einsum("ti,ti->t", a, np.cross(b, c)))
    turned = volume[piece[count:]] > volume[piece[:count]]
    return np.where(turned[:, None, None], triangles[:, ::-1], triangles)
