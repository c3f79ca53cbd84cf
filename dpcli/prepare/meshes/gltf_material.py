"""Materials of a glTF file: base color, emission, their textures and transparency; reflections are left out."""

from __future__ import annotations

from typing import Any

import numpy as np

from dpcli.prepare.meshes.animated_mesh import Material, Texture
from dpcli.prepare.meshes.gltf import Gltf

_NEAREST = 9728
_DIFFUSE = ("diffuseFactor", "diffuseTexture")
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


def texture_sets(file: Gltf, index: int) -> tuple[int | None, int | None]:
    """Returns the numbers of the texture coordinates that the base color and the emission of a material use.

    None: it has no such texture.
    """
    base, _, emission = _references(file, index)
    return _texture_set(base), _texture_set(emission)


def read_material(file: Gltf, index: int) -> Material:
    """Reads the Material of this index (-1: white, seen from its front)."""
    entry = file.item("materials", index) if index != -1 else {}
    extensions = entry.get("extensions", {})
    texture, color, emission = _references(file, index)
    unlit = "KHR_materials_unlit" in extensions
    strength = float(extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0))
    if not 0 <= strength < np.inf:
        raise file.fail(f"material {index}: its emission has the strength {strength}; export the file again")
    glow = tuple(strength * value for value in _numbers(file, index, entry.get("emissiveFactor"), (0, 0, 0)))
    mode = str(entry.get("alphaMode", "OPAQUE"))
    shines = any(glow) and not unlit
    return Material(
        _numbers(file, index, color, (1, 1, 1, 1)),
        _texture(file, texture) if texture else None,
        mode.lower() if mode in ("MASK", "BLEND") else "opaque",  # other words are none, as viewers have it
        float(entry.get("alphaCutoff", 0.5)),
        unlit,
        emission=glow if shines else (0.0, 0.0, 0.0),
        emission_texture=_texture(file, emission) if emission and shines else None,
    )


def is_double_sided(file: Gltf, index: int) -> bool:
    """Returns whether a material is seen from behind, too."""
    return index != -1 and bool(file.item("materials", index).get("doubleSided", False))


def _references(file: Gltf, index: int) -> tuple[dict[str, Any] | None, Any, dict[str, Any] | None]:
    """Returns the base color's texture and factor, and the emission's texture, as the file has them."""
    entry = file.item("materials", index) if index != -1 else {}
    metal = entry.get("pbrMetallicRoughness", {})
    color, texture = metal.get("baseColorFactor"), metal.get("baseColorTexture")
    old = entry.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
    if old and not old.keys().isdisjoint(_DIFFUSE):  # older exports keep their colors there, both or neither
        color, texture = (old.get(key) for key in _DIFFUSE)
    return texture, color, entry.get("emissiveTexture")


def _texture_set(reference: dict[str, Any] | None) -> int | None:
    return None if reference is None else _change(reference).get("texCoord", reference.get("texCoord", 0))


def _change(reference: dict[str, Any]) -> dict[str, Any]:
    return reference.get("extensions", {}).get("KHR_texture_transform", {})


def _numbers(file: Gltf, index: int, values: Any, rest: tuple[int, ...]) -> tuple[float, ...]:
    try:
        found = tuple(float(np.clip(value, 0, 1)) for value in (values or rest))
    except (TypeError, ValueError):
        found = ()
    if len(found) != len(rest) or not np.isfinite(found).all():
        count = {3: "three", 4: "four"}[len(rest)]
        raise file.fail(f"material {index}: its color is not {count} numbers; export the file again")
    return found


def _texture(file: Gltf, reference: dict[str, Any]) -> Texture:
    index, change = reference["index"], _change(reference)
    entry = file.item("textures", index)
    others = [entry.get("extensions", {}).get(name, {}) for name in ("EXT_texture_webp", "EXT_texture_avif")]
    source = next((other["source"] for other in others if "source" in other), entry.get("source"))
    if source is None:
        raise file.fail(f"texture {index} has no image that can be read; export its textures as PNG or JPEG")
    sampler = file.item("samplers", entry["sampler"]) if "sampler" in entry else {}
    wrap = tuple(_WRAP.get(sampler.get(key, 10497), "repeat") for key in ("wrapS", "wrapT"))
    return Texture(file.image(source), wrap, _uv_matrix(change), sampler.get("magFilter") == _NEAREST)


def _uv_matrix(change: dict[str, Any]) -> np.ndarray | None:
    """Returns the f64 (2,3) of KHR_texture_transform: uv' = A uv + b with A = rotation x scale."""
    if not change:
        return None
    angle, scale, offset = change.get("rotation", 0.0), change.get("scale", (1, 1)), change.get("offset", (0, 0))
    cosine, sine = np.cos(angle), np.sin(angle)
    turned = np.array([[cosine, sine], [-sine, cosine]]) * np.array(scale)
    return np.column_stack([turned, offset])
