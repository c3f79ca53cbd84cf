"""Buffer views compressed by meshopt, packed with its own encoder: read as what went in; damaged ones are refused by name."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.prepare.meshes.animation import load_animation
from dpcli.prepare.meshes.gltf import COMPONENTS, MESHOPT, WIDTHS
from tests.support.gltf_files import GlbFile, arm

meshopt = pytest.importorskip("meshopt")


def compressed(file: GlbFile, name: str = MESHOPT[0]) -> GlbFile:
    """The file with every buffer view packed; what it was before lies in a buffer that isn't there, as in gltfpack's files."""
    tree, indices = file.tree, {p["indices"] for mesh in file.tree["meshes"] for p in mesh["primitives"]}
    for number, accessor in enumerate(list(tree["accessors"])):
        view = tree["bufferViews"][accessor["bufferView"]]
        kind, start = np.dtype(COMPONENTS[accessor["componentType"]]), view["byteOffset"]
        rows = np.frombuffer(bytes(file.data), kind, accessor["count"] * WIDTHS[accessor["type"]], start)
        rows = rows.reshape(accessor["count"], -1)
        mode = "TRIANGLES" if number in indices and len(rows) % 3 == 0 else "ATTRIBUTES"
        packed = tree["bufferViews"][file.view(meshopt.encode_gltf_buffer(np.ascontiguousarray(rows), mode))]
        extension = {
            "buffer": packed["buffer"],
            "byteOffset": packed["byteOffset"],
            "byteLength": packed["byteLength"],
            "byteStride": rows.itemsize * rows.shape[1],
            "count": len(rows),
            "mode": mode,
        }
        view.update(buffer=1, byteOffset=0, extensions={name: extension})
    tree["extensionsUsed"] = tree["extensionsRequired"] = [name]
    return file


def loaded(file: GlbFile, folder):
    path = file.write(folder / "a.glb")
    return load_animation(path, None, 3)


@pytest.mark.parametrize("name", MESHOPT)
def test_packed_views_hold_what_went_in(tmp_path, name):
    plain, packed = loaded(arm(), tmp_path), loaded(compressed(arm(), name), tmp_path)
    assert plain.positions.shape == packed.positions.shape
    one, two = (
        np.sort(mesh.positions[:, mesh.triangles].reshape(3, len(mesh.triangles), 9).sum(-1), 1)
        for mesh in (plain, packed)
    )
    np.testing.assert_allclose(one, two, atol=1e-6)  # the coder may turn triangles and change their order
    np.testing.assert_array_equal(plain.positions, packed.positions)


def test_a_view_that_accessors_share_is_unpacked_once(tmp_path, monkeypatch):
    calls, decode = [], meshopt.decode_gltf_buffer
    monkeypatch.setattr(meshopt, "decode_gltf_buffer", lambda *args: calls.append(1) or decode(*args))
    file = compressed(arm())
    primitives = file.tree["meshes"][0]["primitives"]
    primitives.append(primitives[0])
    loaded(file, tmp_path)
    assert len(calls) == sum("extensions" in view for view in file.tree["bufferViews"])


@pytest.mark.parametrize(
    "change, told",
    [
        ({"count": 10**9}, "claims 1000000000 rows"),
        ({"count": -1}, "claims -1 rows"),
        ({"byteStride": 0}, "rows of 0 bytes"),
        ({"mode": "MAGIC"}, "meshopt cannot decode it"),
        ({"byteLength": 3}, "meshopt cannot decode it"),
        ({"byteOffset": 10**7}, "truncated or damaged"),
    ],
)
def test_what_is_damaged_is_refused_by_name(tmp_path, change, told):
    file = compressed(arm())
    file.tree["bufferViews"][0]["extensions"][MESHOPT[0]].update(change)
    with pytest.raises(DataError, match=rf"a.glb: .*{told}"):
        loaded(file, tmp_path)


def test_without_the_package_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "meshopt", None)
    with pytest.raises(DataError, match="pip install 'dpc-toolkit\\[meshopt\\]'"):
        loaded(compressed(arm()), tmp_path)
