"""Draco blocks in glTF files, written with DracoPy: read as what went in, whatever its types and order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError
from dpcli.prepare.meshes.animation import load_animation
from tests.support.gltf_files import GlbFile, arm

DracoPy = pytest.importorskip("DracoPy")


def compressed(file: GlbFile, **encoding) -> GlbFile:
    """The file with each primitive as a Draco block; its accessors keep their types and lose their bytes."""
    primitives, accessors = [mesh["primitives"][0] for mesh in file.tree["meshes"]], file.tree["accessors"]

    def array(index: int) -> np.ndarray:
        entry = accessors[index]
        start = file.tree["bufferViews"][entry["bufferView"]]["byteOffset"]
        dtype, columns = (
            {5126: "f4", 5121: "u1", 5123: "u2"}[entry["componentType"]],
            int(entry["type"].lstrip("SCALRVE") or 1),
        )
        count = entry["count"] * columns
        return np.frombuffer(bytes(file.data), dtype, count, start).reshape(entry["count"], columns).copy()

    for primitive in primitives:
        attributes = primitive["attributes"]
        ids = {"JOINTS_0": 5, "WEIGHTS_0": 9}
        block = DracoPy.encode(
            array(attributes["POSITION"]),
            array(primitive["indices"]).reshape(-1, 3).astype("u4"),
            normals=array(attributes["NORMAL"]).astype(float),
            generic_attributes={ids[key]: array(attributes[key]) for key in ids},
            quantization_bits=20,
            **encoding,
        )
        kinds = {entry["attribute_type"]: entry["unique_id"] for entry in DracoPy.decode(block).attributes}
        ids |= {"POSITION": kinds[0], "NORMAL": kinds[1]}
        extension = {"bufferView": file.view(block), "attributes": ids}
        primitive["extensions"] = {"KHR_draco_mesh_compression": extension}
    for index in {index for one in primitives for index in [*one["attributes"].values(), one["indices"]]}:
        del accessors[index]["bufferView"]
    file.tree["extensionsUsed"] = file.tree["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    return file


def corners(mesh) -> np.ndarray:
    """Corners of all triangles at all frames, in an order that does not depend on the file's."""
    found = mesh.positions[:, mesh.triangles].transpose(1, 0, 2, 3).reshape(len(mesh.triangles), -1)
    rounded = np.round(found, 3)
    first = [min(range(3), key=lambda k: tuple(np.roll(row.reshape(-1, 3, 3), -k, 1).ravel())) for row in rounded]
    turned = [np.roll(row.reshape(-1, 3, 3), -k, 1).ravel() for row, k in zip(rounded, first)]
    return np.array(sorted(map(tuple, turned))) + 0.0


@settings(max_examples=12, derandomize=True, deadline=None)
@given(st.booleans(), st.integers(0, 10), st.booleans())
def test_a_compressed_skin_bends_as_the_plain_one(tmp_path_factory, preserve_order, level, smooth):
    folder = tmp_path_factory.getbasetemp()
    plain = load_animation(arm(smooth=smooth).write(folder / "plain.glb"), None, 3)
    file = compressed(arm(smooth=smooth), preserve_order=preserve_order, compression_level=level)
    found = load_animation(file.write(folder / "draco.glb"), None, 3)
    np.testing.assert_allclose(corners(found), corners(plain), atol=2e-3)


@settings(max_examples=8, derandomize=True, deadline=None)
@given(st.booleans(), st.integers(0, 10), st.lists(st.integers(0, 1), min_size=2, max_size=4))
def test_blocks_that_share_their_indices_keep_their_own_vertices(tmp_path_factory, preserve_order, level, meshes):
    folder, files = tmp_path_factory.getbasetemp(), (arm(), arm())
    for file in files:  # Blender writes equal triangles of several meshes once
        first = file.tree["meshes"][0]["primitives"][0]
        x, y = np.repeat([0.0, 0.5, 1.0, 1.5, 2.0], 2), np.tile([1.0, 2.0], 5)
        own = {"POSITION": file.add(np.stack([2 - x, y, 0 * x], axis=1))}
        file.tree["meshes"].append({"primitives": [first | {"attributes": first["attributes"] | own}]})
        file.tree["nodes"] += [{"mesh": mesh, "skin": 0} for mesh in meshes]
        file.tree["nodes"][0]["children"] += range(4, 4 + len(meshes))
    compressed(files[1], preserve_order=preserve_order, compression_level=level)
    plain, found = (load_animation(file.write(folder / "m.glb"), None, 3) for file in files)
    np.testing.assert_allclose(corners(found), corners(plain), atol=2e-3)


@pytest.mark.parametrize("preserve_order", [True, False])
def test_morph_targets_of_another_order_of_vertices_are_told(tmp_path, capsys, preserve_order):
    file = arm()
    primitive = file.tree["meshes"][0]["primitives"][0]
    primitive["targets"] = [{"POSITION": file.add(np.zeros((10, 3)))}]
    compressed(file, preserve_order=preserve_order, compression_level=7)
    load_animation(file.write(tmp_path / "m.glb"), None, 2)
    assert ("changed the order of its vertices" in capsys.readouterr().err) != preserve_order


def test_damaged_blocks_get_a_sentence(tmp_path):
    file = compressed(arm())
    block = file.tree["meshes"][0]["primitives"][0]["extensions"]["KHR_draco_mesh_compression"]
    view = file.tree["bufferViews"][block["bufferView"]]
    whole = dict(view)
    view["byteLength"] = 60
    with pytest.raises(DataError, match="'strip': its Draco block cannot be decoded"):
        load_animation(file.write(tmp_path / "m.glb"), None, 2)
    view |= whole
    block["attributes"]["POSITION"] = 77
    with pytest.raises(DataError, match="its Draco block cannot be decoded .KeyError: 77"):
        load_animation(file.write(tmp_path / "m.glb"), None, 2)
    block["attributes"]["POSITION"] = 5
    with pytest.raises(DataError, match="its Draco block has 4 components, expected 3"):
        load_animation(file.write(tmp_path / "m.glb"), None, 2)
