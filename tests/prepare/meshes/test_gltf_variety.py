"""What glTF files of other exporters hold: emission, culling, instances, hidden nodes, odd names, clips and keys."""

from __future__ import annotations

import base64
import io
import json
import re
import struct
import zipfile
from contextlib import nullcontext
from dataclasses import replace
from urllib.parse import quote

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.config_diff import differences
from dpcli.errors import DataError, UsageError
from dpcli.prepare.meshes.animated_mesh import normalized
from dpcli.prepare.meshes.animation import animation_config, clip_outputs, list_clips, load_animation
from dpcli.prepare.meshes.filming import Filming, film, ground_truth
from dpcli.prepare.meshes.gltf import read_gltf
from dpcli.prepare.meshes.skinning import Curve
from tests.prepare.meshes.test_animation import look
from tests.support.gltf_files import GlbFile, arm, quad

SMALL = Filming(size=48, test_azimuths=(60.0,), tracks=300, shading=0.0)
BLUE = {"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 1, 1]}, "doubleSided": True}


def load(file: GlbFile, tmp_path, frames: int = 1, clip: str | None = None):
    return load_animation(file.write(tmp_path / "m.glb"), clip, frames)


def square(file: GlbFile, x: float, z: float = 0.0, half: float = 1.0) -> int:
    """One more mesh: a blue square around (x, 0, z), seen from both sides; returns its index."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * half + [x, 0, z]
    if len(file.tree["materials"]) < 2:
        file.tree["materials"].append(BLUE)
    indices = file.add([0, 1, 2, 0, 2, 3], "u4")
    primitive = {"attributes": {"POSITION": file.add(corners)}, "indices": indices, "material": 1}
    file.tree["meshes"].append({"primitives": [primitive]})
    return len(file.tree["meshes"]) - 1


def node(file: GlbFile, **more) -> int:
    """One more node of the scene; returns its index."""
    file.tree["nodes"].append(more)
    file.tree["scenes"][0]["nodes"].append(len(file.tree["nodes"]) - 1)
    return len(file.tree["nodes"]) - 1


# emission


@pytest.mark.parametrize(
    "material, expected",
    [
        ({"emissiveFactor": [1, 0, 0]}, [255, 0, 0]),
        ({"emissiveFactor": [0.2140411, 0, 1]}, [128, 0, 255]),
        (
            {
                "emissiveFactor": [0.1, 0, 0],
                "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 2.140411}},
            },
            [128, 0, 0],
        ),
        ({"emissiveFactor": [1, 0, 0], "extensions": {"KHR_materials_unlit": {}}}, [0, 0, 0]),
        ({}, [0, 0, 0]),
    ],
)
def test_what_gives_off_light_is_seen_without_light(tmp_path, material, expected):
    file = quad()
    file.tree["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}, **material}]
    image = look(load(file, tmp_path), shading=1.0)
    np.testing.assert_allclose(image[32, 32, :3].astype(int), expected, atol=1)


def test_emission_has_its_own_texture_coordinates_and_adds_to_the_base_color(tmp_path):
    file = quad()
    file.picture(np.array([[[0, 255, 0, 255], [0, 0, 255, 255]]], np.uint8).repeat(8, 1))
    attributes = file.tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["TEXCOORD_1"] = file.add([[1, 1], [0, 1], [0, 0], [1, 0]])  # mirrored
    glow = {"emissiveFactor": [1, 1, 1], "emissiveTexture": {"index": 0, "texCoord": 1}}
    file.tree["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}, **glow}]
    image = look(load(file, tmp_path))
    assert image[32, 5, :3].tolist() == [255, 0, 255] and image[32, 58, :3].tolist() == [255, 255, 0]


@pytest.mark.parametrize(
    "diffuse, red",
    [
        ({"diffuseFactor": [0.5, 0, 0, 1]}, 188),
        ({"diffuseTexture": {"index": 0}}, 188),
        ({"diffuseFactor": [0.5, 1, 1, 1], "diffuseTexture": {"index": 0}}, 137),
        ({"glossinessFactor": 0.3}, 137),
    ],
)
def test_the_older_color_of_a_material_is_not_multiplied_by_the_newer_one(tmp_path, diffuse, red):
    """As glTF-Transform's palette() leaves it: the newer color in a texture, the older one in a factor."""
    file = quad()
    file.picture(np.array([[[188, 0, 0, 255]]], np.uint8))
    material = file.tree["materials"][0]
    material["pbrMetallicRoughness"]["baseColorFactor"] = [0.5, 0, 0, 1]
    material["extensions"] = {"KHR_materials_pbrSpecularGlossiness": diffuse}
    np.testing.assert_allclose(look(load(file, tmp_path))[32, 32, :3].astype(int), [red, 0, 0], atol=1)


# light


def test_without_normals_each_triangle_is_lit_by_its_own_plane_as_it_moves(tmp_path):
    """As the specification asks: a roof that shares its ridge, folded by a morph target that brings no normals."""
    file = GlbFile()
    flat = [[-1, -1, 0], [-1, 1, 0], [0, -1, 0], [0, 1, 0], [1, -1, 0], [1, 1, 0]]
    ridge = [[0, 0, float(x == 0)] for x, _, _ in flat]
    indices = [0, 2, 1, 1, 2, 3, 2, 4, 3, 3, 4, 5]
    shape = {"attributes": {"POSITION": file.add(flat)}, "indices": file.add(indices, "u4")}
    file.tree["meshes"] = [{"primitives": [shape | {"targets": [{"POSITION": file.add(ridge)}]}]}]
    file.tree |= {"nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}]}
    file.animate(0, "weights", [0, 1], [[0], [2]])
    mesh = load(file, tmp_path, frames=2)
    still, folded = (look(mesh, shading=1.0, frame=frame)[32, :, 0].astype(int) for frame in (0, 1))
    assert np.ptp(still) == 0  # and after half the time the ridge stands 1 in front
    left, right = folded[8:28], folded[36:56]
    assert np.ptp(left) == np.ptp(right) == 0 and right[0] > left[0] + 20
    shape["attributes"]["NORMAL"] = file.add(np.tile([0, 0, 1.0], (6, 1)))
    assert np.ptp(look(load(file, tmp_path, frames=2), shading=1.0, frame=1)[32, 8:56, 0].astype(int)) == 0


# back faces


def test_the_back_of_a_surface_shows_only_where_the_file_says_so(tmp_path):
    file = quad()
    node(file, mesh=square(file, 0.0, z=-0.5))
    file.tree["nodes"][0]["rotation"] = [0, 1, 0, 0]  # its back is in front
    assert look(load(file, tmp_path))[32, 32].tolist() == [0, 0, 255, 255]
    file.tree["materials"][0]["doubleSided"] = True
    assert look(load(file, tmp_path))[32, 32].tolist() == [255, 255, 255, 255]


def test_tiny_models_are_seen_and_lit_and_unknown_words_for_alpha_are_none(tmp_path):
    """A unit of a millionth of a millionth of a millionth of a meter, and a word that viewers take for opaque."""
    file = quad()
    file.tree["nodes"][0]["scale"] = [1e-18] * 3
    file.tree["materials"] = [{"alphaMode": "TRANSPARENT", "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.5]}}]
    file.tree["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = file.add(np.tile([0, 0, 1.0], (4, 1)))
    mesh = load(file, tmp_path)
    np.testing.assert_allclose(mesh.normals, np.tile([0, 0, 1.0], (1, 4, 1)))
    assert (look(normalized(mesh, 0.75))[32, 32] == 255).all()


def test_a_mirrored_node_keeps_its_front(tmp_path):
    file = quad()
    file.tree["nodes"][0]["scale"] = [-1, 1, 1]
    assert look(load(file, tmp_path))[32, 32].tolist() == [255, 255, 255, 255]
    file.tree["nodes"][0]["scale"] = [-1, 1, -1]  # half a turn: that is its back
    assert look(load(file, tmp_path))[32, 32, 3] == 0


def test_of_several_scenes_the_one_that_viewers_show_is_read_and_told(tmp_path, capsys):
    file = quad()
    index = node(file, mesh=square(file, 5.0))
    file.tree |= {"scenes": [{"nodes": [0]}, {"nodes": [index], "name": "take 2"}], "scene": 1}
    assert load(file, tmp_path).positions[..., 0].min() == 4
    assert "2 scenes in it; 1 (take 2) is read, as viewers do" in capsys.readouterr().err


@pytest.mark.parametrize("scales", [(1, -1), (-1, 0.5), (-0.5, 1)])
def test_a_front_is_in_front_in_every_frame_of_a_clip_that_mirrors_it(scales, tmp_path):
    """As flat figures turn round, by a scale that jumps below 0; a scene names its root twice, too."""
    file = quad()
    file.tree["scenes"][0]["nodes"] = [0, 0]
    node(file, mesh=square(file, 0.0, z=-0.5))
    del file.tree["animations"]
    file.animate(0, "scale", [0, 1, 2], [[scale, 1, 1] for scale in (*scales, scales[1])], "STEP")
    mesh = load(file, tmp_path, frames=2)
    assert [look(mesh.frames(k, k + 1))[32, 32].tolist() for k in (0, 1)] == [[255] * 4] * 2
    assert mesh.positions.shape[1] == 8


def test_a_leaf_of_two_triangles_back_to_back_has_no_holes(tmp_path):
    file = quad()
    primitive = file.tree["meshes"][0]["primitives"][0]
    primitive["indices"] = file.add([0, 2, 1, 0, 3, 2, 0, 1, 2, 0, 2, 3], "u4")
    assert (look(load(file, tmp_path))[..., 3] == 255).all()


@pytest.mark.parametrize("path, values", [("scale", np.repeat([[0.0], [1], [1]], 3, 1)), ("visible", [0, 1, 1])])
def test_what_is_hidden_at_first_shows_no_back_either(tmp_path, path, values):
    file = empty()
    node(file, mesh=0, rotation=[0, 1, 0, 0])
    file.animate(0, path, [0, 0.5, 1], values, "STEP")
    if path == "visible":
        pointer = {"pointer": "/nodes/0/extensions/KHR_node_visibility/visible"}
        target = {"path": "pointer", "extensions": {"KHR_animation_pointer": pointer}}
        file.tree["animations"][0]["channels"][0]["target"] = target
    mesh = load(file, tmp_path, frames=4)
    assert [look(mesh, frame=frame)[32, 32, 3] for frame in range(4)] == [0] * 4
    file.tree["nodes"][0]["rotation"] = [0, 0, 0, 1]
    mesh = load(file, tmp_path, frames=4)
    assert [look(mesh, frame=frame)[32, 32, 3] for frame in range(4)] == [0, 0, 255, 255]


def test_dozens_of_clear_layers_hide_nothing_behind_them(tmp_path):
    """As shells of fur and the leaves of a tree, cut out of cards."""
    file = quad()
    file.tree["materials"] = [{"alphaMode": "MASK", "doubleSided": True}]
    file.tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = file.add(np.tile([1, 1, 1, 0.1], (4, 1)))
    for layer in range(40):
        node(file, mesh=0, translation=[0, 0, 0.01 * layer])
    node(file, mesh=square(file, 0.0, z=-0.5))
    assert look(load(file, tmp_path))[32, 32].tolist() == [0, 0, 255, 255]


@pytest.mark.parametrize("what", ["matrix of node 'rig'", "a bind matrix of skin 0"])
@pytest.mark.parametrize("transposed", [True, False])
def test_matrices_written_row_by_row_are_refused(tmp_path, what, transposed):
    file, shift = arm(), np.eye(4)
    shift[:3, 3] = [-1, 0, 0]
    columns = shift.ravel() if transposed else shift.T.ravel()
    if what.startswith("matrix"):
        file.tree["nodes"][0] = {"name": "rig", "children": [1, 3], "matrix": columns.tolist()}
    else:
        file.tree["skins"][0]["inverseBindMatrices"] = file.add([columns, columns])
    with pytest.raises(DataError, match=f"{what} has the last row -1, 0, 0, 1; ") if transposed else nullcontext():
        load(file, tmp_path)


# instances


@pytest.mark.parametrize("far", [1e3, 4e5, 1e7])
def test_a_model_on_a_map_is_as_sharp_as_one_at_the_origin(tmp_path, far):
    near = normalized(load_animation(arm(smooth=True).write(tmp_path / "m.glb"), None, 5), 1.0)
    file = arm(smooth=True)
    file.tree["nodes"][0]["translation"] = [far, 5 + far, -far]
    mesh = load_animation(file.write(tmp_path / "m.glb"), None, 5)
    moved = normalized(mesh, 1.0)
    np.testing.assert_allclose(moved.positions, near.positions, atol=1e-6)
    np.testing.assert_allclose(moved.bone_pose[:, 1:3], near.bone_pose[:, 1:3], atol=1e-6)


def test_instances_are_drawn_where_they_stand(tmp_path, capsys):
    file = quad()
    quarter = [0, 0, np.sqrt(0.5), np.sqrt(0.5)]
    attributes = {
        "TRANSLATION": file.add([[-3.0, 0, 0], [0, 0, 0], [3, 0, 0]]),
        "ROTATION": file.add(np.array([[0, 0, 0, 1], quarter, [0, 0, 0, 1]])),
        "SCALE": file.add([[1.0, 1, 1], [1, 0.5, 1], [-1, 1, 1]]),
    }
    file.tree["nodes"][0] |= {
        "extensions": {"EXT_mesh_gpu_instancing": {"attributes": attributes}},
        "translation": [0, 7, 0],
    }
    file.tree["extensionsUsed"] = file.tree["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    del file.tree["animations"]
    file.animate(0, "scale", [0, 1], [[1, 1, 1], [1, 1, 1]])
    found = load(file, tmp_path).positions[0].reshape(3, 4, 3)
    rest = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]])
    expected = [rest - [3, 0, 0], rest[:, [1, 0, 2]] * [-0.5, 1, 1], rest * [-1, 1, 1] + [3, 0, 0]]
    np.testing.assert_allclose(found, np.array(expected) + [0, 7, 0], atol=1e-6)
    assert "not read" not in capsys.readouterr().err
    vertex = file.add(np.tile([1.0, 0.5, 1], (4, 1)))
    file.tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = vertex
    colors = [[255, 0, 0], [0, 255, 0], [51, 51, 51]]  # as three.js writes those of its InstancedMesh
    attributes["_COLOR_0"] = file.add(colors, "u1", normalized=True)
    shown = [[1, 0, 0, 1], [0, 0.5, 0, 1], [0.2, 0.1, 0.2, 1]]
    np.testing.assert_allclose(load(file, tmp_path).color, np.repeat(shown, 4, axis=0), atol=1e-6)
    file.tree["nodes"][0]["extensions"]["EXT_mesh_gpu_instancing"]["attributes"]["SCALE"] = file.add([[1.0, 1, 1]])
    with pytest.raises(DataError, match=r"instances of node 0: their attributes have \[1, 3\] entries"):
        load(file, tmp_path)


# what is hidden


def hide(file: GlbFile, index: int, visible: bool = False) -> None:
    file.tree["nodes"][index].setdefault("extensions", {})["KHR_node_visibility"] = {"visible": visible}


def test_hidden_nodes_and_all_below_them_are_not_there(tmp_path):
    file = quad()
    below = node(file, mesh=square(file, 0.0, z=0.5))
    file.tree["scenes"][0]["nodes"].remove(below)
    above = node(file, children=[below])
    hide(file, above)
    mesh = load(file, tmp_path)
    assert mesh.positions.shape[1] == 4 and look(mesh)[32, 32].tolist() == [255, 255, 255, 255]
    hide(file, above, visible=True)
    assert look(load(file, tmp_path))[32, 32].tolist() == [0, 0, 255, 255]
    hide(file, 0), hide(file, above)
    with pytest.raises(DataError, match="no triangles in its scene"):
        load(file, tmp_path)


def test_visibility_that_changes_in_the_clip(tmp_path):
    file = quad(shift=1.0)
    index = node(file, mesh=square(file, 0.0, z=0.5))
    clip = file.tree["animations"][0]
    clip["samplers"].append({"input": file.add([0.0, 0.5]), "output": file.add([0, 1], "u1"), "interpolation": "STEP"})
    pointer = {"pointer": f"/nodes/{index}/extensions/KHR_node_visibility/visible"}
    target = {"path": "pointer", "extensions": {"KHR_animation_pointer": pointer}}
    clip["channels"].append({"sampler": 1, "target": target})
    mesh = load(file, tmp_path, frames=4)
    blue = [look(mesh, frame=frame)[32, 32].tolist() == [0, 0, 255, 255] for frame in range(4)]
    assert blue == [False, False, True, True]
    _, part = ground_truth(mesh, SMALL)
    assert np.bincount(part).min() > 100 and len(np.bincount(part)) == 2


@pytest.mark.parametrize("least", [0.0, 1e-4])
def test_stop_motion_has_tracks_and_parts_of_all_that_is_seen(tmp_path, capsys, least):
    """Four squares shown one after another by their scale: each is a part, and none of its tracks is lost."""
    file = quad()
    file.tree["nodes"], file.tree["scenes"][0]["nodes"] = [], []
    del file.tree["animations"]
    for k in range(4):
        index = node(file, mesh=square(file, 0.0, half=0.5), translation=[3.0 * k, 0, 0])
        scale = np.where(np.arange(4)[:, None] == k, 1, least) * np.ones(3)
        file.animate(index, "scale", [0, 1, 2, 3], scale, "STEP")
    file.animate(0, "translation", [0, 4], np.zeros((2, 3)))
    clip = film(load(file, tmp_path, frames=4), replace(SMALL, tracks=400))
    assert np.bincount(clip.part).tolist() == [100] * 4
    for k in range(4):
        extent = np.ptp(clip.track[:, clip.part == k], axis=1)[:, :2].min(1)
        assert extent[k] > 0.1 and (np.delete(extent, k) < 1e-3).all()
    assert "hidden in some frames, a point of no extent there: 400 of 400 tracks" in capsys.readouterr().err


def test_what_is_hidden_at_first_and_what_never_has_an_area(tmp_path):
    file = quad(shift=1.0)
    index = node(file, mesh=square(file, 4.0))
    file.animate(index, "scale", [0, 0.5, 1], [[0, 0, 0], [1, 1, 1], [1, 1, 1]], "STEP")
    _, part = ground_truth(load(file, tmp_path, frames=4), SMALL)
    assert np.bincount(part).tolist() == [150, 150]
    flat = quad(shift=1.0)
    flat.tree["meshes"][0]["primitives"][0]["indices"] = flat.add([0, 0, 1, 1, 2, 2], "u4")
    with pytest.raises(DataError, match="no triangle has an area in any frame"):
        film(load(flat, tmp_path, frames=2), SMALL)


def empty() -> GlbFile:
    """A scene without nodes and clips, whose materials 0 and 1 are white and blue."""
    file = quad()
    file.tree["nodes"], file.tree["scenes"][0]["nodes"] = [], []
    file.tree["materials"].append(BLUE)
    del file.tree["animations"]
    return file


@pytest.mark.parametrize("rate, count", [(24, 6), (30, 10), (10, 10), (29.97, 11), (60, 13)])
def test_each_frame_of_stop_motion_shows_its_own_object_at_any_rate(tmp_path, rate, count):
    """Keys at k / rate are rounded to 32 bits: a frame that misses its key by that must not show what was before."""
    file, times = empty(), np.arange(count + 1) / rate
    for k in range(count):
        index = node(file, mesh=square(file, 3.0 * k))
        file.animate(index, "scale", times, (np.arange(count + 1)[:, None] == k) * np.ones(3), "STEP")
    reach = np.ptp(load(file, tmp_path, frames=count).positions.reshape(count, count, 4, 3), axis=2).max(-1)
    np.testing.assert_array_equal(reach > 0, np.eye(count, dtype=bool))


def hidden_by_scale(file: GlbFile, index: int) -> None:
    file.animate(index, "scale", [0, 1], np.zeros((2, 3)))


def hidden_until_it_comes(file: GlbFile, index: int) -> None:
    file.animate(index, "scale", [0, 0.5, 1], np.repeat([[0.0], [1.0], [1.0]], 3, axis=1), "STEP")
    file.animate(index, "translation", [0, 0.5, 1], [[100, 0, 0], [0, 0, 0], [0, 0, 0]], "STEP")


def without_area(file: GlbFile, index: int) -> None:
    primitive = file.tree["meshes"][file.tree["nodes"][index]["mesh"]]["primitives"][0]
    primitive["indices"] = file.add([0, 0, 1, 2, 2, 2], "u4")


def clear(file: GlbFile, index: int) -> None:
    file.tree["materials"][1] = {"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0]}, "alphaMode": "BLEND"}


def cut_off(file: GlbFile, index: int) -> None:
    file.tree["materials"][1] = {"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.3]}, "alphaMode": "MASK"}


@pytest.mark.parametrize("hide_it", [hidden_by_scale, hidden_until_it_comes, without_area, clear, cut_off])
@pytest.mark.parametrize("travel", [True, False])
def test_what_shows_nothing_has_no_tracks_and_makes_nothing_small(tmp_path, hide_it, travel):
    """A square turns, and another one waits 100 units away: the first fills the picture as if it were alone."""
    file = empty()
    file.tree["nodes"].append({"mesh": 0})
    file.tree["scenes"][0]["nodes"].append(0)
    file.animate(0, "rotation", [0, 1], [[0, 0, 0, 1], [0, 0, 1, 0]])
    hide_it(file, node(file, mesh=square(file, 0.0), translation=[100, 0, 0]))
    mesh = normalized(load(file, tmp_path, frames=4), 0.75, travel=travel)
    np.testing.assert_allclose(
        np.linalg.norm(mesh.positions[:, :4], axis=2), 0.75, atol=0.6 if hide_it is hidden_until_it_comes else 1e-3
    )
    track, part = ground_truth(mesh, SMALL)
    assert np.linalg.norm(track, axis=2).max() < (0.751 if travel else 1.4)
    assert np.bincount(part).tolist() == ([150, 150] if hide_it is hidden_until_it_comes else [300])


def test_stop_motion_by_visibility_has_the_parts_of_stop_motion_by_scale(tmp_path):
    file = empty()
    for k in range(3):
        index = node(file, mesh=square(file, 3.0 * k))
        file.animate(index, "pointer", [0, 1, 2, 3], np.arange(4) == k, "STEP")
        extension = {"KHR_animation_pointer": {"pointer": f"/nodes/{index}/extensions/KHR_node_visibility/visible"}}
        file.tree["animations"][0]["channels"][-1]["target"] = {"path": "pointer", "extensions": extension}
    track, part = ground_truth(load(file, tmp_path, frames=3), SMALL)
    assert np.bincount(part).tolist() == [100] * 3
    extents = [np.ptp(track[:, part == k], axis=1).max(1) for k in range(3)]
    np.testing.assert_array_equal(np.array(extents) > 0.1, np.eye(3, dtype=bool))


# extensions


def test_extensions_that_change_the_picture_are_named_once(tmp_path, capsys):
    file = quad()
    odd = ["KHR_materials_transmission", "KHR_lights_punctual", "ACME_fur"]
    file.tree["extensionsUsed"] = [*odd, odd[0], "KHR_texture_transform", "KHR_xmp_json_ld"]
    load(file, tmp_path)
    assert capsys.readouterr().err.count(", ".join(odd)) == 1
    file.tree["extensionsRequired"] = ["ACME_fur"]
    with pytest.raises(DataError, match="ACME_fur, which is not read; export it without this extension"):
        load(file, tmp_path)
    file.tree["extensionsRequired"] = ["KHR_texture_basisu"]
    with pytest.raises(DataError, match="export its textures as PNG or JPEG"):
        load(file, tmp_path)


@pytest.mark.parametrize("target, named", [("/materials/0/emissiveFactor", True), ("/nodes/0/translation", False)])
def test_what_a_clip_changes_besides_nodes_is_named(tmp_path, capsys, target, named):
    file = quad()
    file.animate(0, "pointer", [0, 1], [[0, 0, 0], [1, 0, 0]])
    extension = {"KHR_animation_pointer": {"pointer": target}}
    file.tree["animations"][0]["channels"][1]["target"] = {"path": "pointer", "extensions": extension}
    mesh = load(file, tmp_path, frames=2)
    assert (f"also changes what is not read: {target}" in capsys.readouterr().err) is named
    assert np.ptp(mesh.positions[:, 0, 0]) == (0.0 if named else 0.5)


def test_extensions_of_materials_are_named_where_the_file_forgot_to(tmp_path, capsys):
    file = quad()
    file.tree["materials"][0]["extensions"] = {"KHR_materials_transmission": {}, "KHR_materials_unlit": {}}
    load(file, tmp_path)
    assert "may differ from a viewer's: KHR_materials_transmission\n" in capsys.readouterr().err


# surfaces


@pytest.mark.parametrize("mode, corners", [(5, [0, 1, 3, 2]), (6, [0, 1, 2, 3]), (4, [0, 1, 2, 0, 2, 3])])
@pytest.mark.parametrize("turned, seen", [(False, 1.0), (True, 0.0)])
def test_strips_and_fans_are_seen_from_their_front_alone(tmp_path, mode, corners, turned, seen):
    file = quad()
    file.tree["meshes"][0]["primitives"][0] |= {"indices": file.add(corners, "u1"), "mode": mode}
    file.tree["nodes"][0]["rotation"] = [0, int(turned), 0, int(not turned)]
    assert (look(load(file, tmp_path))[..., 3] == 255).mean() == seen


@pytest.mark.parametrize(
    "values, dtype, more, red",
    [
        ([55, 0, 0], "u1", {"normalized": True}, 55 / 255),
        ([55, 0, 0, 255], "u1", {}, 55 / 255),
        ([14135, 0, 0], "u2", {}, 55 / 255),
        ([55.0, 0, 0], "f4", {}, 55 / 255),
        ([1.5, 0, 0], "f4", {}, 1.5),
    ],
)
def test_vertex_colors_of_every_range(tmp_path, capsys, values, dtype, more, red):
    file = quad()
    file.tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = file.add([values] * 4, dtype, **more)
    np.testing.assert_allclose(load(file, tmp_path).color[0], [red, 0, 0, 1], rtol=1e-6)
    assert ("are taken as shares of" in capsys.readouterr().err) is (max(values) > 8 and not more)


def test_numbers_without_bytes_do_not_fill_the_memory(tmp_path):
    file = quad()
    file.tree["accessors"].append({"componentType": 5126, "count": 1 << 27, "type": "VEC3"})
    file.tree["meshes"][0]["primitives"] = [{"attributes": {"POSITION": len(file.tree["accessors"]) - 1}}]
    with pytest.raises(DataError, match="claims 134217728 entries, and has no bytes"):
        load(file, tmp_path)


def test_vertex_colors_above_1_make_brighter(tmp_path):
    file = quad()
    file.tree["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [0.1, 0.1, 0.1, 1]
    file.tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = file.add([[2.140411] * 3] * 4)
    np.testing.assert_allclose(look(load(file, tmp_path))[32, 32, :3].astype(int), [128] * 3, atol=1)


def test_a_picture_that_materials_share_is_decoded_once(tmp_path):
    file = quad()
    file.picture(np.array([[[255, 0, 0, 255], [0, 0, 255, 255]]], np.uint8))
    file.tree["materials"].append({**file.tree["materials"][0], "emissiveFactor": [0.1, 0, 0]})
    primitive = file.tree["meshes"][0]["primitives"][0]
    file.tree["meshes"][0]["primitives"].append({**primitive, "material": 1})
    first, second = load(file, tmp_path).materials
    assert first.texture.pixels is second.texture.pixels


@pytest.mark.parametrize("nearest, middle", [(True, [255, 0, 0]), (False, [188, 0, 188])])
def test_pixels_of_a_texture_are_squares_where_the_file_says_so(tmp_path, nearest, middle):
    file = quad()
    file.picture(np.array([[[255, 0, 0, 255], [0, 0, 255, 255]]], np.uint8))
    file.tree["samplers"], file.tree["textures"][0]["sampler"] = [{"magFilter": 9728 if nearest else 9729}], 0
    image = look(load(file, tmp_path))
    np.testing.assert_allclose(image[32, 31, :3].astype(int), middle, atol=3)


@pytest.mark.parametrize("how", ["PNG", "AVIF", "WEBP"])
def test_textures_of_16_bits_and_of_newer_formats(tmp_path, how):
    from PIL import Image

    file, data = quad(), io.BytesIO()
    picture = Image.fromarray(np.full((8, 8), 128 * 257, np.uint16)) if how == "PNG" else Image.new("L", (8, 8), 128)
    picture.convert(picture.mode if how == "PNG" else "RGB").save(data, how)
    file.picture(np.zeros((1, 1, 4), np.uint8))
    file.tree["images"] = [{"bufferView": file.view(data.getvalue())}]
    if how != "PNG":
        name = f"EXT_texture_{how.lower()}"
        file.tree["textures"] = [{"extensions": {name: {"source": 0}}}]
        file.tree["extensionsRequired"] = [name]
    np.testing.assert_allclose(look(load(file, tmp_path))[32, 32, :3].astype(int), [128] * 3, atol=1)


def test_textures_that_cannot_be_read_are_named_by_kind(tmp_path):
    file = quad()
    file.picture(np.zeros((1, 1, 4), np.uint8))
    file.tree["images"] = [{"bufferView": file.view(b"\xabKTX 20\xbb" + bytes(80))}]
    with pytest.raises(DataError, match="texture 0 is KTX2, which is not read; export it as PNG or JPEG"):
        load(file, tmp_path)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"mode": 1}, "points and lines of 'square' are left out, 1 of 2 pieces"),
        ({"targets": [{"COLOR_0": 0}]}, "its morph targets' COLOR_0 are not read"),
        ({"attributes": {"POSITION": 0}}, "has no TEXCOORD_0 for its texture"),
    ],
)
def test_what_is_left_out_is_named(tmp_path, capsys, change, words):
    file = quad()
    file.picture(np.zeros((1, 1, 4), np.uint8))
    pieces = file.tree["meshes"][0]["primitives"]
    pieces.append({**pieces[0], **change})
    load(file, tmp_path)
    assert words in capsys.readouterr().err


def test_a_skin_that_carries_nothing_is_named(tmp_path, capsys):
    file = arm()
    del file.tree["meshes"][0]["primitives"][0]["attributes"]["JOINTS_0"]
    load(file, tmp_path)
    assert "mesh of 'strip' has a skin but no JOINTS_0; it moves with its node" in capsys.readouterr().err


def test_what_two_of_the_file_say_of_one_thing_is_told(tmp_path, capsys):
    file = arm()
    file.tree["skins"][0]["joints"] = [1, 1]
    with pytest.raises(DataError, match="skin 0 lists a joint twice"):
        load(file, tmp_path)
    file = quad(1)
    file.animate(0, "translation", [0, 1], [[0, 0, 0], [0, 1, 0]])
    load(file, tmp_path)
    assert "translation of 'square': two channels move it" in capsys.readouterr().err


def test_a_child_that_its_scene_lists_too_is_drawn_once(tmp_path):
    file = quad(1)
    file.tree["nodes"].append({"children": [0]})
    file.tree["scenes"] = [{"nodes": [1, 0]}]
    assert len(load(file, tmp_path).triangles) == 2


# normals and keys


def test_normals_that_are_no_numbers_come_from_the_triangles(tmp_path, capsys):
    file = quad()
    attributes = file.tree["meshes"][0]["primitives"][0]["attributes"]
    tilted = np.array([[0.6, 0, 0.8]] * 4)
    tilted[1], tilted[2] = np.nan, np.inf
    attributes["NORMAL"] = file.add(tilted)
    found = load(file, tmp_path).normals[0]
    np.testing.assert_allclose(found, [[0.6, 0, 0.8], [0, 0, 1], [0, 0, 1], [0.6, 0, 0.8]], atol=1e-6)
    assert "2 normals NaN or infinite; computed from the triangles" in capsys.readouterr().err


def test_of_keys_at_one_time_the_last_counts(tmp_path):
    file = quad()
    del file.tree["animations"]
    file.animate(0, "translation", [0, 1, 1, 2], [[0, 0, 0], [2, 0, 0], [6, 0, 0], [8, 0, 0]])
    moved = load(file, tmp_path, frames=4).positions[:, 0, 0] + 1
    np.testing.assert_allclose(moved, [0, 1, 6, 7], atol=1e-6)
    for interpolation in ("LINEAR", "STEP"):
        curve = Curve(np.array([0.0, 1, 1]), np.array([[0.0], [1], [5]]), interpolation)
        assert curve.at(np.array([1.0, 2.0])).tolist() == [[5], [5]]
        assert Curve(np.zeros(3), np.array([[0.0], [1], [5]]), interpolation).at(np.zeros(1)).tolist() == [[5]]
    cubic = Curve(np.array([0.0, 1, 1]), np.array([[[0.0]] * 3, [[0], [1], [0]], [[0], [5], [0]]]), "CUBICSPLINE")
    assert cubic.at(np.array([0.5, 1.0])).tolist() == [[0.5], [5]]


# clips


def named(*names: str) -> GlbFile:
    file = quad(shift=1.0)
    clip = file.tree["animations"][0]
    file.tree["animations"] = [{**clip, "name": name} for name in names]
    return file


@pytest.mark.parametrize(
    ("node", "path", "values", "told"),
    [
        (1, "translation", [[0, 0, 0], [0, 0, 1]], True),  # an object of its own
        (1, "translation", [[0, 0, 0], [0, 0, 0]], False),  # a clip that keeps it where it is
        (0, "rotation", [[0, 0, 0, 1], [0, 1, 0, 0]], True),  # the same object, another property
        (0, "translation", [[0, 0, 0], [0, 0, 1]], False),  # another clip of the same object, as walk and run are
        (2, "translation", [[0, 0, 0], [0, 0, 1]], False),  # a camera
    ],
)
def test_objects_that_another_clip_moves_stand_still_and_are_told(tmp_path, capsys, node, path, values, told):
    file = quad(shift=1.0)
    file.tree["nodes"] += [{"name": "other", "mesh": 0, "translation": [3, 0, 0]}, {"name": "camera", "camera": 0}]
    file.tree["scenes"][0]["nodes"] = [0, 1, 2]
    sampler = {"input": file.add([0.0, 1.0]), "output": file.add(values)}
    channel = {"sampler": 0, "target": {"node": node, "path": path}}
    file.tree["animations"].append({"name": "Second", "channels": [channel], "samplers": [sampler]})
    path = file.write(tmp_path / "m.glb")
    for clip, other in ((None, "'Second'"), ("Second", "'Rig|Bend'")):
        load_animation(path, clip, 2)
        assert ("stands still in" in (said := capsys.readouterr().err)) == (told or (node != 0 and clip == "Second"))
        assert other in said or not told


def test_one_odd_clip_does_not_end_the_others(tmp_path, capsys):
    file = named("good", "empty", " ", "broken")
    clips = file.tree["animations"]
    clips[1] = {"name": "empty", "channels": [], "samplers": []}
    clips[3] = {**clips[3], "samplers": [{**clips[3]["samplers"][0], "input": file.add([0, np.nan])}]}
    path = file.write(tmp_path / "m.glb")
    assert list_clips(path) == [("good", 1.0), ("empty", None), ("clip 2", 1.0), ("broken", None)]
    assert [clip for clip, _ in clip_outputs(path, "v.h5")] == ["good", "clip 2"]
    told = capsys.readouterr().err
    assert "clip 'empty' moves nothing" in told and "clip 'broken', translation of 'square': NaN" in told
    clips[0] = clips[2] = clips[1]
    with pytest.raises(DataError, match=r"none of its clips \(4\) can be read"):
        clip_outputs(file.write(path), "v.h5")


def test_clips_of_one_file_name_get_a_file_each(tmp_path):
    path = named("Walk", "walk", "Walk_0").write(tmp_path / "m.glb")
    assert [file for _, file in clip_outputs(path, "v.h5")] == ["v_Walk_0_.h5", "v_walk_1.h5", "v_Walk_0.h5"]


def test_keys_joined_in_an_unknown_way_are_refused(tmp_path):
    file = quad(shift=1.0)
    file.tree["animations"][0]["samplers"][0]["interpolation"] = "BEZIER"
    with pytest.raises(DataError, match="joined by 'BEZIER'; expected LINEAR, STEP or CUBICSPLINE"):
        load(file, tmp_path)


@pytest.mark.parametrize(
    "wanted, name",
    [
        ("Walk", "Walk"),
        ("walk (2)", "Walk (2)"),
        ("1", "Rig|Run"),
        ("run", "Rig|Run"),
        ("rig|run", "Rig|Run"),
        ("2", "Walk (2)"),
        ("7", "7"),
        ("4", "clip 4"),
        ("clip 4", "clip 4"),
    ],
)
def test_clips_by_name_by_number_and_by_what_is_listed(tmp_path, wanted, name):
    path = named("Walk", "Rig|Run", "Walk", "7", "").write(tmp_path / "m.glb")
    assert [listed for listed, _ in list_clips(path)] == ["Walk", "Rig|Run", "Walk (2)", "7", "clip 4"]
    assert load_animation(path, wanted, 2).name == f"m {name}"
    with pytest.raises(UsageError, match=r"has Walk, Rig\|Run, .* or its number 0 .. 4"):
        load_animation(path, "9", 2)


@pytest.mark.parametrize("wanted", ["Layer0", "mixamo.com|layer0", "Armature|mixamo.com|Layer0"])
def test_any_end_of_a_clip_s_name_behind_a_bar_names_it(tmp_path, wanted):
    path = named("Armature|mixamo.com|Layer0", "Armature|Run", "NoLayer0").write(tmp_path / "m.glb")
    assert load_animation(path, wanted, 2).name == "m Armature|mixamo.com|Layer0"


def test_all_clips_at_once(tmp_path, dpc_here):
    path = named("Rig|Walk", "Rig|run/fast", "walk", "").write(tmp_path / "m.glb")
    options = ("--frames", 2, "--size", 16, "--tracks", 8, "--jobs", 1, "--azimuths", "60")
    done = dpc_here("prepare", "animation", path, "-o", tmp_path / "v.h5", *options, "--all-clips")
    assert done.returncode == 0, done.stderr
    assert sorted(file.name for file in tmp_path.glob("*.h5")) == [
        "v_Walk_0.h5",
        "v_clip_3.h5",
        "v_run_fast.h5",
        "v_walk_2.h5",
    ]
    for odd in (("-o", "-"), ("-o", tmp_path / "v.h5", "--clip", "walk")):
        assert dpc_here("prepare", "animation", path, *odd, "--all-clips").returncode == 2


def test_a_clip_s_name_moves_no_cursor(tmp_path):
    path = named("\x1b[31mred\u202e\nx", "größe").write(tmp_path / "m.glb")
    assert [name for name, _ in list_clips(path)] == ["\\x1b[31mred\\u202e\\nx", "größe"]


# names of files


def split(file: GlbFile, folder, name: str, uri: str):
    """Writes a .gltf whose buffer is the file ``name``, spelled ``uri`` in it."""
    data = bytes(file.data)
    if name:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    path = folder / "m.gltf"
    path.write_text(json.dumps({**file.tree, "buffers": [{"byteLength": len(data), "uri": uri}]}))
    return path


@pytest.mark.parametrize(
    "name, uri",
    [
        ("tex tures/fä #1%.bin", "tex tures\\fä #1%.bin"),
        ("a b.bin", "a%20b.bin"),
        ("a b.bin", " a b.bin\n"),
        ("a.bin", "./x/../a.bin"),
        ("a.bin", "a.bin?v=2#top"),
        ("a%20b.bin", "a%20b.bin"),
        ("sub/a.bin", "sub\\a.bin"),
    ],
)
def test_names_are_read_as_browsers_do(tmp_path, name, uri):
    assert load_animation(split(quad(), tmp_path, name, uri), None, 1).positions.shape == (1, 4, 3)


@pytest.mark.parametrize("uri", ["../s.bin", "{}", "file://{}", "..\\s.bin", "C:\\s.bin", "http://x/s.bin", "link.bin"])
def test_names_that_lead_outside_are_refused(tmp_path, uri):
    folder = tmp_path / "model"
    folder.mkdir()
    (tmp_path / "s.bin").write_bytes(bytes(quad().data))
    (folder / "link.bin").symlink_to(tmp_path / "s.bin")
    with pytest.raises(DataError, match="outside its folder"):
        load_animation(split(quad(), folder, "", uri.format(tmp_path / "s.bin")), None, 1)


@pytest.mark.parametrize(
    "kind, name", [("buffers", "a.bin"), ("images", "b.png"), ("images", "data:,x"), ("images", "../s")]
)
def test_other_files_beside_a_model_are_another_clip(tmp_path, kind, name):
    """So that a finished file is not taken for what a model with a new texture makes."""
    path = split(quad(), tmp_path, "a.bin", "a.bin")
    tree = json.loads(path.read_text())
    path.write_text(json.dumps({**tree, "images": [{"uri": name}]}))
    before = animation_config(path, None, 2, SMALL)
    with open(tmp_path / ("a.bin" if kind == "buffers" else "b.png"), "ab") as file:
        file.write(b"new")
    assert (animation_config(path, None, 2, SMALL) == before) == (name not in ("a.bin", "b.png"))
    if name == "a.bin":
        assert differences(before, animation_config(path, None, 2, SMALL)) == ["other files beside"]
    assert animation_config(quad().write(tmp_path / "m.glb"), None, 2, SMALL).keys() == before.keys() - {
        "files_beside_digest"
    }


@settings(max_examples=25, derandomize=True, deadline=None)
@given(
    st.sampled_from(["", "\n", "\r\n", " ", "\t"]),
    st.integers(1, 80),
    st.booleans(),
    st.booleans(),
    st.sampled_from(["data:application/octet-stream;base64,", "DATA:;base64,", "data:x;charset=y;BASE64,"]),
)
def test_embedded_bytes_in_every_spelling(tmp_path_factory, gap, width, padded, quoted, head):
    file = quad()
    text = base64.b64encode(bytes(file.data)).decode()
    text = text if padded else text.rstrip("=")
    text = gap.join(text[k : k + width] for k in range(0, len(text), width))
    uri = head + (quote(text) if quoted else text)
    read = read_gltf(split(file, tmp_path_factory.getbasetemp(), "", uri))
    assert read.accessor(0, "x").tolist() == [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]


def archive(*names: str) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as file:
        for name in names:
            file.writestr(zipfile.ZipInfo(name), b"x")  # of no date: the names of tests hold these bytes
    return data.getvalue()


@pytest.mark.parametrize(
    "name, data, words",
    [
        ("m.fbx", b"Kaydara FBX Binary  \0", "FBX; open it in Blender and use File > Export > glTF 2.0"),
        ("m.fbx", b"\n; FBX 7.3.0 project file", "FBX"),
        ("m.fbx", b"; made by hand\nFBXHeaderExtension:  {", "FBX"),
        ("m.usd", b"PXR-USDC\0", "USD; open it in Blender"),
        ("m.usd", b"#usda 1.0", "USD"),
        ("m.usdz", archive("m.usdc", "0/wood.png"), "USDZ; open it in Blender"),
        ("m.3mf", archive("[Content_Types].xml", "3D/3dmodel.model"), "3MF; it holds one shape"),
        ("m.zip", archive("scene.bin", "a/scene.gltf"), "a zip archive; unpack it, and name a/scene.gltf"),
        ("m.zip", archive("m.max"), "a zip archive without a glTF"),
        ("m.zip", archive("m.glb")[:40], "a damaged zip archive"),
        ("m.blend", b"BLENDER-v300", "Blender file; open it in Blender"),
        ("m.blend", b"\x28\xb5\x2f\xfd", "compressed Blender"),
        ("m.dae", b'<?xml version="1.0"?><COLLADA>', "COLLADA"),
        ("m.abc", b"Ogawa\xff", "Alembic; open it in Blender"),
        ("m.bvh", b"HIERARCHY\nROOT Hips", "BVH, motion without a surface"),
        ("m.obj", b"# made\nv 0 0 0\n", "OBJ; it holds one shape that stands still"),
        ("m.stl", b"solid x\n", "STL; it holds one shape"),
        ("m.stl", bytes(80) + b"\1\0\0\0" + bytes(50), "STL; it holds one shape"),
        ("m.mp4", b"\0\0\0\x18ftypmp42", "a video; use `dpc prepare video`"),
        ("m.glb", b"<!DOCTYPE HTML><html>", "a web page; download it again"),
        ("m.glb", b"version https://git-lfs.github.com/spec/v1", "Git LFS; `git lfs pull` brings the file itself"),
        ("m.gltf", "{}".encode("utf-16"), "UTF-16; save it as UTF-8"),
        ("m.glb", b"\0\0\0\x18ftypheic", "a HEIC picture; name a model"),
    ],
)
def test_files_of_other_formats_are_told_what_to_do(tmp_path, name, data, words):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(DataError, match="not a glTF file but .*" + re.escape(words)):
        read_gltf(tmp_path / name)


@pytest.mark.parametrize(
    "names, words",
    [
        (["b.glb", "a.vrm"], "name one of its 2 files, such as a.vrm"),
        (["f_1.obj", "f_2.obj", "f.mtl"], "a folder of 2 files such as f_1.obj, not a glTF file; it holds one shape"),
        (["walk.fbx"], "a folder of 1 file such as walk.fbx, not a glTF file; open it in Blender"),
        ([], "expected a .glb or .gltf file"),
    ],
)
def test_a_folder_names_what_is_in_it(tmp_path, names, words):
    for name in names:
        (tmp_path / name).touch()
    with pytest.raises(DataError, match=re.escape(words)):
        read_gltf(tmp_path)


def test_a_container_filled_up_with_zeros_and_an_empty_one(tmp_path):
    data = quad().bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    text = data[20 : 20 + size].rstrip() + bytes(4 + size - len(data[20 : 20 + size].rstrip()))
    longer = data[:8] + struct.pack("<II", len(data) + 4, len(text)) + data[16:20] + text + data[20 + size :]
    (tmp_path / "m.glb").write_bytes(longer)
    assert load_animation(tmp_path / "m.glb", None, 1).positions.shape == (1, 4, 3)
    (tmp_path / "m.glb").write_bytes(b"")
    with pytest.raises(DataError, match="the file is empty"):
        read_gltf(tmp_path / "m.glb")
