"""Skinned and morphing meshes of a glTF file, baked over a clip into one AnimatedMesh."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dpcli.counted import counted
from dpcli.prepare.meshes.animated_mesh import AnimatedMesh
from dpcli.prepare.meshes.gltf import Gltf
from dpcli.prepare.meshes.gltf_extensions import decompress, instances
from dpcli.prepare.meshes.gltf_material import is_double_sided, read_material, texture_sets
from dpcli.prepare.meshes.gltf_nodes import (
    Clip,
    node_name,
    node_parents,
    node_poses,
    node_visibility,
    read_clip,
    require_affine,
)
from dpcli.prepare.meshes.skinning import skin, vertex_normals
from dpcli.runtime.progress import log

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_STILL = Clip("still", 0.0, 0.0, {})
_BRIGHTEST = 8.0  # of vertex colors: a little above 1 is light, far above it is another range
_MOST_LOST = 0.1  # of the vertices may lack weights: more is a broken file
_FAR = 100.0  # times as far from the origin as the model is large
_MOST_VERTICES = 20_000_000  # of all instances of a node


@dataclass
class _Piece:
    """Holds one primitive of one node, at rest; targets: position deltas f32 (M,V,3) and normal deltas, or None."""

    node: int
    positions: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    uv: np.ndarray
    color: np.ndarray
    bones: np.ndarray
    weights: np.ndarray
    inverse_bind: dict[int, np.ndarray]
    material: int
    targets: np.ndarray | None
    normal_targets: np.ndarray | None
    emission_uv: np.ndarray
    faceted: bool


def bake(file: Gltf, clip: int | None, frames: int) -> AnimatedMesh:
    """Bakes the scene's triangles at `frames` times of a clip (None: as it stands); time counts from 0. Bones are the
    file's nodes. A model far from the origin is moved there.

    What has no skin hangs on its node. Points and lines are passed over. What is hidden at a time is a point then.
    Raises DataError when the file is broken.
    """
    parent = node_parents(file)
    curves = _STILL if clip is None else read_clip(file, clip)
    if curves.passed:
        log.warn(f"{file.path}: clip {curves.name!r} also changes what is not read: {', '.join(curves.passed)}")
    time = curves.sample_times(frames)
    poses, shown = node_poses(file, parent, curves, time), node_visibility(file, parent, curves, time)
    pieces = _visible_pieces(file, poses, shown)
    if not pieces:
        raise file.fail("has no triangles in its scene; expected a mesh with an animation")
    used = sorted({piece.material for piece in pieces})
    moved, _ = _moved(file, pieces, curves, time, poses)
    for piece, (positions, _) in zip(pieces, moved):
        hidden = ~shown[:, piece.node]
        positions[hidden] = positions[hidden, :1]
    starts = np.cumsum([0] + [len(piece.uv) for piece in pieces])
    joints = max(piece.bones.shape[1] for piece in pieces)

    def joined(key: str, width: int = 0) -> np.ndarray:
        arrays = [getattr(piece, key) for piece in pieces]
        if width:
            arrays = [np.pad(a, ((0, 0), (0, width - a.shape[1]))) for a in arrays]
        return np.concatenate(arrays)

    seconds = time - time[0] if frames > 1 and time[-1] > time[0] else np.arange(frames, dtype=float)
    mesh = AnimatedMesh(
        name=f"{file.path.stem} {curves.name}",
        time=seconds,
        positions=np.concatenate([x for x, _ in moved], axis=1),
        normals=np.concatenate([n for _, n in moved], axis=1),
        triangles=np.concatenate([piece.triangles + start for piece, start in zip(pieces, starts)]),
        material=np.concatenate([np.full(len(piece.triangles), used.index(piece.material)) for piece in pieces]),
        materials=tuple(read_material(file, index) for index in used),
        color=joined("color"),
        uv=joined("uv"),
        bones=joined("bones", joints),
        weights=joined("weights", joints),
        bone_pose=_hidden_apart(pieces, poses, shown),
        bone_parent=parent,
        emission_uv=joined("emission_uv"),
    )
    culled = np.array([not is_double_sided(file, index) for index in used])[mesh.material]
    faceted = np.concatenate([np.full(len(piece.triangles), piece.faceted) for piece in pieces])
    turned = np.stack([_turns(piece, poses) for piece in pieces], axis=1)
    return replace(
        mesh,
        one_sided=culled & ~_has_twin(mesh) if culled.any() else None,
        faceted=faceted if faceted.any() else None,
        turned=turned.repeat([len(piece.triangles) for piece in pieces], axis=1)
        if culled.any() and turned.any()
        else None,
    )


def _moved(
    file: Gltf, pieces: list[_Piece], clip: Clip, time: np.ndarray, poses: np.ndarray
) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray | None]:
    """Returns positions and normals f32 (T,V,3) of each piece; and the middle f64 (3) of a model far from the origin, which is
    taken off these and, in place, off the poses f64 (T,N,4,4), or None.
    """
    moved = [_move(file, piece, clip, time, poses) for piece in pieces]
    middle = _middle_far_away([positions for positions, _ in moved]) if moved else None
    if middle is not None:
        poses[..., :3, 3] -= middle
        moved = [_move(file, piece, clip, time, poses) for piece in pieces]
    return moved, middle


def _middle_far_away(positions: list[np.ndarray]) -> np.ndarray | None:
    """Returns the middle f64 (3) of pieces (T,V,3) that lie so far from the origin, as on maps, that 32 bits blur them; else None."""
    low, high = (np.stack([end(x, axis=(0, 1)) for x in positions]).astype(np.float64) for end in (np.min, np.max))
    low, high = low.min(0), high.max(0)
    if not np.isfinite([low, high]).all():
        return None
    middle = (low + high) / 2
    return middle if np.abs(middle).max() > _FAR * (high - low).max() else None


def shape_at_rest(file: Gltf) -> tuple[np.ndarray, np.ndarray]:
    """Returns vertices f64 (V,3) and triangles i64 (T,3) of the scene as it stands, without what shows them: no texture is read."""
    parent, time = node_parents(file), np.zeros(1)
    poses, shown = node_poses(file, parent, _STILL, time), node_visibility(file, parent, _STILL, time)
    pieces = _visible_pieces(file, poses, shown)
    starts = np.cumsum([0] + [len(piece.uv) for piece in pieces])
    moved, middle = _moved(file, pieces, _STILL, time, poses)
    vertices = np.concatenate([np.zeros((0, 3)), *(positions[0] for positions, _ in moved)])
    triangles = [piece.triangles + start for piece, start in zip(pieces, starts)]
    return vertices if middle is None else vertices + middle, np.concatenate([np.zeros((0, 3), np.int64), *triangles])


def _visible_pieces(file: Gltf, poses: np.ndarray, shown: np.ndarray) -> list[_Piece]:
    """Returns the pieces with triangles of the nodes that are seen at some time, bool shown (T,N), their fronts outwards."""
    visible = [node for node in _scene_nodes(file) if shown[:, node].any()]
    pieces = [piece for node in visible for piece in _read_node(file, node)]
    return [_turned_out(piece, poses) for piece in pieces if len(piece.triangles)]


def _hidden_apart(pieces: list[_Piece], poses: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Returns the poses (T,N,4,4) with nodes that carry pieces put into one point while they are hidden, bool shown (T,N).

    So what is seen at other times moves apart, as it does where clips hide it by a scale of 0.
    """
    joints = {bone for piece in pieces if piece.node not in piece.inverse_bind for bone in piece.inverse_bind}
    poses = poses.copy()
    for node in {piece.node for piece in pieces} - joints:
        poses[~shown[:, node], node] = np.diag([0.0, 0.0, 0.0, 1.0])
    return poses


def _turned_out(piece: _Piece, poses: np.ndarray) -> _Piece:
    """Returns the piece with its triangles wound the other way when its node, or first bone, mirrors it where it is largest."""
    size = _sizes(piece, poses)
    return replace(piece, triangles=piece.triangles[:, ::-1]) if size[np.abs(size).argmax()] < 0 else piece


def _turns(piece: _Piece, poses: np.ndarray) -> np.ndarray:
    """Returns bool (T): when a node, or first bone, mirrors a piece though it doesn't where it is largest, or the other way."""
    size = _sizes(piece, poses)
    return size * size[np.abs(size).argmax()] < 0


def _sizes(piece: _Piece, poses: np.ndarray) -> np.ndarray:
    """Returns (T) how many times as large its node, or first bone, makes a piece, negative where it mirrors it."""
    bone = int(piece.bones[0, piece.weights[0].argmax()])
    return np.linalg.det((poses[:, bone] @ piece.inverse_bind[bone])[:, :3, :3])


def _has_twin(mesh: AnimatedMesh) -> np.ndarray:
    """Returns bool (F): which triangles lie on another one, as exporters write a leaf that is seen from both sides."""
    first = mesh.shown().argmax(0)  # while hidden, all of a piece lie on one point
    corners = mesh.positions[first[:, None], mesh.triangles].astype(np.float64)
    grid = max(float(np.ptp(corners)), 1e-30) * 1e-6
    middles = np.rint(np.concatenate([corners.mean(1), corners.min(1), corners.max(1)], axis=1) / grid)
    _, inverse, counts = np.unique(middles, axis=0, return_inverse=True, return_counts=True)
    return counts[inverse.reshape(-1)] > 1


def _scene_nodes(file: Gltf) -> list[int]:
    """Returns nodes of the default scene, parents first; all nodes when the file names no scene."""
    if not file.items("scenes"):
        return list(range(len(file.items("nodes"))))
    scene = file.item("scenes", number := file.tree.get("scene", 0))
    if (count := len(file.items("scenes"))) > 1:
        log.info(
            f"{file.path}: {count} scenes in it; {number} ({scene.get('name') or 'no name'}) is read, as viewers do"
        )
    order = list(dict.fromkeys(scene.get("nodes", [])))
    for index in order:  # grows while it is walked; circles are refused before
        order += file.item("nodes", index).get("children", [])
    return list(dict.fromkeys(order))  # a scene may list a child of another of its nodes, too


def _read_node(file: Gltf, index: int) -> list[_Piece]:
    node = file.item("nodes", index)
    if "mesh" not in node:
        return []
    primitives = file.item("meshes", node["mesh"]).get("primitives", [])
    kept = [p for p in primitives if p.get("mode", _TRIANGLES) in (_TRIANGLES, _STRIP, _FAN)]
    if len(kept) < len(primitives):
        left = f"{len(primitives) - len(kept)} of {counted(len(primitives), 'piece')}"
        log.warn(f"{file.path}: points and lines of {node_name(file, index)!r} are left out, {left}")
    skins = _read_skin(file, node["skin"]) if "skin" in node else None
    pieces = [_read_primitive(file, index, primitive, skins) for primitive in kept]
    found = instances(file, index)
    if found is None:
        return pieces
    transforms, colors = found[0], _colors(file, found[1], f"instances of {node_name(file, index)!r}")
    if len(transforms) * sum(len(piece.positions) for piece in pieces) > _MOST_VERTICES:
        raise file.fail(f"{len(transforms)} instances of {node_name(file, index)!r} are too many to draw")
    return [copy for piece in pieces for copy in _copies(piece, transforms, colors)]


def _copies(piece: _Piece, transforms: np.ndarray, colors: np.ndarray) -> list[_Piece]:
    """Returns one piece for each instance, placed by its transform (N,4,4) below the node, times its color f32 (N,4)."""
    bones, weights = np.zeros((len(piece.positions), 1), int), np.ones((len(piece.positions), 1))
    placed, turned = skin(piece.positions, piece.normals, bones, weights, transforms[:, None])
    made = []
    for transform, color, positions, normals in zip(transforms, colors, placed, turned):
        mirrored = np.linalg.det(transform[:3, :3]) < 0
        triangles = piece.triangles[:, ::-1] if mirrored else piece.triangles
        copy = replace(piece, positions=positions, normals=normals, triangles=triangles, color=piece.color * color)
        if piece.targets is not None:
            copy.targets = piece.targets @ transform[:3, :3].T
            copy.normal_targets = piece.normal_targets @ transform[:3, :3].T
        made.append(copy)
    return made


def _read_skin(file: Gltf, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns joints (nodes) i64 (K) and inverse bind matrices f64 (K,4,4)."""
    entry = file.item("skins", index)
    joints = np.array(entry.get("joints", []), np.int64)
    for joint in joints:
        file.item("nodes", int(joint))
    if not len(joints):
        raise file.fail(f"skin {index} has no joints; export the file again")
    if "inverseBindMatrices" not in entry:
        return joints, np.tile(np.eye(4), (len(joints), 1, 1))
    if len(np.unique(joints)) < len(joints):  # bones are told apart by their nodes
        raise file.fail(f"skin {index} lists a joint twice; export the file again")
    found = file.accessor(entry["inverseBindMatrices"], f"bones of skin {index}", 16).reshape(-1, 4, 4)
    if len(found) < len(joints):
        raise file.fail(f"skin {index} has {len(found)} bind matrices for {len(joints)} bones; export the file again")
    inverse = found[: len(joints)].transpose(0, 2, 1).astype(np.float64)
    require_affine(file, inverse, f"a bind matrix of skin {index}")
    return joints, inverse


def _read_primitive(file: Gltf, node: int, entry: dict[str, Any], skins: Any) -> _Piece:
    where = f"mesh of {node_name(file, node)!r}"
    attributes = entry.get("attributes", {})
    if "POSITION" not in attributes:
        raise file.fail(f"{where} has no positions; export the file again")
    decompress(file, entry, where)
    positions = _floats(file, attributes, "POSITION", where, 3)
    count = len(positions)

    def read(key: str, width: int | None, default: np.ndarray, finite: bool = True) -> np.ndarray:
        if key not in attributes:
            return default
        values = _floats(file, attributes, key, where, width, finite)
        if len(values) != count:
            raise file.fail(f"{where}: {len(values)} {key} for {count} vertices; export the file again")
        return values

    triangles = _triangles(file, entry, count, where)
    computed = vertex_normals(positions, triangles)
    material = entry.get("material", -1)
    uv_set, emission_set = texture_sets(file, material)
    _name_lost(file, entry, (uv_set, emission_set), where)
    color = _colors(file, read("COLOR_0", None, np.ones((count, 4), np.float32)), where)
    bones, weights, inverse_bind = _binding(file, node, attributes, positions, skins, where)
    targets, nowhere = entry.get("targets") or None, np.zeros((count, 2), np.float32)
    return _Piece(
        node,
        positions,
        _whole_normals(file, read("NORMAL", 3, computed, finite=False), computed, where),
        triangles,
        read(f"TEXCOORD_{uv_set}", 2, nowhere),
        color,
        bones,
        weights,
        inverse_bind,
        material,
        targets and _deltas(file, targets, "POSITION", count, where),
        targets and _deltas(file, targets, "NORMAL", count, where),
        read(f"TEXCOORD_{emission_set}", 2, nowhere),
        "NORMAL" not in attributes,  # then the specification asks for flat shading, and viewers do it
    )


def _name_lost(file: Gltf, entry: dict[str, Any], sets: tuple[int | None, int | None], where: str) -> None:
    """Warns of textures without coordinates and of morph targets that change more than the shape."""
    for number in sorted({number for number in sets if number is not None}):
        if f"TEXCOORD_{number}" not in entry["attributes"]:
            log.warn(f"{file.path}: {where} has no TEXCOORD_{number} for its texture, whose first corner is taken")
    kinds = {key for target in entry.get("targets", []) for key in target} - {"POSITION", "NORMAL", "TANGENT"}
    if kinds:
        log.warn(f"{file.path}: {where}: its morph targets' {', '.join(sorted(kinds))} are not read")


def _colors(file: Gltf, color: np.ndarray, where: str) -> np.ndarray:
    """Returns vertex colors f32 (V,4); values up to 255 or 65535 that the file doesn't call normalized become 0..1."""
    largest = color[:, :3].max()
    if largest > _BRIGHTEST:
        scale = 255 if largest < 256 else 65535
        log.warn(f"{file.path}: {where}: vertex colors up to {largest:g} are taken as shares of {scale}")
        color = color / np.float32(scale)
    return np.concatenate([color, np.ones((len(color), 4 - color.shape[1]), np.float32)], axis=1)


def _whole_normals(file: Gltf, normals: np.ndarray, computed: np.ndarray, where: str) -> np.ndarray:
    """Returns normals f32 (V,3), those that are not finite computed from the triangles, with a warning."""
    lost = ~np.isfinite(normals).all(1)
    if lost.any():
        log.warn(
            f"{file.path}: {where}: {counted(int(lost.sum()), 'normal')} NaN or infinite; computed from the triangles"
        )
        normals = np.where(lost[:, None], computed, normals)
    return normals


def _floats(file: Gltf, attributes: dict, key: str, where: str, width: int | None, finite: bool = True) -> np.ndarray:
    values = file.accessor(attributes[key], f"{key} of {where}", width, finite)
    return values.reshape(len(values), -1).astype(np.float32)


def _deltas(file: Gltf, targets: list[dict], key: str, count: int, where: str) -> np.ndarray:
    zero = np.zeros((count, 3), np.float32)
    what = f"target of {where}"
    found = [_floats(file, target, key, what, 3, key != "NORMAL") if key in target else zero for target in targets]
    found = [np.where(np.isfinite(delta), delta, 0) for delta in found]
    if any(len(delta) != count for delta in found):
        raise file.fail(f"{where}: a morph target has another number of vertices; export the file again")
    return np.stack(found)


def _triangles(file: Gltf, entry: dict[str, Any], count: int, where: str) -> np.ndarray:
    corners = np.arange(count)
    if "indices" in entry:
        corners = file.accessor(entry["indices"], f"indices of {where}", 1).astype(np.int64)
    if len(corners) and (corners.max() >= count or corners.min() < 0):
        raise file.fail(f"{where}: a triangle uses vertex {corners.max()} of {count}; the file is damaged")
    drawn = entry.get("mode", _TRIANGLES)
    mode = _TRIANGLES if entry.get("indices") in file.decoded else drawn  # Draco's blocks hold triangles
    if len(corners) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == _STRIP:  # every second triangle is wound the other way
        strip = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
        strip[1::2] = strip[1::2, [0, 2, 1]]
        return strip
    if mode == _FAN:
        return np.stack([np.full(len(corners) - 2, corners[0]), corners[1:-1], corners[2:]], axis=1)
    return corners[: len(corners) // 3 * 3].reshape(-1, 3)


def _binding(
    file: Gltf, node: int, attributes: dict, positions: np.ndarray, skins: Any, where: str
) -> tuple[np.ndarray, np.ndarray, dict[int, np.ndarray]]:
    """Returns bones (nodes) i64 (V,J), weights f32 (V,J) that sum to 1, inverse bind matrix of every bone used."""
    count = len(positions)
    if skins is not None and "JOINTS_0" not in attributes:
        log.warn(f"{file.path}: {where} has a skin but no JOINTS_0; it moves with its node")
    if skins is None or "JOINTS_0" not in attributes:
        return np.full((count, 1), node), np.ones((count, 1), np.float32), {node: np.eye(4)}
    joints, inverse = skins
    sets = [n for n in range(8) if f"JOINTS_{n}" in attributes and f"WEIGHTS_{n}" in attributes]
    if not sets:
        raise file.fail(f"{where} has joints without weights; export the file again")
    local, weights = (
        np.concatenate(
            [_floats(file, attributes, f"{key}_{n}", where, 4, finite=key != "WEIGHTS") for n in sets], axis=1
        )
        for key in ("JOINTS", "WEIGHTS")
    )
    if len(local) != count or len(weights) != count:
        raise file.fail(f"{where}: {len(local)} joints and {len(weights)} weights for {count} vertices")
    local, weights = _repaired(file, local.astype(np.int64), weights, positions, where)
    if local.max() >= len(joints):
        raise file.fail(f"{where}: a vertex hangs on bone {local.max()} of {len(joints)}; export the file again")
    return joints[local], weights, {int(j): m for j, m in zip(joints, inverse)}


def _repaired(
    file: Gltf, local: np.ndarray, weights: np.ndarray, positions: np.ndarray, where: str
) -> tuple[np.ndarray, np.ndarray]:
    """Returns joints and weights (V,J), weights normalized, joints of no weight 0.

    Exporters leave a few vertices without weights, or with 0/0 = NaN: they follow the nearest vertex that has some.
    """
    total = weights.sum(1)
    lost = ~(np.isfinite(total) & (total > 1e-6))
    if lost.mean() > _MOST_LOST:
        raise file.fail(f"{where}: {lost.sum()} of {len(lost)} vertices have no finite weights; repair the model")
    if lost.any():
        from scipy.spatial import cKDTree

        log.warn(
            f"{file.path}: {where}: {counted(int(lost.sum()), 'vertex', 'vertices')} without finite weights: as the nearest ones"
        )
        near = np.flatnonzero(~lost)[cKDTree(positions[~lost]).query(positions[lost])[1]]
        local, weights = local.copy(), weights.copy()
        local[lost], weights[lost] = local[near], weights[near]
    weights = weights / weights.sum(1, keepdims=True)
    return np.where(weights != 0, local, 0), weights


def _move(file: Gltf, piece: _Piece, clip: Clip, time: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns positions and normals f32 (T,V,3) of a piece."""
    positions, normals = piece.positions, piece.normals
    if piece.targets is not None:
        amount = _morph_weights(file, piece, clip, time)
        positions = positions + np.einsum("tm,mva->tva", amount, piece.targets)
        normals = normals + np.einsum("tm,mva->tva", amount, piece.normal_targets)
    used, own = np.unique(piece.bones, return_inverse=True)  # of all nodes a piece hangs on few
    bind = np.stack([piece.inverse_bind[bone] for bone in used.tolist()])
    return skin(positions, normals, own.reshape(piece.bones.shape), piece.weights, poses[:, used] @ bind)


def _morph_weights(file: Gltf, piece: _Piece, clip: Clip, time: np.ndarray) -> np.ndarray:
    """Returns the weights f64 (T,M) of the clip, or else the node's or mesh's own."""
    count = len(piece.targets)
    if (piece.node, "weights") in clip.curves:
        amount = clip.curves[piece.node, "weights"].at(time)
    else:
        node = file.item("nodes", piece.node)
        fixed = node.get("weights") or file.item("meshes", node["mesh"]).get("weights") or [0.0] * count
        amount = np.tile(np.array(fixed, np.float64), (len(time), 1))
    if amount.shape[1] != count or not np.isfinite(amount).all():
        raise file.fail(f"{node_name(file, piece.node)!r}: {amount.shape[1]} weights for {count} morph targets")
    return amount
