"""Made-up animals: a closed skin, joints that hold together, gaits that loop, tracks and parts that are exact."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from dpcli.errors import UsageError
from dpcli.ops.rotations import axis_rotation
from dpcli.prepare.meshes.bone_parts import choose_points, heaviest_bones, track_points
from dpcli.prepare.synthetic import creature
from dpcli.prepare.synthetic.animal import make_animal
from dpcli.prepare.synthetic.creature import Shape
from dpcli.prepare.synthetic.creature_mesh import make_skin, shape_distance, smooth_union
from dpcli.prepare.synthetic.gait import MOTIONS, bone_motion, turn_bones
from dpcli.prepare.synthetic.surface_nets import surface_nets
from dpcli.runtime.seeds import generator
from dpcli.store.views import ViewsReader


def volume(vertices: np.ndarray, triangles: np.ndarray) -> float:
    """Signed; positive when corners run anticlockwise seen from outside."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return float(np.einsum("fa,fa->", a, np.cross(b, c)) / 6)


def is_closed(triangles: np.ndarray) -> bool:
    """Every edge is run through as often in one direction as in the other."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    forth, back = Counter(map(tuple, edges.tolist())), Counter(map(tuple, edges[:, ::-1].tolist()))
    return forth == back


def test_surface_nets_of_a_ball():
    grid = np.stack(np.meshgrid(*[np.arange(32.0)] * 3, indexing="ij"), axis=-1)
    center = np.array([15.3, 14.8, 16.1])
    vertices, triangles = surface_nets(np.linalg.norm(grid - center, axis=-1) - 10)
    np.testing.assert_allclose(np.linalg.norm(vertices - center, axis=1), 10, atol=0.15)
    assert volume(vertices, triangles) == pytest.approx(4 / 3 * np.pi * 1000, rel=0.02)
    assert is_closed(triangles) and not is_closed(triangles[1:])
    edges = len(triangles) * 3 // 2
    assert len(vertices) - edges + len(triangles) == 2  # Euler: a ball has no handles


def test_shapes_against_the_balls_they_are_swept_from():
    rng = np.random.default_rng(0)
    shape = Shape(0, np.array([0.1, 0, 0.2]), np.array([0.3, 0.4, -0.1]), 0.2, 0.12)
    points = rng.uniform(-0.4, 0.8, (2000, 3))
    s = np.linspace(0, 1, 2001)[:, None]
    centers, radii = shape.a + s * (shape.b - shape.a), shape.ra + s * (shape.rb - shape.ra)
    swept = (np.linalg.norm(points[:, None] - centers, axis=-1) - radii[:, 0]).min(1)
    found = shape_distance(points, shape)
    sure = np.abs(swept) > 0.02  # the cone's slope is left out of our distance
    assert (np.sign(found) == np.sign(swept))[sure].all() and np.abs(found - swept).max() < 0.02
    flat = Shape(0, np.zeros(3), np.array([0.5, 0, 0]), 0.2, 0.2, flat=0.25, normal=(0, 2.0, 0))
    ends = np.array([[0.25, 0.05, 0], [0.25, 0, 0.2], [-0.2, 0, 0]])  # a quarter as thick as it is wide
    np.testing.assert_allclose(shape_distance(ends, flat), 0, atol=1e-12)


@pytest.mark.parametrize("kind", ["quadruped", "bird", "fish"])
def test_the_skin_is_closed_and_hangs_on_every_bone(kind):
    for seed in range(3):
        animal = getattr(creature, kind)(generator(seed, 1))
        skin = make_skin(animal, generator(seed, 2), cells=80)
        assert is_closed(skin.triangles) and volume(skin.vertices, skin.triangles) > 0.005
        assert np.isfinite(skin.vertices).all() and (0 <= skin.color).all() and (skin.color <= 1).all()
        np.testing.assert_allclose(skin.weights.sum(1), 1, rtol=1e-5)
        owner = np.take_along_axis(skin.bones, skin.weights.argmax(1)[:, None], axis=1)[:, 0]
        assert set(owner) == set(range(len(animal.bones)))
        assert (skin.weights.max(1) > 0.99).mean() > 0.35  # mostly rigid
        far = np.abs(smooth_union(skin.vertices[: len(skin.vertices) // 2], animal.shapes))
        assert far.max() < 0.012  # the surface lies where the shapes end, within a cell


def test_weights_stay_within_one_limb():
    animal = creature.quadruped(generator(4, 1))
    skin = make_skin(animal, generator(4, 2), cells=80)
    names = [bone.name for bone in animal.bones]
    left, right = (np.array([side in name for name in names]) for side in ("_left", "_right"))
    held, owner = skin.weights > 0, np.take_along_axis(skin.bones, skin.weights.argmax(1)[:, None], axis=1)[:, 0]
    assert left[owner].any() and right[owner].any()
    assert not (held & right[skin.bones])[left[owner]].any() and not (held & left[skin.bones])[right[owner]].any()


def test_rotations_about_an_axis():
    axis = np.array([1.0, 2, -2]) / 3
    found = axis_rotation(axis, np.array([0.0, 0.8]))
    np.testing.assert_allclose(found[0], np.eye(3))
    np.testing.assert_allclose(found[1] @ axis, axis)
    np.testing.assert_allclose(found[1] @ found[1].T, np.eye(3), atol=1e-12)
    assert np.trace(found[1]) == pytest.approx(1 + 2 * np.cos(0.8)) and np.linalg.det(found[1]) == pytest.approx(1)
    turned = axis_rotation(np.array([0, 0, 1.0]), np.array([np.pi / 2]))[0] @ [1, 0, 0]
    np.testing.assert_allclose(turned, [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize("motion", MOTIONS)
def test_joints_hold_and_the_clip_loops(motion):
    animal = getattr(creature, MOTIONS[motion].kind)(generator(1, 1))
    phase = np.linspace(0, 2, 17)
    moved = bone_motion(animal, *turn_bones(animal, motion, phase))
    rotation = moved[..., :3, :3]
    np.testing.assert_allclose(
        rotation @ rotation.swapaxes(-1, -2), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-9
    )
    for index, bone in enumerate(animal.bones):
        if bone.parent >= 0:  # a joint is the same place for both of its bones
            joint = np.append(bone.pivot, 1)
            np.testing.assert_allclose(moved[:, index] @ joint, moved[:, bone.parent] @ joint, atol=1e-9)
    np.testing.assert_allclose(rotation[0], rotation[-1], atol=1e-9)
    assert np.abs(rotation - rotation[0]).max() > 0.15
    travel = moved[-1, :, :3, 3] - moved[0, :, :3, 3]
    np.testing.assert_allclose(travel, np.broadcast_to(travel[0], travel.shape), atol=1e-9)
    assert (travel[0, 2] > 0.1) == (motion != "wag")
    names = {bone.name for bone in animal.bones}
    assert set(turn_bones(animal, motion, phase)[0]) <= names  # every turn finds its bone


@pytest.mark.parametrize("motion", ["walk", "trot"])
def test_standing_feet_hardly_slide(motion):
    animal = creature.quadruped(generator(2, 1))
    phase = np.linspace(0, 1, 401)
    moved = bone_motion(animal, *turn_bones(animal, motion, phase))
    body = np.diff(moved[:, 0, 2, 3]).mean()
    for leg in ("hind_left", "front_right"):
        shape = next(s for s in animal.shapes if s.bone == animal.index(f"{leg}_2"))
        foot = moved[:, shape.bone] @ np.append(shape.b, 1)
        speed = np.diff(foot[:, 2]) / body
        still = np.abs(speed) < 0.25
        # down for a good part of the cycle, then quickly forward
        assert still.mean() > (0.35 if motion == "walk" else 0.25) and speed.max() > 2
        assert (np.abs(speed - 1) < 0.25).mean() < 0.2  # without the body's travel it would slide all the time


def test_tracks_are_exact_where_one_bone_carries_the_skin():
    mesh = make_animal("trot", 5, seed=3, cells=60)
    points = choose_points(mesh, 800, generator(0))
    track, bone = track_points(mesh, points), heaviest_bones(mesh, points)
    corners = mesh.triangles[points.triangle]
    alone = ((mesh.weights[corners].max(2) == 1) & (mesh.bones[corners][..., 0] == bone[:, None])).all(1)
    assert alone.mean() > 0.25
    motion = mesh.bone_pose @ np.linalg.inv(mesh.bone_pose[:1])
    expected = np.einsum("tmab,mb->tma", motion[:, bone][..., :3, :3], track[0]) + motion[:, bone][..., :3, 3]
    np.testing.assert_allclose(track[:, alone], expected[:, alone], atol=2e-6)
    assert np.abs(track - expected)[:, ~alone].max() > 1e-4  # near joints the skin bends


def test_seeds_make_different_animals_and_the_same_again():
    one, again, other = (make_animal("walk", 2, seed=seed, cells=40) for seed in (0, 0, 1))
    assert one.positions.tobytes() == again.positions.tobytes() and one.color.tobytes() == again.color.tobytes()
    assert one.positions.shape != other.positions.shape
    # the same animal, another motion
    assert make_animal("wag", 2, seed=0, cells=40).color.tobytes() == one.color.tobytes()
    for wrong in ({"motion": "hop"}, {"motion": "walk", "cycles": -1.0}):
        with pytest.raises(UsageError):
            make_animal(frames=2, **wrong)


def test_from_the_command_line(tmp_path, dpc_here):
    out = tmp_path / "fish.h5"
    words = ("--motion", "swim", "--frames", 3, "--size", 64, "--azimuths", "90", "--tracks", 200, "--jobs", 1)
    done = dpc_here("prepare", "synthetic", "animal", "-o", out, *words, "--seed", 2)
    assert done.returncode == 0, done.stderr
    with ViewsReader(out) as reader:
        assert reader.header.role == ["reference", "test"] and reader.track.shape == (3, 200, 3)
        assert np.linalg.norm(reader.track, axis=-1).max() <= 0.75 + 1e-5 and reader.part.max() >= 3
        for view in range(2):
            pose, camera = reader.header.world_to_camera[view], reader.header.intrinsics[view]
            for frame in range(3):
                pixel = (reader.track[frame] @ pose[:3, :3].T + pose[:3, 3]) @ camera.T
                column, row = np.floor(pixel[:, :2] / pixel[:, 2:]).astype(int).T
                alpha = reader.rgba(view, frame)[..., 3]
                around = maximum_filter(alpha, 3)  # a point of the outline may lie in a pixel that no ray hit
                assert (around[row, column] > 0).all() and (alpha[row, column] > 0).mean() > 0.9
                assert 0.02 < (alpha > 0).mean() < 0.5
    assert dpc_here("prepare", "synthetic", "animal", "-o", out, "--motion", "hop").returncode == 2
