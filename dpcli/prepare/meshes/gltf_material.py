"""Materials of a glTF file: base color, its texture and transparency; reflections are left out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from dpcli.prepare.meshes.animated_mesh import Material, Texture
from dpcli.prepare.meshes.gltf import Gltf

_WRAP = {33071: "clamp", 33648: "mirror", 10497: "repeat"}


def to_linear(color: np.ndarray) -> np.ndarray:
    """Converts sRGB in 0..1 to linear light (IEC 61966-2-1).

    >>> to_linear(np.array([0.0, 0.5, 1.0])).round(4).tolist()
    [0.0, 0.214, 1.0]
    """
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


def to_srgb(color: np.ndarray) -> np.ndarray:
    """Converts linear light in 0..1 to sRGB; the inverse of `to_linear`."""
    return np.where(color <= 0.0031308, 12.92 * color, 1.055 * np.maximum(color, 1e-9) ** (1 / 2.4) - 0.055)


def read_material(file: Gltf, index: int, header_only: bool = False) -> Any:
    """Reads the Material of this index (-1: white); with header_only returns the number of the texture coordinates it
    uses.
    """
    entry = file.item("materials", index) if index != -1 else {}
    extensions = entry.get("extensions", {})
    metal = entry.get("pbrMetallicRoughness", {})
    color, texture = metal.get("baseColorFactor"), metal.get("baseColorTexture")
    if "KHR_materials_pbrSpecularGlossiness" in extensions:  # older exports keep their colors there
        old = extensions["KHR_materials_pbrSpecularGlossiness"]
        color, texture = old.get("diffuseFactor", color), old.get("diffuseTexture", texture)
    change = (texture or {}).get("extensions", {}).get("KHR_texture_transform", {})
    if header_only:
        return change.get("texCoord", (texture or {}).get("texCoord", 0))
    try:
        factor = tuple(float(np.clip(value, 0, 1)) for value in (color or (1, 1, 1, 1)))
        assert len(factor) == 4 and np.isfinite(factor).all()
    except (TypeError, ValueError, AssertionError):
        raise file.fail(f"material {index}: its color is not four numbers; export the file again") from None
    blend = str(entry.get("alphaMode", "OPAQUE")).lower()
    material = Material(factor, None, blend, float(entry.get("alphaCutoff", 0.5)), "KHR_materials_unlit" in extensions)
    return replace(material, texture=_texture(file, texture["index"], change)) if texture else material


def _texture(file: Gltf, index: Any, change: dict[str, Any]) -> Texture:
    entry = file.item("textures", index)
    webp = entry.get("extensions", {}).get("EXT_texture_webp", {})
    source = webp.get("source", entry.get("source"))
    if source is None:
        raise file.fail(f"texture {index} has no image that can be read (PNG, JPEG or WebP); export it again")
    sampler = file.item("samplers", entry["sampler"]) if "sampler" in entry else {}
    wrap = tuple(_WRAP.get(sampler.get(key, 10497), "repeat") for key in ("wrapS", "wrapT"))
    return Texture(file.image(source), wrap, _uv_matrix(change))


def _uv_matrix(change: dict[str, Any]) -> np.ndarray | None:
    """Returns the f64 (2,3) of KHR_texture_transform: uv' = A uv + b with A = rotation x scale."""
    if not change:
        return None
    angle, scale, offset = change.get("rotation", 0.0), change.get("scale", (1, 1)), change.get("offset", (0, 0))
    cosine, sine = np.cos(angle), np.sin(angle)
    turned = np.array([[cosine, sine], [-sine, cosine]]) * np.array(scale)
    return np.column_stack([turned, offset])
