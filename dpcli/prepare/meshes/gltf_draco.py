"""Meshes compressed by Draco in glTF files (KHR_draco_mesh_compression), decoded by DracoPy."""

from __future__ import annotations

from typing import Any

import numpy as np

from dpcli.prepare.meshes.gltf import Gltf


def decompress(file: Gltf, primitive: dict[str, Any], where: str) -> None:
    """Decodes a primitive's block, if it has one, so that its accessors give what it holds.

    Raises DataError when the block is damaged or lacks what it should hold.
    """
    block = primitive.get("extensions", {}).get("KHR_draco_mesh_compression")
    if block is None or primitive.get("indices") in file.decoded:
        return
    import DracoPy

    try:
        mesh = DracoPy.decode(file.view_bytes(block["bufferView"]))
        found = {entry["unique_id"]: np.asarray(entry["data"]) for entry in mesh.attributes}
        arrays = {primitive["attributes"][key]: found[wanted] for key, wanted in block["attributes"].items()}
        if "indices" in primitive:
            arrays[primitive["indices"]] = np.asarray(mesh.faces, np.uint32).reshape(-1, 1)
    except (DracoPy.FileTypeException, RuntimeError, ValueError, KeyError, TypeError, AttributeError) as error:
        problem = f"{type(error).__name__}: {error}"
        raise file.fail(f"{where}: its Draco block cannot be decoded ({problem}); export the file again") from None
    for index, values in arrays.items():
        file.decoded[index] = values.reshape(len(values), -1)
