"""Made-up things for the training of a shape prior: procedural furniture, tools and machines, and heaps of simple solids."""

from __future__ import annotations

import numpy as np

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
    placed = [
        transform(pose[thing.body_of_triangle, None], thing.triangles)
        for pose in thing.poses(sample_values(thing, poses, 1.0, rng))
    ]
    corners = np.stack(placed).reshape(poses, -1, 3) * np.exp(_STRETCH[anyhow] * rng.normal(size=3))
    if anyhow and rng.random() < _TUMBLED:
        corners = corners @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
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
