"""Mesh files as other programs write them: polygons of any outline, numbers that count back, bytes behind the end."""

from __future__ import annotations

import re
import struct

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.prepare.articulated.urdf import read_skeleton
from dpcli.prepare.meshes.mesh_files import load_mesh, triangles_of
from tests.support.gltf_files import GlbFile, quad

OUTLINE = np.array([(0, 0), (2, 0), (2, 2), (1, 0.25), (0, 2)])  # a square less a notch: 4 - 1.75
STAR = np.array([(r * np.cos(a), r * np.sin(a)) for r, a in zip([2, 1] * 6, np.arange(12) * np.pi / 6)])


def area(outline: np.ndarray) -> float:
    x, y = outline.T
    return abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def written(path, outline: np.ndarray):
    """Writes one polygon in a tilted plane."""
    tilted = outline @ np.array([[0.6, 0, 0.8], [0, 1, 0]]) + [3, -1, 5]
    rows, numbers = [" ".join(map(repr, point)) for point in tilted.tolist()], range(len(outline))
    if path.suffix == ".obj":
        text = [f"v {row}" for row in rows] + ["f " + " ".join(f"{k + 1}/1" for k in numbers)]
    elif path.suffix == ".off":
        text = ["OFF", f"{len(rows)} 1 0", *rows, " ".join(map(str, (len(rows), *numbers)))]
    else:
        head = [
            "ply",
            "format ascii 1.0",
            f"element vertex {len(rows)}",
            *(f"property double {axis}" for axis in "xyz"),
        ]
        head += ["element face 1", "property list uchar int vertex_index", "end_header"]
        text = [*head, *rows, " ".join(map(str, (len(rows), *numbers)))]
    path.write_text("\n".join(text) + "\n")
    if path.stem == "binary":
        from plyfile import PlyData

        held = PlyData.read(path)
        PlyData([held["vertex"], held["face"]], byte_order=">").write(path)
    return path


@pytest.mark.parametrize("name", ["m.obj", "m.off", "m.ply", "binary.ply"])
@pytest.mark.parametrize("outline", [OUTLINE, STAR, STAR[::2]])
def test_polygons_of_any_outline_are_covered_and_nothing_beside_them(name, outline, tmp_path):
    for turned in (outline, np.roll(outline, 2, axis=0), outline[::-1]):
        mesh = load_mesh(written(tmp_path / name, turned), None)
        assert mesh.area == pytest.approx(area(outline)) and len(mesh.faces) == len(outline) - 2


def test_numbers_in_an_obj_count_back_from_where_they_stand(tmp_path):
    rows = ["v 0 0 0", "v 1 0 0", "v 0 1 0", "f -3 -2 -1", "v 0 0 5", "v 2 0 5", "v 0 2 5", "f -3//1 -2//1 \\", "-1//1"]
    (tmp_path / "m.obj").write_text("\n".join(rows))
    corners = load_mesh(tmp_path / "m.obj", None).triangles
    np.testing.assert_array_equal(corners[:, :, 2], [[0, 0, 0], [5, 5, 5]])
    with pytest.raises(ValueError, match="a vertex that is not there"):
        triangles_of(np.zeros((3, 3)), [[0, 1, -1]])


def test_collada_is_refused_where_its_reader_would_reach_beyond_a_polygon(tmp_path):
    import trimesh

    path = tmp_path / "m.dae"
    trimesh.creation.box().export(path)
    points = " ".join(map(str, np.pad(STAR[:8], ((0, 0), (0, 1))).ravel()))
    text = re.sub(r'(id="verts-array-array">)[^<]*', rf"\g<1>{points}", path.read_text())
    begin, end = text.index("<triangles"), text.index("</triangles>") + len("</triangles>")
    source = '<input offset="0" semantic="VERTEX" source="#verts-array-vertices"/>'
    for corners, refused in (([0, 2, 4, 6], False), ([0, 2, 3, 4], True)):
        row = f"<vcount>4</vcount><p>{' '.join(map(str, corners))}</p>"
        path.write_text(f'{text[:begin]}<polylist count="1" material="material0">{source}{row}</polylist>{text[end:]}')
        if refused:
            with pytest.raises(DataError, match="m.dae: some of its polygons aren't convex"):
                load_mesh(path, None)
        else:
            assert load_mesh(path, None).area == pytest.approx(area(STAR[corners]))


@pytest.mark.parametrize("old", ["v 1 0 0", "f 1 2 3", "f 2 4 3", "v 0 0 0"])
@pytest.mark.parametrize("style", ["  {}", "\t{}", "{} # a comment", "{}\t"])
def test_lines_of_an_obj_may_be_indented_commented_and_hold_tabs(tmp_path, old, style):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 2\nf 1 2 3\nf 2 4 3\n"
    (tmp_path / "m.obj").write_text(text)
    expected = load_mesh(tmp_path / "m.obj", None).triangles
    for line in (style.format(old), style.format(old).replace(" ", "\t", 1)):
        (tmp_path / "m.obj").write_text(text.replace(old, line))
        np.testing.assert_array_equal(load_mesh(tmp_path / "m.obj", None).triangles, expected)


LAMP = '<node id="lamp"><instance_light url="#gone"/></node>'


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("</visual_scene>", f"{LAMP}</visual_scene>", ""),
        ("</visual_scene>", '<node id="n"><instance_geometry url="#gone"/></node></visual_scene>', "Geometry #gone"),
        ('target="#', 'target="#gone', ""),  # a color
        ("<triangles", "<linestrips/><triangles", "Geometry #"),
        ("<triangles", "<polygons><ph/></polygons><triangles", "polygons with holes"),
        (
            'count="8" source="#verts-array-array" stride="3"',
            'count="6" source="#verts-array-array" stride="4"',
            "positions of",
        ),
        ('count="8" source="#verts', 'count="7" offset="3" source="#verts', "positions of 'verts-array' lie between"),
        ("<instance_geometry", "<skew>45 0 1 0 1 0 0</skew><instance_geometry", "skew"),
        ("<instance_geometry", "<translate>1 two 3</translate><instance_geometry", "translate"),
        ("<instance_geometry", "<lookat>1 2 3 0 0 0 0 0 1</lookat><instance_geometry", "placed by <lookat>"),
        ("</visual_scene>", '<node id="n"><lookat>1 2 3 0 0 0 0 0 1</lookat></node></visual_scene>', ""),  # a camera's
        ("</asset>", '<unit name="millimeter" meter="0,001"/></asset>', "its unit is '0,001' meters"),
    ],
)
def test_a_part_that_a_reader_of_collada_leaves_out_is_named(tmp_path, old, new, said):
    from trimesh.creation import box, icosphere
    from trimesh.exchange.dae import export_collada

    path, text = tmp_path / "m.dae", export_collada([box(), icosphere(subdivisions=0)]).decode()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    if said:
        with pytest.raises(DataError, match=f"m.dae: .*{said}.*export it"):
            load_mesh(path, None)
    else:
        assert len(load_mesh(path, None).faces) == 32


def test_triangles_and_squares_together_in_a_binary_ply(tmp_path):
    """As Blender and MeshLab write them, with coordinates of textures beside the corners."""
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 4\n" + "".join(f"property float {k}\n" for k in "xyz")
    head += "element face 2\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\nend_header\n"
    rows = struct.pack("<B3iB2f", 3, 0, 1, 2, 2, 0, 1) + struct.pack("<B4iB1f", 4, 0, 1, 2, 3, 1, 0)
    corners = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    (tmp_path / "m.ply").write_bytes(head.encode() + corners.tobytes() + rows)
    assert load_mesh(tmp_path / "m.ply", None).area == pytest.approx(1.5)
    damaged = head.replace("face 2", "face 2000000000").encode() + corners.tobytes() + rows
    (tmp_path / "m.ply").write_bytes(damaged)
    with pytest.raises(DataError, match="counts 2000000000 faces, [0-9]+ bytes can't hold them"):
        load_mesh(tmp_path / "m.ply", None)


@pytest.mark.parametrize("number", [-1, 3])
@pytest.mark.parametrize("name", ["m.ply", "m.off", "m.obj"])
def test_numbers_of_no_vertex_are_refused(name, number, tmp_path):
    """trimesh counts negative ones from the end, and 0 in an OBJ, too."""
    path = written(tmp_path / name, OUTLINE[:3])
    old, new = ("3/1", f"{number + 1}/1") if name == "m.obj" else ("3 0 1 2", f"3 0 1 {number}")
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises((ValueError, IndexError), match="a vertex that is not there|outside the range|out of bounds"):
        load_mesh(path, None)


@pytest.mark.parametrize("corners", [3, 4])
@pytest.mark.parametrize("name", ["m.ply", "m.off", "m.obj"])
def test_faces_with_corners_at_nan_are_refused(name, corners, tmp_path):
    """Such triangles have no area, so that sampling passed over them untold."""
    path = written(tmp_path / name, np.vstack([OUTLINE[: corners - 1], np.full(2, np.nan)]))
    with pytest.raises(ValueError, match="corners of its faces lie at NaN or infinity"):
        load_mesh(path, None)


def quantized(file: GlbFile) -> None:
    corners = np.zeros((4, 4), np.int16)
    corners[:, :2] = [[-32767, -32767], [32767, -32767], [32767, 32767], [-32767, 32767]]
    view = {"bufferView": file.view(corners.tobytes(), byteStride=8), "componentType": 5122, "normalized": True}
    file.tree["accessors"][0] |= view
    file.tree["extensionsRequired"] = ["KHR_mesh_quantization"]


def sparse(file: GlbFile) -> None:
    where, what = file.view(np.uint16([1, 2]).tobytes()), file.view(np.float32([[3, -1, 0], [3, 1, 0]]).tobytes())
    indices = {"bufferView": where, "componentType": 5123}
    file.tree["accessors"][0]["sparse"] = {"count": 2, "indices": indices, "values": {"bufferView": what}}


def fan(file: GlbFile) -> None:
    file.tree["meshes"][0]["primitives"][0] |= {"mode": 6, "indices": file.add([0, 1, 2, 3], "u1")}


def instances(file: GlbFile) -> None:
    places = {"TRANSLATION": file.add([[0, 0, 0], [5, 0, 0], [9.0, 0, 0]])}
    file.tree["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": places}}


def hidden(file: GlbFile) -> None:
    file.tree["nodes"].append({"mesh": 0, "extensions": {"KHR_node_visibility": {"visible": False}}})
    file.tree["scenes"][0]["nodes"].append(1)


def lost_picture(file: GlbFile) -> None:
    file.tree |= {"images": [{"uri": "gone.png"}], "textures": [{"source": 0}]}
    file.tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (quantized, 4),
        (sparse, 8),
        (fan, 4),
        (instances, 12),
        (hidden, 4),
        (lost_picture, 4),
        (lambda file: file.tree.pop("scenes"), 4),
        (lambda file: file.tree["nodes"][0].update(translation=[4.5e6, 1.2e6, 3e6], scale=[0.3, 0.3, 0.3]), 0.36),
        (lambda file: file.tree["meshes"][0]["primitives"][0].update(mode=1), 0),
    ],
)
def test_gltf_is_read_as_of_a_model(change, expected, tmp_path):
    change(file := quad())
    assert load_mesh(file.write(tmp_path / "m.glb"), tmp_path).area == pytest.approx(expected)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("m.obj", "v 0,5 1,0 0,0\nv 1,5 0,0 0,0\nv 0,0 1,0 0,0\nf 1 2 3\n", "decimal commas"),
        (
            "m.stl",
            "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 1 1 0\nvertex 0 1 0\nendloop\n"
            "endfacet\nendsolid a\n",
            "no triangles",
        ),
        ("m.dae", "<COLLADA><scene/><instance_controller/></COLLADA>", "controllers"),
        ("m.dae", "<COLLADA><library_visual_scenes><visual_scene/></library_visual_scenes></COLLADA>", "no scene"),
        (
            "m.ply",
            "ply\nformat ascii 1.0\nelement tristrips 1\nproperty list int int vertex_indices\nend_header\n0\n",
            "strips",
        ),
        (
            "m.ply",
            "ply\nformat ascii 1.0\nelement vertex 3\nproperty int x\nproperty int y\nproperty int z\nelement face 1\n"
            "property list int int corners\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
            "faces have corners; expected vertex_indices: ",
        ),
    ],
)
def test_what_is_not_read_of_a_mesh_is_named(name, text, said, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(DataError, match=f"{name}: .*{said}.*export it"):
        load_mesh(tmp_path / name, None)


@pytest.mark.parametrize("name", ["m.obj", "m.stl", "m.dae", "m.ply", "m.glb", "r.urdf"])
def test_a_pointer_in_the_place_of_a_file_is_named(name, tmp_path):
    """As a repository is cloned without Git LFS; an OBJ would be a mesh without faces."""
    (tmp_path / name).write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 132\n")
    with pytest.raises(DataError, match=f"{name}: a pointer of Git LFS; `git lfs pull` brings the file itself"):
        read_skeleton(tmp_path / name) if name == "r.urdf" else load_mesh(tmp_path / name, None)
