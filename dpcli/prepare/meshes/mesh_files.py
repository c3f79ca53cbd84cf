"""Mesh files, by trimesh but for what it leaves out or gets wrong: counts in headers, polygons that aren't convex, numbers
of vertices that count from the end, most of glTF.

trimesh takes what is there, and nothing at all of a cut STL. It cuts polygons into fans, which reach beyond the outline
where it turns inwards, and counts negative numbers in an OBJ from the end of the file, not from where they stand. Of glTF
it passes over normalized and sparse numbers, fans, instances, hidden nodes, and scenes that are not there.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from dpcli.errors import DataError
from dpcli.path_names import path_inside
from dpcli.prepare.cloud_formats.ply import Element, read_header
from dpcli.prepare.meshes.gltf import read_gltf, well_formed
from dpcli.prepare.meshes.gltf_extensions import refuse_required
from dpcli.prepare.meshes.gltf_mesh import shape_at_rest
from dpcli.runtime.clips.other_files import refuse_wrapped
from dpcli.runtime.progress import log

_STL_HEAD, _STL_FACE = 84, 50  # bytes
_WORD = rb"(?!0)[^\s\\-]+[ \t]*"
# a face of anything but three corners by numbers from 1, or one that goes on in the next line
_ODD_FACE = re.compile(rb"\n[ \t]*f[ \t]+(?!%b(?<=[ \t])%b(?<=[ \t])%b(?:[\r\n#]|\Z))[^\r\n]" % (_WORD, _WORD, _WORD))
# a line that trimesh passes over, or ends at: with blanks before it, a tab, or a comment behind
_ODD_LINE = re.compile(rb"(?:\n|\A)(?:[ \t]+[vf][ \t]|[vf]\t|[vf] [^\n#]*#)")
_COMMA = re.compile(rb"\nv[ \t]+-?\d+,\d")
_NO_VERTEX = "a face names a vertex that is not there"
_NOWHERE = (
    "corners of its faces lie at NaN or infinity, where nothing can be sampled; remove these faces and export it again"
)
_BEGINNING = 4096  # bytes of a file that show how it writes numbers
_STRAIGHT = -1e-6  # of a polygon: a corner that turns inwards by less is what rounding does to a straight edge
Polygons = tuple[np.ndarray, list[Sequence[int]]]  # points f64 (V,3), and the numbers of each polygon's corners
_LOST = re.compile(  # what pycollada says where a mesh, or how it is turned, is missing, not a lamp or a picture
    r"(Geometry|Node) \S+ not found|skew|transform|node requires|(geometry|node) instance"
)
_COLORED = re.compile(rb"<((?:\w+:)?bind_material)\b[^>]*?(?:/>|>.*?</\1>)", re.DOTALL)  # no shape depends on it
_SOLID = rb"(?i)\s*solid"
_CORNER, _LOOP = (re.compile(rb"(?im)^\s*%b\s" % word) for word in (b"vertex", b"outer\\s+loop"))  # of an STL
_SAID: set[str] = set()
_MARK = b"\xef\xbb\xbf"  # of UTF-8, before the first line


def load_mesh(path: Path, root: Path | None) -> Any:
    """Returns the trimesh.Trimesh of a file, as it stands in it; root: the folder that files which it names must lie in, None
    for any.

    Raises DataError where it is an archive or the like, where an OFF, STL or PLY holds fewer or more rows than its header counts
    or lacks its end mark, or it has polygons that can't be read, and whatever trimesh does on a damaged one.
    """
    refuse_wrapped(path)
    mesh = _READERS.get(path.suffix.lower(), _by_trimesh)(path, root)
    if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
        raise ValueError(_NO_VERTEX)
    if not np.isfinite(np.asarray(mesh.vertices)[mesh.faces]).all():
        raise ValueError(_NOWHERE)
    return mesh


def _by_trimesh(path: Path, root: Path | None, **source: Any) -> Any:
    """Returns what trimesh makes of a file; source: of what else than its path."""
    import trimesh

    source = {"file_obj": path} | source
    try:
        return trimesh.load(**source, force="mesh", process=False, resolver=_files_inside(path, root))
    except DataError as error:  # of the resolver, which doesn't know who asks
        raise DataError(f"{path} cannot be read ({error})") from None


def _read_obj(path: Path, root: Path | None) -> Any:
    data = path.read_bytes().removeprefix(_MARK)
    if _COMMA.search(b"\n" + data[:_BEGINNING]):
        raise DataError(f"{path}: numbers with decimal commas; export it with points")
    if _ODD_FACE.search(data) or _ODD_LINE.search(data):
        return _mesh_of(_of_obj(data))
    return _by_trimesh(path, root, file_obj=BytesIO(data), file_type="obj", skip_materials=True)


def _read_stl(path: Path, root: Path | None) -> Any:
    data = path.read_bytes()
    _check_stl(path, data)
    return _by_trimesh(path, root, file_obj=BytesIO(data[: _end_of_stl(data) or None]), file_type="stl")


def _read_ply(path: Path, root: Path | None) -> Any:
    with path.open("rb") as file:
        order, elements = read_header(path, file)
        _check_ply(path, elements, None if order else file)
    faces = sum(element.count for element in elements if element.name == "face")
    if faces > (size := path.stat().st_size):
        raise DataError(
            f"{path}: truncated: its header counts {faces} faces, {size} bytes can't hold them; copy it again"
        )
    try:
        mesh = _by_trimesh(path, root)
    except Exception:  # such as of triangles and squares together
        return _mesh_of(_of_ply(path))
    return mesh if len(mesh.faces) == faces else _mesh_of(_of_ply(path))


def _read_off(path: Path, root: Path | None) -> Any:
    counts, rows = _off_rows(path)
    if counts:
        _compare(path, "vertices and faces", sum(counts), len(rows))
        if counts[1]:
            _require_corners(path, rows[-1])
    mesh = _by_trimesh(path, root)
    return mesh if not rows or len(mesh.faces) == counts[1] else _mesh_of(_of_off(counts[0], rows))


def _read_dae(path: Path, root: Path | None) -> Any:
    from collada import Collada
    from collada.common import DaeError

    _check_collada(path)
    data = _COLORED.sub(b"", path.read_bytes())
    try:
        return _by_trimesh(path, root, file_obj=BytesIO(data), file_type="dae", ignore_broken=False)
    except (DaeError, RuntimeError):  # perhaps of a lamp or a picture alone; the second where it raises nothing again
        lost = [one.msg for one in Collada(BytesIO(data), ignore=[DaeError]).errors if _LOST.search(one.msg)]
    if lost:
        raise DataError(f"{path}: a part of it would be left out ({lost[0]:.100}); repair it, or export it again")
    return _by_trimesh(path, root, file_obj=BytesIO(data), file_type="dae")


def _files_inside(path: Path, root: Path | None) -> Any:
    """Returns what trimesh asks for the files that a mesh names: those inside ``root`` alone."""
    from trimesh.resolvers import FilePathResolver

    class _Inside(FilePathResolver):
        def get(self, name: str) -> bytes:
            return path_inside(root, path.parent, name.strip()).read_bytes()

    return _Inside(str(path))


def _read_gltf(path: Path, root: Path | None) -> Any:
    from trimesh import Trimesh

    with well_formed(path):
        file = replace(read_gltf(path), root=root)
        refuse_required(file)
        return Trimesh(*shape_at_rest(file), process=False)


def _is_binary(data: bytes) -> bool:
    return len(data) >= _STL_HEAD and (not re.match(_SOLID, data) or b"\0" in data)


def _end_of_stl(data: bytes) -> int:
    """Returns where the triangles of a binary STL end, if something lies behind that is no triangle: zeros, or bytes that
    make no whole number of them; else 0. Whole triangles behind are a count that is wrong.
    """
    end = _STL_HEAD + int.from_bytes(data[_STL_HEAD - 4 : _STL_HEAD], "little") * _STL_FACE
    behind = data[end:] if _is_binary(data) else b""
    return end if _STL_HEAD < end and behind and (len(behind) % _STL_FACE or not any(behind)) else 0


def _of_obj(data: bytes) -> Polygons:
    points, polygons = [], []
    for line in re.sub(rb"\\\r?\n", b" ", data).splitlines():
        words = line.partition(b"#")[0].split()
        if words[:1] == [b"v"]:
            points.append([float(word) for word in words[1:4]])
        elif words[:1] == [b"f"]:
            numbers = [int(word.partition(b"/")[0]) for word in words[1:]]
            polygons.append([number - 1 if number > 0 else len(points) + number for number in numbers])
    return np.array(points).reshape(len(points), -1), polygons


def _of_ply(path: Path) -> Polygons:
    from plyfile import PlyData

    held = PlyData.read(path)
    names = [one.name for one in held["face"].properties]
    corners = next((name for name in ("vertex_indices", "vertex_index") if name in names), None)
    if corners is None:
        raise DataError(f"{path}: its faces have {', '.join(names)}; expected vertex_indices: export it again")
    points = np.stack([held["vertex"][axis] for axis in "xyz"], axis=1).astype(np.float64)
    return points, list(held["face"][corners])


def _of_off(vertices: int, rows: list[bytes]) -> Polygons:
    points = np.array([row.split()[:3] for row in rows[:vertices]], np.float64)
    words = [row.split() for row in rows[vertices:]]
    return points, [[int(word) for word in own[1 : 1 + int(own[0])]] for own in words]


def _check_collada(path: Path) -> None:
    """Raises DataError for a COLLADA file of which its reader would leave something out, or cut polygons that aren't convex."""
    data = path.read_bytes()
    if not re.search(rb"<(\w+:)?scene\b", data):
        raise DataError(f"{path}: it has no scene, so nothing in it is placed; export it again")
    if b"instance_controller" in data:
        raise DataError(f"{path}: it has parts with bones (controllers), which are not read; export it as plain meshes")
    if re.search(rb"<(\w+:)?ph\b", data):
        raise DataError(f"{path}: it has polygons with holes, which are not read; export it as triangles")
    if what := _misread(data):
        raise DataError(f"{path}: {what}, which is not read; export it again")
    sizes = {size for row in re.findall(rb"vcount>([^<]*)", data) for size in row.split()}
    if sizes <= {b"3"} and not re.search(rb"<(\w+:)?polygons\b", data):
        return
    from collada import Collada
    from collada.common import DaeError
    from collada.polylist import Polylist

    lists = (
        one
        for geometry in Collada(str(path), ignore=[DaeError]).geometries
        for one in geometry.primitives
        if isinstance(one, Polylist) and one.vertex is not None
    )
    for one in lists:
        corners = np.split(np.asarray(one.vertex_index), np.cumsum(one.vcounts)[:-1])
        if not all(_are_convex(one.vertex[group]).all() for group in _by_size(corners).values()):
            raise DataError(f"{path}: some of its polygons aren't convex; export it again as triangles")


def _misread(data: bytes) -> str:
    """Returns what in a COLLADA file its reader would take for something else, else nothing: sources of positions that are not
    every three numbers of their array in turn, shapes placed by ``lookat``, and a unit that isn't a number.
    """
    from lxml import etree

    root = etree.fromstring(data, etree.XMLParser(resolve_entities=False, no_network=True, huge_tree=True))
    for unit in root.iterfind("{*}asset/{*}unit[@meter]"):
        if not re.fullmatch(r"\s*[\d.]+(e[-+]?\d+)?\s*", unit.get("meter"), re.IGNORECASE):
            return f"its unit is {unit.get('meter')!r} meters"
    for node in root.iterfind(".//{*}node[{*}lookat]"):
        if next(node.iter("{*}instance_geometry", "{*}instance_node"), None) is not None:
            return f"the shapes of the node {node.get('id')!r} are placed by <lookat>"
    for mesh in root.iterfind(".//{*}mesh"):  # exporters give one id to sources of several
        named = {one.get("source") for one in mesh.iterfind("{*}vertices/{*}input[@semantic='POSITION']")}
        for source in mesh.iterfind("{*}source"):
            accessor = source.find("{*}technique_common/{*}accessor")
            given = ("0", "3") if accessor is None else (accessor.get("offset", "0"), accessor.get("stride", "3"))
            if f"#{source.get('id')}" in named and tuple(map(str.strip, given)) != ("0", "3"):
                return f"the positions of {source.get('id')!r} lie between other numbers"
    return ""


def _mesh_of(polygons: Polygons) -> Any:
    from trimesh import Trimesh

    return Trimesh(polygons[0], triangles_of(*polygons), process=False)


def triangles_of(points: np.ndarray, polygons: Iterable[Sequence[int]]) -> np.ndarray:
    """Returns triangles i64 (T,3) that cover polygons of any outline; points (V,3). Those with two corners cover nothing.

    Raises ValueError where a polygon has a corner that isn't there, or that lies nowhere.
    """
    from mapbox_earcut import triangulate_float64

    found = [np.zeros((0, 3), np.int64)]
    for size, corners in _by_size(polygons).items():
        if corners.min() < 0 or corners.max() >= len(points):
            raise ValueError(_NO_VERTEX)
        if not np.isfinite(points[corners]).all():
            raise ValueError(_NOWHERE)
        convex = _are_convex(points[corners])
        found += [corners[convex][:, [0, k, k + 1]] for k in range(1, size - 1)]
        for own in corners[~convex]:
            flat = points[own] @ _plane(points[own])
            cut = triangulate_float64(np.ascontiguousarray(flat), np.array([size], np.uint32))
            found.append(own[np.asarray(cut, np.int64)].reshape(-1, 3))
    return np.concatenate(found)


def _by_size(polygons: Iterable[Sequence[int]]) -> dict[int, np.ndarray]:
    """Returns the corners i64 (N,size) of polygons by how many they have, three or more."""
    groups: dict[int, list[Sequence[int]]] = defaultdict(list)
    for corners in polygons:
        groups[len(corners)].append(corners)
    return {size: np.array(group, np.int64) for size, group in groups.items() if size > 2}


def _across(corners: np.ndarray) -> np.ndarray:
    """Returns the normals (N,3) of polygons (N,K,3), as long as twice their areas."""
    from_first = corners - corners[:, :1]
    return np.cross(from_first, np.roll(from_first, -1, axis=1)).sum(1)


def _are_convex(corners: np.ndarray) -> np.ndarray:
    """Returns bool (N): which polygons (N,K,3) turn one way at all their corners, so that fans cover them."""
    edges = np.roll(corners, -1, axis=1) - corners
    turns = np.einsum("nka,na->nk", np.cross(edges, np.roll(edges, -1, axis=1)), normals := _across(corners))
    return (turns >= _STRAIGHT * (normals**2).sum(1, keepdims=True)).all(1)


def _plane(corners: np.ndarray) -> np.ndarray:
    """Returns two axes (3,2) of the plane that a polygon (K,3) lies in, nearly, from whose front it runs counterclockwise."""
    normal = _across(corners[None])[0]
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    second = np.cross(normal, first)
    return np.stack([one / max(np.linalg.norm(one), 1e-300) for one in (first, second)], axis=1)


def _compare(path: Path, what: str, declared: int, found: int) -> None:
    if found != declared:
        how = "truncated" if found < declared else "damaged"
        raise DataError(f"{path}: {how}: its header counts {declared} {what}, it holds {found}; copy it again")


def _require_corners(path: Path, row: bytes) -> None:
    """Raises DataError where the last row, which begins with its number of corners, is cut."""
    words = row.split()
    if words and words[0].isdigit() and len(words) <= int(words[0]):
        raise DataError(
            f"{path}: truncated: its last face has {len(words) - 1} of its {int(words[0])} corners; copy it again"
        )


def _off_rows(path: Path) -> tuple[list[int], list[bytes]]:
    """Returns the numbers of vertices and faces of a text file, and the rows behind them; nothing for other files."""
    lines = (line.split(b"#")[0].strip() for line in path.read_bytes().splitlines())
    rows = [line for line in lines if line]
    head = re.match(rb"[A-Z4n]*OFF\s*(.*)", rows[0]) if rows else None
    if head is None or b"BINARY" in head[1]:
        return [], []
    counts, rows = (head[1], rows[1:]) if head[1] else (b"".join(rows[1:2]), rows[2:])
    numbers = counts.split()[:2]
    known = len(numbers) == 2 and all(number.isdigit() for number in numbers)
    return ([int(number) for number in numbers], rows) if known else ([], [])


def _check_stl(path: Path, data: bytes) -> None:
    count = int.from_bytes(data[_STL_HEAD - 4 : _STL_HEAD], "little")
    if len(data) in (0, _STL_HEAD + count * _STL_FACE):
        return
    if end := _end_of_stl(data):
        with log.each_once(_SAID):
            log.warn(f"{path}: {len(data) - end} bytes behind its {count} triangles were ignored")
    elif _is_binary(data):
        _compare(path, "triangles", count, (len(data) - _STL_HEAD) // _STL_FACE)
        _compare(path, "bytes", _STL_HEAD + count * _STL_FACE, len(data))
    elif re.match(_SOLID, data) and not re.search(rb"(?i)\bendsolid\b[^\n]*\s*\Z", data):
        raise DataError(f"{path}: truncated: it doesn't end with endsolid; copy it again")
    elif re.match(_SOLID, data) and len(_CORNER.findall(data)) != 3 * len(_LOOP.findall(data)):
        raise DataError(f"{path}: some of its faces are no triangles, and an STL has no others; export it as triangles")
    elif not re.match(_SOLID, data):
        raise DataError(
            f"{path}: truncated: its header alone has {_STL_HEAD} bytes, it holds {len(data)}; copy it again"
        )


def _check_ply(path: Path, elements: list[Element], file: BinaryIO | None) -> None:
    """Raises DataError for faces that aren't read, and where a text holds other rows than its header counts. file: that of a text,
    behind its header.
    """
    if any(element.name == "tristrips" and element.count for element in elements):
        raise DataError(
            f"{path}: its faces are strips of triangles (tristrips), which are not read; export it as triangles"
        )
    if file is not None:
        rows = [line for line in file if line.strip()]
        _compare(path, "rows", sum(element.count for element in elements if element.properties), len(rows))
        if rows and elements[-1].properties[:1] and not elements[-1].properties[0][1]:
            _require_corners(path, rows[-1])


_READERS: dict[str, Callable[[Path, Path | None], Any]] = {
    **{".obj": _read_obj, ".stl": _read_stl, ".ply": _read_ply, ".off": _read_off, ".dae": _read_dae},
    **{".glb": _read_gltf, ".gltf": _read_gltf},
}
