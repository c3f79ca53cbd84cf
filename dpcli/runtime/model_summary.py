"""What a file of trained weights says of itself, without loading them: `dpc info` on a model."""

from __future__ import annotations

import json
from math import prod
from pathlib import Path
from typing import Any

from dpcli.errors import DataError

_PACKAGE = Path(__file__).parents[1]
_SUFFIX = ".safetensors"


def find_model_file(name: str) -> Path | None:
    """The weights that a name means: such a file, `best.safetensors` of a training folder, or a shipped model; else None."""
    path = Path(name)
    if path.is_dir():
        best = path / f"best{_SUFFIX}"
        return best if best.is_file() else None
    if path.exists():
        return path if path.suffix == _SUFFIX else None
    shipped = (folder / f"{name}{_SUFFIX}" for folder in sorted(_PACKAGE.glob("*/weights")))
    return next((one for one in shipped if one.is_file()), None) if name == path.name else None


def model_summary(path: Path) -> dict[str, Any]:
    """Format, number of weights, configuration, class names, notes and model card, as plain values for JSON.

    The keys of the header stand for themselves, JSON in them unpacked; DataError when the file is not whole.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "np") as file:
            header = file.metadata() or {}
            slices = [file.get_slice(key) for key in file.keys()]
            sizes = [prod(one.get_shape()) for one in slices]
            types = sorted({one.get_dtype() for one in slices})
    except (SafetensorError, OSError) as error:
        raise DataError(f"{path}: not a complete safetensors file ({error})") from None
    card = path.with_suffix(".md")
    return {
        "kind": "model", "format": header.pop("format", None), "version": header.pop("version", None),
        "bytes": path.stat().st_size, "weights": sum(sizes), "tensors": len(sizes), "types": types,
        "card": str(card) if card.is_file() else None,
        **{key: _plain(text) for key, text in sorted(header.items())},
    }  # fmt: skip


def _plain(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text
