"""Animated glTF models: curves and skinning against SciPy and by hand, pictures against what was painted, broken files."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from dpcli.cli.prepare.views.animation import animation
from dpcli.cli.prepare.views.filming import FilmingOptions
from dpcli.errors import DataError, UsageError
from dpcli.ops.cameras import orbit_pose, pinhole
from dpcli.prepare.meshes.animated_mesh import Material, Texture, normalized
from dpcli.prepare.meshes.animation import animation_clip, list_clips, load_animation
from dpcli.prepare.meshes.bone_parts import choose_points, heaviest_bones, motion_distance, rigid_parts, track_points
from dpcli.prepare.meshes.filming import OBJECT_RADIUS, Filming, film, ground_truth
from dpcli.prepare.meshes.gltf import read_gltf
from dpcli.prepare.meshes.gltf_material import to_linear, to_srgb
from dpcli.prepare.meshes.gltf_nodes import clip_names
from dpcli.prepare.meshes.raycast import FrameCaster, sample_texture, world_rays
from dpcli.prepare.meshes.skinning import Curve, matrices, skin, slerp, vertex_normals
from dpcli.runtime.seeds import generator
from dpcli.store.views import ViewsReader
from tests.support.gltf_files import GlbFile, arm, quad

SMALL = Filming(size=48, test_azimuths=(60.0,), tracks=300, shading=0.0)


def quaternions(rng: np.random.Generator, count: int) -> np.ndarray:
    q = rng.normal(size=(count, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


@given(st.integers(0, 2**32 - 1))
def test_rotations_between_keys_against_scipy(seed):
    rng = np.random.default_rng(seed)
    times, keys = np.cumsum(rng.uniform(0.1, 1, 4)), quaternions(rng, 4)
    wanted = np.sort(rng.uniform(times[0], times[-1], 9))
    found = Curve(times, keys, rotation=True).at(wanted)
    expected = Slerp(times, Rotation.from_quat(keys))(wanted).as_matrix()
    np.testing.assert_allclose(Rotation.from_quat(found).as_matrix(), expected, atol=1e-7)


def test_half_way_between_two_rotations():
    quarter = np.array([[0, 0, np.sin(np.pi / 4), np.cos(np.pi / 4)]])
    none = np.array([[0, 0, 0, 1.0]])
    half = [[0, 0, np.sin(np.pi / 8), np.cos(np.pi / 8)]]
    np.testing.assert_allclose(slerp(none, quarter, np.array([[0.5]])), half, atol=1e-12)
    np.testing.assert_allclose(slerp(none, -quarter, np.array([[0.5]])), half, atol=1e-12)  # the short way round
    np.testing.assert_allclose(slerp(none, none, np.array([[0.3]])), none)


def test_cubic_splines_against_scipy_and_steps_by_hand():
    rng = np.random.default_rng(0)
    times, keys = np.array([0.0, 0.7, 1.0, 2.5]), rng.normal(size=(4, 3, 3))
    keys[:, 2] = keys[:, 0]  # one tangent per key, as SciPy has it
    wanted = np.linspace(0, 2.5, 21)
    expected = CubicHermiteSpline(times, keys[:, 1], keys[:, 0])(wanted)
    np.testing.assert_allclose(Curve(times, keys, "CUBICSPLINE").at(wanted), expected, atol=1e-12)
    kinked = keys.copy()
    kinked[1, 2] += 1  # the tangent out of key 1 bends what comes after it, and only that
    changed = np.abs(Curve(times, kinked, "CUBICSPLINE").at(wanted) - expected).max(1) > 1e-9
    assert changed.any() and (wanted[changed] > 0.7).all() and (wanted[changed] < 1.0).all()
    stairs = Curve(np.array([0.0, 1, 2]), np.array([[5.0], [6], [7]]), "STEP")
    np.testing.assert_array_equal(stairs.at([-1, 0, 0.99, 1, 1.5, 2, 9])[:, 0], [5, 5, 5, 6, 6, 7, 7])


def test_matrices_against_scipy():
    rng = np.random.default_rng(1)
    q, shift, scale = quaternions(rng, 5), rng.normal(size=(5, 3)), rng.uniform(0.5, 2, (5, 3))
    points = rng.normal(size=(7, 3))
    for matrix, rotation, t, s in zip(matrices(shift, q, scale), Rotation.from_quat(q), shift, scale, strict=True):
        np.testing.assert_allclose(points @ matrix[:3, :3].T + matrix[:3, 3], rotation.apply(points * s) + t)


def test_a_bending_arm_by_hand(tmp_path):
    mesh = load_animation(arm().write(tmp_path / "arm.glb"), "bend", 2)  # frames at 0 and half way: 45 degrees
    rest, bent = mesh.positions.astype(float) - [0, 5, 0]
    np.testing.assert_allclose(rest[8:], [[2, -0.1, 0], [2, 0.1, 0]], atol=1e-6)
    np.testing.assert_allclose(bent[:6], rest[:6], atol=1e-6)
    c = np.sqrt(0.5)
    np.testing.assert_allclose(bent[8:], [[1 + c * 1.1, c * 0.9, 0], [1 + c * 0.9, c * 1.1, 0]], atol=1e-6)
    smooth = load_animation(arm(smooth=True).write(tmp_path / "smooth.glb"), None, 2).positions[1] - [0, 5, 0]
    # at the elbow: the mean of what both bones make of it
    np.testing.assert_allclose(smooth[4], [1 + c * 0.1 / 2, (-0.1 - c * 0.1) / 2, 0], atol=1e-6)
    np.testing.assert_allclose(mesh.time, [0, 0.5])


def test_normals_follow_the_inverse_transpose():
    rng = np.random.default_rng(2)
    motion = np.tile(np.eye(4), (1, 2, 1, 1))
    motion[0, :, :3, :3] = rng.normal(size=(2, 3, 3))
    motion[0, 1, :, 0] *= -np.sign(np.linalg.det(motion[0, 0, :3, :3]) * np.linalg.det(motion[0, 1, :3, :3]))
    normals = rng.normal(size=(6, 3))
    bones, weights = np.repeat([[0], [1]], 3, axis=0), np.ones((6, 1))
    _, turned = skin(rng.normal(size=(6, 3)), normals, bones, weights, motion)  # one of both bones mirrors
    for n, bone, found in zip(normals, bones[:, 0], turned[0], strict=True):
        expected = np.linalg.inv(motion[0, bone, :3, :3]).T @ n
        np.testing.assert_allclose(found, expected / np.linalg.norm(expected), atol=1e-5)


def test_morph_targets_add_up(tmp_path):
    file = quad()
    primitive = file.tree["meshes"][0]["primitives"][0]
    up, wide = np.tile([0.0, 1, 0], (4, 1)), np.array([[-1.0, 0, 0], [1, 0, 0], [1, 0, 0], [-1, 0, 0]])
    primitive["targets"] = [{"POSITION": file.add(up)}, {"POSITION": file.add(wide)}]
    file.animate(0, "weights", [0, 1], [0, 0, 1, 2])
    mesh = load_animation(file.write(tmp_path / "morph.glb"), None, 2)
    np.testing.assert_allclose(mesh.positions[1] - mesh.positions[0], 0.5 * up + 1.0 * wide, atol=1e-6)


def test_accessors_strided_normalized_and_sparse(tmp_path):
    file = GlbFile()
    rng = np.random.default_rng(3)
    rows = rng.normal(size=(5, 5)).astype("f4")
    view = file.view(rows.tobytes(), byteStride=20)
    inside = {"bufferView": view, "byteOffset": 8, "componentType": 5126, "count": 5, "type": "VEC3"}
    sparse = {
        "count": 2,
        "indices": {"bufferView": file.view(np.array([1, 4], "u2").tobytes()), "componentType": 5123},
        "values": {"bufferView": file.view(np.arange(6, dtype="f4").tobytes())},
    }
    file.tree["accessors"] = [inside, {**inside, "sparse": sparse}, {**inside, "sparse": sparse}]
    del file.tree["accessors"][2]["bufferView"], file.tree["accessors"][2]["byteOffset"]
    bytes_, shorts = (
        file.add([[0, 128, 255]], "u1", normalized=True),
        file.add([-32768, 0, 32767], "i2", normalized=True),
    )
    read = read_gltf(file.write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(read.accessor(0, "x", 3), rows[:, 2:])
    expected = rows[:, 2:].copy()
    expected[[1, 4]] = [[0, 1, 2], [3, 4, 5]]
    np.testing.assert_array_equal(read.accessor(1, "x"), expected)
    np.testing.assert_array_equal(read.accessor(2, "x"), np.where(np.isin(range(5), [1, 4])[:, None], expected, 0))
    np.testing.assert_allclose(read.accessor(bytes_, "x"), [[0, 128 / 255, 1]])
    np.testing.assert_allclose(read.accessor(shorts, "x"), [-1, 0, 1])
    with pytest.raises(DataError, match="SCALAR, expected 3"):
        read.accessor(shorts, "x", 3)


def look(mesh, size: int = 64, samples: int = 1, shading: float = 0.0, frame: int = 0) -> np.ndarray:
    """From straight ahead; a square of side 2 fills the picture exactly."""
    camera = np.array([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]])
    return FrameCaster(mesh, frame, shading).picture(camera, orbit_pose(0.0, 0.0, 2.0), (size, size), samples)


def test_a_texture_is_seen_where_it_was_painted(tmp_path):
    file = quad()
    colors = np.array([[[255, 0, 0, 255], [0, 200, 0, 255]], [[0, 0, 120, 255], [90, 90, 0, 255]]], np.uint8)
    file.picture(np.repeat(np.repeat(colors, 16, 0), 16, 1))
    image = look(load_animation(file.write(tmp_path / "quad.glb"), None, 1))
    for row, column in np.ndindex(2, 2):  # away from the seams, where neighbors mix
        patch = image[32 * row + 3 : 32 * row + 29, 32 * column + 3 : 32 * column + 29]
        assert (patch == colors[row, column]).all()


def test_vertex_colors_and_factors_multiply_in_linear_light(tmp_path):
    file = quad()
    file.tree["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [0.5, 1, 1, 1]
    corners = [[65535, 0, 0], [65535, 0, 0], [0, 65535, 0], [0, 65535, 0]]  # red below, green above
    attributes = file.tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["COLOR_0"] = file.add(corners, "u2", normalized=True)
    image = look(load_animation(file.write(tmp_path / "c.glb"), None, 1)).astype(int)
    height = 1 - (np.arange(64) + 0.5) / 64  # of the rows, 1 at the top
    expected = 255 * to_srgb(np.stack([0.5 * (1 - height), height, 0 * height], axis=1))
    assert np.abs(image[:, 20, :3] - expected).max() <= 1
    assert (image[..., 3] == 255).all()


def test_srgb_round_trip_and_known_value():
    levels = np.arange(256) / 255
    np.testing.assert_allclose(to_srgb(to_linear(levels)), levels, atol=1e-6)
    assert to_linear(np.array(0.5)) == pytest.approx(0.21404114)


@pytest.mark.parametrize(
    "mode, middle", [("MASK", (0, 0, 255, 255)), ("BLEND", (128, 0, 127, 255)), ("OPAQUE", (255, 0, 0, 255))]
)
def test_transparency_shows_what_is_behind(tmp_path, mode, middle):
    file = quad()
    file.tree["materials"] = [
        {"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 0.498]}, "alphaMode": mode},
        {"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 1, 1]}},
    ]
    primitives = file.tree["meshes"][0]["primitives"]
    behind = file.add([[-1, -1, -0.5], [1, -1, -0.5], [1, 1, -0.5], [-1, 1, -0.5]])
    primitives.append({"attributes": {"POSITION": behind}, "indices": primitives[0]["indices"], "material": 1})
    image = look(load_animation(file.write(tmp_path / "t.glb"), None, 1))
    assert np.abs(image[32, 32].astype(int) - middle).max() <= 1


def test_alpha_is_the_share_of_a_pixel_that_is_covered():
    """A square that ends in the middle of a pixel; its color doesn't fade with its alpha."""
    mesh = square_mesh((0.2, 0.7, 0.1))
    half = mesh.moved(np.eye(3), np.array([1 / 64, 0, 0]), 1.0)  # half a pixel to the right
    image = look(half, samples=4)
    assert (image[:, 0, 3] == 128).all() and (image[:, 1:, 3] == 255).all()
    assert (image[..., :3] == image[5, 5, :3]).all()
    assert not look(mesh.moved(np.eye(3), np.array([5.0, 0, 0]), 1.0)).any()  # out of sight


def square_mesh(color):
    from dpcli.prepare.meshes.animated_mesh import AnimatedMesh

    positions = np.array([[[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]], np.float32)
    return AnimatedMesh(
        "square",
        np.zeros(1),
        positions,
        np.tile(np.float32([0, 0, 1]), (1, 4, 1)),
        np.array([[0, 1, 2], [0, 2, 3]]),
        np.zeros(2, np.int64),
        (Material((*color, 1.0)),),
        np.ones((4, 4), np.float32),
        np.zeros((4, 2), np.float32),
        np.zeros((4, 1), np.int64),
        np.ones((4, 1), np.float32),
        np.eye(4)[None, None],
        np.array([-1]),
    )


def test_light_stays_with_the_world():
    mesh = square_mesh((0.5, 0.5, 0.5))
    plain, lit = look(mesh), look(mesh, shading=1.0)
    assert 0 < lit[32, 32, 0] <= plain[32, 32, 0] + 1
    tilt = np.array([[1, 0, 0], [0, np.cos(0.9), -np.sin(0.9)], [0, np.sin(0.9), np.cos(0.9)]])
    down, up = (
        look(mesh.moved(tilt, np.zeros(3), 1.0), shading=1.0),
        look(mesh.moved(tilt.T, np.zeros(3), 1.0), shading=1.0),
    )
    assert int(up[32, 32, 0]) > int(down[32, 32, 0]) + 20  # light comes from above
    assert (look(mesh.moved(tilt, np.zeros(3), 1.0))[32, 32] == plain[32, 32]).all()  # none without shading


def test_rays_go_through_the_pixels_they_belong_to():
    intrinsics, pose = pinhole(0.9, 40, 30), orbit_pose(0.4, -0.3, 2.0)
    rays = world_rays(intrinsics, pose, slice(3, 9), slice(5, 20), 2).astype(float)
    point = (rays[..., :3] + 1.7 * rays[..., 3:]) @ pose[:3, :3].T + pose[:3, 3]
    pixel = point @ intrinsics.T
    x, y = pixel[..., 0] / pixel[..., 2], pixel[..., 1] / pixel[..., 2]
    assert np.abs(x[0, 0, :, :] - (np.arange(5, 20)[:, None] + [0.25, 0.75])).max() < 1e-4
    assert np.abs(y[:, :, 0, 0] - (np.arange(3, 9)[:, None] + [0.25, 0.75])).max() < 1e-4


@pytest.mark.parametrize("wrap, expected", [("repeat", 0), ("clamp", 3), ("mirror", 3)])
def test_textures_beyond_their_edge(wrap, expected):
    row = np.array([20, 60, 120, 250], np.uint8)
    pixels, light = np.repeat(row, 4).reshape(1, 4, 4), to_linear(row / 255)
    texture = Texture(pixels, (wrap, "repeat"))
    np.testing.assert_allclose(
        sample_texture(texture, np.array([[1 + 0.5 / 4, 0.5]]))[0],
        [*[light[expected]] * 3, row[expected] / 255],
        rtol=1e-5,
    )
    between = sample_texture(texture, np.array([[0.25, 0.5]]))[0, 0]  # the mean of the light, not of the codes
    assert between == pytest.approx((light[0] + light[1]) / 2, rel=1e-5)
    moved = Texture(pixels, (wrap, "repeat"), np.array([[0.5, 0, 0.25], [0, 1, 0]]))
    assert sample_texture(moved, np.array([[0.25, 0.5]]))[0, 0] == pytest.approx(light[1], rel=1e-5)  # 0.25 -> 0.375


def test_objects_fill_the_same_ball_whatever_their_size(tmp_path):
    mesh = load_animation(arm().write(tmp_path / "arm.glb"), None, 8)
    for scale in (1e-3, 1.0, 50.0):
        ball = normalized(mesh.moved(np.eye(3), scale * np.array([3.0, -2, 1]), scale), OBJECT_RADIUS, yaw=0.7)
        reach = np.linalg.norm(ball.positions, axis=-1)
        assert reach.max() == pytest.approx(OBJECT_RADIUS, rel=1e-4)
        points = choose_points(ball, 50, generator(0))
        moved = ball.bone_pose @ np.linalg.inv(ball.bone_pose[:1])
        carried = track_points(ball, points)
        for bone in (1, 2):  # bones and vertices were moved alike
            mine = heaviest_bones(ball, points) == bone
            expected = carried[0, mine] @ moved[:, bone, :3, :3].transpose(0, 2, 1) + moved[:, bone, None, :3, 3]
            far = np.abs(carried[:, mine] - expected).max(axis=(0, 2))
            assert (far < 1e-5).mean() > 0.7  # the others lie on the one square that bends


def test_without_travel_the_middle_stays(tmp_path):
    mesh = load_animation(quad(shift=4.0).write(tmp_path / "q.glb"), None, 5)
    assert np.ptp(normalized(mesh, 1.0).positions[..., 0].mean(1)) > 0.5
    still = normalized(mesh, 1.0, travel=False).positions
    np.testing.assert_allclose(still, np.broadcast_to(still[:1], still.shape), atol=1e-6)


def test_points_of_a_part_move_as_one_body(tmp_path):
    mesh = normalized(load_animation(arm().write(tmp_path / "arm.glb"), None, 6), OBJECT_RADIUS)
    points = choose_points(mesh, 400, generator(5))
    track, bone = track_points(mesh, points), heaviest_bones(mesh, points)
    part = rigid_parts(mesh.bone_pose, mesh.bone_parent, bone, track, 0.005, 4)
    assert sorted(np.bincount(part) > 50) == [True, True]
    along = points_along(track[0])
    for index in (0, 1):
        mine = (part == index) & ((along < 0.48) | (along > 0.76))  # not on the square beside the elbow, which bends
        apart = np.linalg.norm(track[:, mine][:, :, None] - track[:, mine][:, None], axis=-1)
        assert np.ptp(apart, axis=0).max() < 1e-5
    everyone = np.linalg.norm(track[:, :, None] - track[:, None], axis=-1)
    assert np.ptp(everyone, axis=0).max() > 0.1  # the two together don't


def test_the_tolerance_of_parts_is_a_share_of_the_radius(tmp_path):
    mesh = normalized(load_animation(arm().write(tmp_path / "arm.glb"), None, 6), OBJECT_RADIUS)
    points = choose_points(mesh, SMALL.tracks, generator(SMALL.seed))
    track, bone = track_points(mesh, points), heaviest_bones(mesh, points)
    upper, lower = np.unique(bone)
    first, second = ((mesh.bone_pose @ np.linalg.inv(mesh.bone_pose[0]))[:, one] for one in (upper, lower))
    apart = motion_distance(first, second, track[0, bone == lower].astype(np.float64)) / 0.75  # the radius
    for share, parts in ((0.99, 2), (1.01, 1)):
        assert len(np.unique(ground_truth(mesh, replace(SMALL, part_tolerance=share * apart))[1])) == parts


def points_along(points: np.ndarray) -> np.ndarray:
    """0 at the shoulder .. 1 at the end of the straight arm."""
    x = points[:, 0].astype(float)
    return (x - x.min()) / np.ptp(x)


def test_bones_that_do_not_move_on_their_own_are_one_part():
    turn = matrices(np.zeros((3, 3)), Rotation.from_euler("z", [[0], [0.3], [0.9]]).as_quat(), np.ones((3, 3)))
    root, still = np.tile(np.eye(4), (3, 1, 1)), np.eye(4)
    still[:3, 3] = [1, 0, 0]
    # 0 the root, 1 fixed to it, 2 turns, 3 fixed to 2, listed before its parent's parent in no special order
    pose = np.stack([root, root @ still, turn, turn @ still], axis=1)
    parent = np.array([-1, 0, 1, 2])
    bone = np.repeat([0, 1, 2, 3], 10)
    points = np.random.default_rng(6).normal(size=(40, 3))
    track = np.stack([points] * 3)
    np.testing.assert_array_equal(rigid_parts(pose, parent, bone, track, 1e-6, 1), np.repeat([0, 1], 20))
    assert set(rigid_parts(pose, parent, bone, track, 10.0, 1)) == {0}  # a tolerance that forgives all
    # too small a part joins the one that carries it best
    few = np.repeat([0, 1, 2, 3], [30, 5, 2, 0])
    assert set(rigid_parts(pose, parent, few, track[:, :37], 1e-6, 3)) == {0}
    assert motion_distance(turn, turn, points) == 0 and motion_distance(turn, root, points) > 0.5


def test_tracks_lie_on_the_object_and_have_its_colors(tmp_path):
    """Shown points have the color that the surface has there; points moved aside have not."""
    file = arm()
    attributes = file.tree["meshes"][0]["primitives"][0]["attributes"]
    ramp = np.linspace(0.1, 1, 10)
    attributes["COLOR_0"] = file.add(np.stack([ramp, 1 - ramp, 0 * ramp + 0.3], axis=1))
    path = file.write(tmp_path / "arm.glb")
    filming = Filming(size=128, test_azimuths=(30.0,), tracks=300, shading=0.0)
    mesh = normalized(load_animation(path, None, 4), OBJECT_RADIUS)
    clip = animation_clip(path, None, 4, filming)
    points = choose_points(mesh, 300, generator(0))
    corners = mesh.triangles[points.triangle]
    wanted = 255 * to_srgb(np.einsum("mk,mka->ma", points.weights, mesh.color[corners])[:, :3])
    for view, frame, rgba in clip.pictures():
        pixel = project(clip.track[frame], clip.header, view)
        inner = rgba[pixel[:, 1], pixel[:, 0], 3] == 255
        assert inner.mean() > 0.7 and (rgba[pixel[:, 1], pixel[:, 0], 3] > 0).mean() > 0.97
        error = np.abs(rgba[pixel[:, 1], pixel[:, 0], :3].astype(float) - wanted)[inner]
        assert error.max() < 14 and error.mean() < 3  # half a pixel off, along the ramp
        aside = project(clip.track[frame] + np.float32([0.2, 0, 0]), clip.header, view)
        assert np.abs(rgba[aside[:, 1], aside[:, 0], :3].astype(float) - wanted).mean() > 20


def project(points: np.ndarray, header, view: int) -> np.ndarray:
    """Pixels i64 (M,2), column and row."""
    pose = header.world_to_camera[view]
    pixel = (points.astype(float) @ pose[:3, :3].T + pose[:3, 3]) @ header.intrinsics[view].T
    return np.clip(np.floor(pixel[:, :2] / pixel[:, 2:]).astype(int), 0, header.size[0] - 1)


def test_from_the_command_line(tmp_path, dpc_here):
    path, out, again = arm().write(tmp_path / "arm.glb"), tmp_path / "a.h5", tmp_path / "b.h5"
    options = ("--frames", 5, "--size", 48, "--azimuths", "60,-60", "--train-azimuths", "45", "--tracks", 64)
    done = dpc_here("prepare", "animation", path, "-o", out, *options, "--clip", "Bend", "--jobs", 1)
    assert done.returncode == 0, done.stderr
    assert b"arm Rig|Bend, 4 views, 5 frames, 48x48" in done.stdout
    with ViewsReader(out) as reader:
        assert reader.header.role == ["reference", "train", "test", "test"]
        assert reader.track.shape == (5, 64, 3) and set(reader.part) == {0, 1}
        assert all(reader.rgba(view, frame)[..., 3].any() for view in range(4) for frame in range(5))
        np.testing.assert_allclose(reader.header.time, np.arange(5) / 5)
    assert dpc_here("prepare", "animation", path, "-o", again, *options, "--clip", "Bend", "--jobs", 2).returncode == 0
    assert out.read_bytes() == again.read_bytes()  # whatever the number of processes
    listed = dpc_here("prepare", "animation", path, "--list", "--json")
    assert json.loads(listed.stdout) == {"clips": [{"name": "Rig|Bend", "seconds": 1.0}]}
    with pytest.raises(UsageError, match="-o/--output FILE is missing"):
        animation(path, options=FilmingOptions())
    path.write_bytes(path.read_bytes()[:-9])
    broken = dpc_here("prepare", "animation", path, "-o", tmp_path / "c.h5")
    assert broken.returncode == 3 and b"truncated" in broken.stderr and b"Traceback" not in broken.stderr


def broken_files() -> dict[str, tuple[GlbFile, str]]:
    """Files with one fault each, and a word of the message it must get."""
    files = {
        name: arm()
        for name in (
            "no animation",
            "nan key",
            "nan bone",
            "zero quaternion",
            "times fall",
            "bone missing",
            "required",
            "circle",
            "no mesh",
            "weights",
            "short",
            "outside",
            "version",
        )
    }
    trees = {name: file.tree for name, file in files.items()}
    del trees["no animation"]["animations"]
    files["nan key"].animate(1, "translation", [0, 1], [[0, 0, 0], [0, np.nan, 0]])
    bind = np.tile(np.eye(4).ravel(), (2, 1))
    bind[1, 3] = np.nan
    trees["nan bone"]["skins"][0]["inverseBindMatrices"] = files["nan bone"].add(bind)
    files["zero quaternion"].animate(1, "rotation", [0, 1], [[0, 0, 0, 1], [0, 0, 0, 0]])
    files["times fall"].animate(1, "translation", [1, 0], np.zeros((2, 3)))
    trees["bone missing"]["skins"][0]["joints"] = [1]
    trees["required"]["extensionsRequired"] = ["ACME_required"]
    trees["circle"]["nodes"][2]["children"] = [0]
    trees["no mesh"]["nodes"][3] = {"name": "strip"}
    primitive = trees["weights"]["meshes"][0]["primitives"][0]
    primitive["attributes"]["WEIGHTS_0"] = files["weights"].add(np.full((10, 4), np.nan))
    trees["short"]["accessors"][0]["count"] = 999
    trees["outside"]["images"] = [{"uri": "../../secret.png"}]
    trees["outside"]["textures"] = [{"source": 0}]
    trees["outside"]["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    trees["outside"]["meshes"][0]["primitives"][0]["material"] = 0
    trees["version"]["asset"]["version"] = "1.0"
    words = {
        "no animation": "no animation",
        "nan key": "'shoulder': NaN",
        "nan bone": "bones of skin 0: NaN",
        "zero quaternion": "key 1 is zero",
        "times fall": "do not rise",
        "bone missing": "bone 1 of 1",
        "required": "ACME_required",
        "circle": "circle",
        "no mesh": "no triangles",
        "weights": "10 of 10 vertices",
        "short": "truncated or damaged",
        "outside": "outside its folder",
        "version": "version 1.0",
    }
    return {name: (file, words[name]) for name, file in files.items()}


@pytest.mark.parametrize("name", broken_files())
def test_broken_files_get_a_sentence(tmp_path, name):
    file, word = broken_files()[name]
    with pytest.raises(DataError, match=word) as caught:
        load_animation(file.write(tmp_path / "broken.glb"), None, 3)
    assert "broken.glb" in str(caught.value) and len(str(caught.value).splitlines()) <= 2


def test_what_is_no_gltf_at_all(tmp_path):
    (tmp_path / "a.glb").write_bytes(b"PK\x03\x04 a zip")
    (tmp_path / "empty.gltf").write_bytes(b"")
    for name, word in (
        ("a.glb", "not a glTF file but a damaged zip archive"),
        ("empty.gltf", "the file is empty"),
        ("none.glb", "cannot be read"),
        ("", "folder; name one"),
    ):
        with pytest.raises(DataError, match=word):
            list_clips(tmp_path / name)
    with pytest.raises(UsageError, match="Rig.Bend"):
        load_animation(arm().write(tmp_path / "arm.glb"), "Run", 2)


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_damage_never_ends_in_anything_but_an_error_in_words(tmp_path_factory, data):
    """Any cut, and any changed byte of the JSON: read or refused, never a crash, never NaN."""
    whole = arm().bytes()
    path = tmp_path_factory.getbasetemp() / "damaged.glb"
    if data.draw(st.booleans()):
        path.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
        with pytest.raises(DataError):
            load_animation(path, None, 2)
        return
    place, value = (
        data.draw(st.integers(20, 20 + len(whole) // 2)),
        data.draw(st.sampled_from(b'0123456789-.e"[]{},:truefals')),
    )
    path.write_bytes(whole[:place] + bytes([value]) + whole[place + 1 :])
    try:
        assert np.isfinite(load_animation(path, None, 2).positions).all()
    except DataError:
        pass


def test_lost_weights_follow_their_neighbors(tmp_path):
    """A real exporter's fault: 0/0 weights of a few vertices."""
    file = arm()
    accessor = file.tree["accessors"][file.tree["meshes"][0]["primitives"][0]["attributes"]["WEIGHTS_0"]]
    start = file.tree["bufferViews"][accessor["bufferView"]]["byteOffset"]
    whole = load_animation(arm().write(tmp_path / "arm.glb"), None, 3).positions
    file.data[start + 9 * 16 : start + 10 * 16] = np.full(4, np.nan, "f4").tobytes()
    np.testing.assert_allclose(load_animation(file.write(tmp_path / "lost.glb"), None, 3).positions, whole, atol=1e-6)


def test_a_weight_below_zero_is_that_of_its_own_bone(tmp_path):
    """Some exporters leave a little of it behind their smoothing; the weights still sum to 1."""
    still, file = arm(), arm()
    accessor = file.tree["accessors"][file.tree["meshes"][0]["primitives"][0]["attributes"]["WEIGHTS_0"]]
    start = file.tree["bufferViews"][accessor["bufferView"]]["byteOffset"]
    file.data[start : start + 16] = np.array([1.25, -0.25, 0, 0], "f4").tobytes()  # a vertex of the shoulder
    by_shoulder, mixed = (load_animation(one.write(tmp_path / "arm.glb"), None, 3) for one in (still, file))
    poses, rest = by_shoulder.bone_pose, by_shoulder.positions[0, 0] - [0, 5, 0]
    by_elbow = np.einsum("tab,b->ta", poses[:, 2, :3, :3], rest - [1, 0, 0]) + poses[:, 2, :3, 3]
    np.testing.assert_allclose(mixed.positions[:, 0], 1.25 * by_shoulder.positions[:, 0] - 0.25 * by_elbow, atol=1e-5)


def test_objects_without_extent_or_numbers_are_refused():
    point = square_mesh((1, 1, 1)).moved(np.eye(3), np.zeros(3), 0.0)
    with pytest.raises(DataError, match="one point"):
        film(point, SMALL)
    holed = square_mesh((1, 1, 1))
    holed.positions[0, 2, 1] = np.nan
    with pytest.raises(DataError, match="frame 0 are not finite"):
        film(holed, SMALL)
    with pytest.raises(UsageError, match="--shading 3: expected 0 to 1"):
        Filming(shading=3)
    with pytest.raises(UsageError, match="twice"):
        Filming(test_azimuths=(10.0, 370.0))


def test_vertex_normals_of_a_fold():
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    found = vertex_normals(positions, np.array([[0, 1, 2], [0, 2, 3]]))
    np.testing.assert_allclose(found[1], [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(found[0], np.array([1, 0, 1]) / np.sqrt(2), atol=1e-6)


def test_every_real_model_moves_and_has_parts(shared_data):
    """The last clip of each: finite, moving, rigid parts, bones that fit the skin."""
    files = sorted((shared_data / "animated_meshes").glob("*_pack/*.glb"))
    assert len(files) == 60
    whole = []
    for path in files:
        mesh = normalized(load_animation(path, clip_names(read_gltf(path))[-1], 4), OBJECT_RADIUS)
        assert np.isfinite(mesh.positions).all() and np.ptp(mesh.positions, axis=0).max() > 0.01, path
        points = choose_points(mesh, 500, generator(0))
        track, bone = track_points(mesh, points), heaviest_bones(mesh, points)
        part = rigid_parts(mesh.bone_pose, mesh.bone_parent, bone, track, 0.0075, 5)
        assert part.max() + 1 <= len(set(bone)), path
        whole += [path.name] if part.max() == 0 else []
        motion = mesh.bone_pose @ np.linalg.pinv(mesh.bone_pose[:1])
        carried = np.einsum("tmab,mb->tma", motion[:, bone][..., :3, :3], track[0]) + motion[:, bone][..., :3, 3]
        # a bone's motion explains most of its skin: wrong hierarchies or bind poses would throw it far away
        assert np.median(np.linalg.norm(carried - track, axis=-1)[1:]) < 0.02, path
    assert whole == ["Fish1.glb"]  # its root bone outweighs all others at every vertex


def test_positions_agree_with_another_reader(shared_data):
    trimesh = pytest.importorskip("trimesh")
    path = shared_data / "animated_meshes" / "animals_pack" / "Fox.glb"
    file = read_gltf(path)
    ours = [
        file.accessor(primitive["attributes"]["POSITION"], "positions")
        for mesh in file.items("meshes")
        for primitive in mesh["primitives"]
    ]
    theirs = [g.vertices for g in trimesh.load(path, process=False).geometry.values()]
    assert sorted(map(len, ours)) == sorted(map(len, theirs))
    for a in ours:
        assert any(a.shape == b.shape and np.allclose(a, b) for b in theirs)
