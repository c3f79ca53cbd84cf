"""Small glTF files for tests: arrays become accessors, the rest is written as the specification has it."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_COMPONENTS = {"f4": 5126, "u1": 5121, "u2": 5123, "u4": 5125, "i1": 5120, "i2": 5122}


class GlbFile:
    """`tree` is free to be changed; `add` stores an array and returns its accessor, `view` raw bytes."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.tree: dict[str, Any] = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": []}

    def view(self, data: bytes, **more: object) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **more})
        self.data += data
        return len(self.tree["bufferViews"]) - 1

    def add(self, array: Any, dtype: str = "f4", **more: object) -> int:
        array = np.asarray(array, dtype)
        columns = int(np.prod(array.shape[1:]))
        self.tree["accessors"].append(
            {
                "bufferView": self.view(array.tobytes()),
                "componentType": _COMPONENTS[dtype],
                "count": len(array),
                "type": _TYPES[columns],
                **more,
            }
        )
        return len(self.tree["accessors"]) - 1

    def picture(self, pixels: np.ndarray, **material: object) -> None:
        """A texture u8 (H,W,4) as material 0."""
        from PIL import Image

        png = io.BytesIO()
        Image.fromarray(pixels).save(png, "PNG")
        self.tree["images"] = [{"bufferView": self.view(png.getvalue()), "mimeType": "image/png"}]
        self.tree["textures"] = [{"source": 0}]
        self.tree["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}, **material}]

    def animate(self, node: int, path: str, times: Any, values: Any, interpolation: str = "LINEAR") -> None:
        """One more channel of the one clip, named Bend."""
        clip = self.tree.setdefault("animations", [{"name": "Rig|Bend", "channels": [], "samplers": []}])[0]
        sampler = {"input": self.add(times), "output": self.add(values), "interpolation": interpolation}
        clip["samplers"].append(sampler)
        clip["channels"].append({"sampler": len(clip["samplers"]) - 1, "target": {"node": node, "path": path}})

    def bytes(self) -> bytes:
        data = bytes(self.data) + b"\0" * (-len(self.data) % 4)
        text = json.dumps({**self.tree, "buffers": [{"byteLength": len(data)}]}).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
        return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks

    def write(self, path: Path) -> Path:
        path.write_bytes(self.bytes())
        return path


def arm(turn: float = np.pi / 2, smooth: bool = False) -> GlbFile:
    """Two bones along x, shoulder at 0 and elbow at 1; within a second the elbow turns by `turn` about z.

    A strip from x = 0 to 2; smooth: the vertices at the elbow hang half on each bone. The mesh's own node stands far
    away, which skinning must pass over; the whole rig is shifted by (0, 5, 0).
    """
    file = GlbFile()
    x = np.repeat([0.0, 0.5, 1.0, 1.5, 2.0], 2)
    positions = np.stack([x, np.tile([-0.1, 0.1], 5), 0 * x], axis=1)
    joints = np.zeros((10, 4))
    joints[:, 1] = 1
    on_second = np.where(x > 1, 1.0, np.where(x < 1, 0.0, 0.5 if smooth else 0.0))
    weights = np.stack([1 - on_second, on_second, 0 * x, 0 * x], axis=1)
    triangles = [[2 * k + a for a in corner] for k in range(4) for corner in ((0, 2, 1), (1, 2, 3))]
    bind = np.tile(np.eye(4), (2, 1, 1))
    bind[1, :3, 3] = [-1, 0, 0]
    attributes = {
        "POSITION": file.add(positions),
        "NORMAL": file.add(np.tile([0.0, 0, 1], (10, 1))),
        "JOINTS_0": file.add(joints, "u1"),
        "WEIGHTS_0": file.add(weights),
    }
    file.tree |= {
        "nodes": [
            {"name": "rig", "children": [1, 3], "translation": [0, 5, 0]},
            {"name": "shoulder", "children": [2]},
            {"name": "elbow", "translation": [1, 0, 0]},
            {"name": "strip", "mesh": 0, "skin": 0, "translation": [100, 100, 100]},
        ],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": file.add(np.ravel(triangles), "u2")}]}],
        "skins": [{"joints": [1, 2], "inverseBindMatrices": file.add(bind.transpose(0, 2, 1).reshape(2, 16))}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }
    file.animate(2, "rotation", [0, 1], [[0, 0, 0, 1], [0, 0, np.sin(turn / 2), np.cos(turn / 2)]])
    return file


def quad(shift: float = 0.0) -> GlbFile:
    """A square from -1 to 1 that faces +z, colored by material or vertices as the test adds; it slides by `shift` in x."""
    file = GlbFile()
    attributes = {
        "POSITION": file.add([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]),
        "TEXCOORD_0": file.add([[0, 1], [1, 1], [1, 0], [0, 0]]),
    }
    indices = file.add([0, 1, 2, 0, 2, 3], "u4")
    file.tree |= {
        "nodes": [{"name": "square", "mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 1]}}],
    }
    file.animate(0, "translation", [0, 1], [[0, 0, 0], [shift, 0, 0]])
    return file
