"""Extensions of glTF 2.0: which of them are read, which change nothing seen, and which must be named to the user; instances, and
meshes compressed by Draco (KHR_draco_mesh_compression), decoded by DracoPy.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dpcli.prepare.meshes.gltf import MESHOPT, Gltf
from dpcli.prepare.meshes.skinning import matrices
from dpcli.runtime.progress import log

READ = {
    *MESHOPT,
    "EXT_mesh_gpu_instancing",
    "EXT_texture_avif",
    "EXT_texture_webp",
    "KHR_animation_pointer",
    "KHR_draco_mesh_compression",
    "KHR_materials_emissive_strength",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_node_visibility",
    "KHR_texture_transform",
}
_UNSEEN = {  # what they say does not change a picture
    "CESIUM_primitive_outline",
    "EXT_mesh_features",
    "EXT_structural_metadata",
    "FB_ngon_encoding",
    "KHR_accessor_float64",
    "KHR_materials_variants",
    "KHR_node_hoverability",
    "KHR_node_selectability",
    "KHR_xmp",
    "KHR_xmp_json_ld",
    "VRM",
    "VRMC_vrm",
}
_ADVICE = {"KHR_texture_basisu": "export its textures as PNG or JPEG"}
_METHOD, _EDGEBREAKER = 8, 1  # the byte of a Draco block that names its encoding, and the one that keeps no order
_IDENTITY = {"TRANSLATION": (0.0, 0.0, 0.0), "ROTATION": (0.0, 0.0, 0.0, 1.0), "SCALE": (1.0, 1.0, 1.0)}
_COLOR = "_COLOR_0"  # of instances


def refuse_required(file: Gltf) -> None:
    """Raises DataError when the file can't be understood without an extension that is not read."""
    for name in map(str, file.tree.get("extensionsRequired", [])):
        if name not in READ | _UNSEEN and not name.startswith(("KHR_materials_", "KHR_lights_punctual")):
            advice = _ADVICE.get(name, "export it without this extension")
            raise file.fail(f"needs the extension {name}, which is not read; {advice}")


def name_unread(file: Gltf) -> None:
    """Warns of every extension the file uses that changes its picture and is not read, once each.

    Those of its materials count, too, where its list of extensions lacks them.
    """
    used = [*file.tree.get("extensionsUsed", []), *(name for m in file.items("materials") for name in _names_of(m))]
    unread = [name for name in dict.fromkeys(map(str, used)) if name not in READ | _UNSEEN]
    if unread:
        log.warn(f"{file.path}: not read, so the pictures may differ from a viewer's: {', '.join(unread)}")


def _names_of(entry: dict[str, Any]) -> list[str]:
    found = entry.get("extensions", {})
    return list(found) if isinstance(found, dict) else []


def instances(file: Gltf, node: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns the transforms f64 (N,4,4) of a node's instances (EXT_mesh_gpu_instancing), and their colors f32 (N,3 or 4), white
    where the file has none; or None without instances. Colors are three.js's: the extension leaves further attributes free.
    """
    entry: dict[str, Any] = file.item("nodes", node).get("extensions", {}).get("EXT_mesh_gpu_instancing")
    if entry is None:
        return None
    what = f"instances of node {node}"
    given = {
        key: file.accessor(index, what, len(_IDENTITY[key])).astype(np.float64)
        for key, index in entry.get("attributes", {}).items()
        if key in _IDENTITY
    }
    colors = None
    if _COLOR in entry.get("attributes", {}):
        colors = file.accessor(entry["attributes"][_COLOR], what).astype(np.float32)
    counts = {len(values) for values in (*given.values(), *([] if colors is None else [colors]))}
    if len(counts) != 1:
        raise file.fail(f"{what}: their attributes have {sorted(counts)} entries; expected one number for all")
    count = counts.pop()
    values = [given.get(key, np.tile(rest, (count, 1))) for key, rest in _IDENTITY.items()]
    return matrices(*values), np.ones((count, 3), np.float32) if colors is None else colors


def decompress(file: Gltf, primitive: dict[str, Any], where: str) -> None:
    """Decodes a primitive's block, if it has one, so that its accessors give what it holds until the next one is read.

    Primitives may share an accessor, as Blender's do for equal triangles, but each block has its own order of vertices.
    Raises DataError when the block is damaged or lacks what it should hold.
    """
    block = primitive.get("extensions", {}).get("KHR_draco_mesh_compression")
    file.decoded = {}
    if block is None:
        return
    import DracoPy

    try:
        if (view := block["bufferView"]) not in file.blocks:  # nodes may share a mesh
            file.blocks[view] = DracoPy.decode(data := file.view_bytes(view))
            if primitive.get("targets") and data[_METHOD] == _EDGEBREAKER:
                log.warn(
                    f"{file.path}: {where}: its Draco block changed the order of its vertices, so that its morph targets move"
                    " the wrong ones; export it without Draco, or with Draco's sequential encoding"
                )
        mesh = file.blocks[view]
        found = {entry["unique_id"]: np.asarray(entry["data"]) for entry in mesh.attributes}
        arrays = {primitive["attributes"][key]: found[wanted] for key, wanted in block["attributes"].items()}
        if "indices" in primitive:
            arrays[primitive["indices"]] = np.asarray(mesh.faces, np.uint32).reshape(-1, 1)
    except (DracoPy.FileTypeException, RuntimeError, ValueError, KeyError, TypeError, AttributeError) as error:
        problem = f"{type(error).__name__}: {error}"
        raise file.fail(f"{where}: its Draco block cannot be decoded ({problem}); export the file again") from None
    file.decoded = {index: values.reshape(len(values), -1) for index, values in arrays.items()}
