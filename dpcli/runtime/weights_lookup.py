"""Where files of trained weights lie, and what they say of themselves; nothing here loads them, so that no torch is needed."""

from __future__ import annotations

import json
from collections.abc import Iterable
from math import prod
from pathlib import Path
from typing import Any

from dpcli.errors import DataError

SUFFIX = ".safetensors"


def shipped_models(folder: Path) -> list[str]:
    """Names of the models that come with the package; each has a card `NAME.md` beside it."""
    return sorted(path.stem for path in folder.glob(f"*{SUFFIX}"))


def locate_weights(name: str, shipped: Iterable[Path]) -> Path | None:
    """The file that a name means: a path, `best.safetensors` of a training folder, or a model of the folders `shipped`."""
    path = Path(name)
    if path.is_dir():
        path = path / f"best{SUFFIX}"
    if path.is_file():
        return path
    return next((folder / f"{name}{SUFFIX}" for folder in shipped if name in shipped_models(folder)), None)


def weights_summary(path: Path) -> dict[str, Any]:
    """Format, version, bytes, how many numbers of which types, model card, and the rest of the header, as values for JSON.

    What is JSON in the header (configuration, class names, notes) is unpacked. DataError when the file is not whole.
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
        "kind": "model",
        "format": header.pop("format", None),
        "version": header.pop("version", None),
        "bytes": path.stat().st_size,
        "weights": sum(sizes),
        "tensors": len(sizes),
        "types": types,
        "card": str(card) if card.is_file() else None,
        "header": {key: _plain(text) for key, text in sorted(header.items())},
    }


def _plain(text: str) -> Any:
    """What JSON says; text that is none, or has numbers that JSON can't write again, stays text."""
    try:
        value = json.loads(text)
        json.dumps(value, allow_nan=False)
    except (ValueError, RecursionError):
        return text
    return value
