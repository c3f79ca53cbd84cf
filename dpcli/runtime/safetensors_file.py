"""Trained weights on disk: one safetensors file with text in its header. Nothing is unpickled."""

from __future__ import annotations

import json
import os
from pathlib import Path

import torch

from dpcli import __version__
from dpcli.errors import DataError, UsageError
from dpcli.path_names import utf8_path
from dpcli.runtime.weights_lookup import locate_weights, shipped_models
from dpcli.runtime.whole_file import whole_file


def save_weights(path: Path, tensors: dict[str, torch.Tensor], header: dict[str, str]) -> None:
    """Write beside the target, then rename. header: text by name; `format` tells readers what it is."""
    from safetensors.torch import save_file

    whole = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    with whole_file(path) as part:
        save_file(whole, part, {"version": __version__, **header})
        _sort_header(part)
        umask = os.umask(0)
        os.umask(umask)
        part.chmod(0o666 & ~umask)  # the library writes files that only their owner can read


def _sort_header(path: Path) -> None:
    """Equal weights and texts as equal bytes: the library writes the texts in another order each time. A file begins with
    the length of its header, 8 bytes, and the header in JSON, perhaps with spaces behind it."""
    with path.open("r+b") as file:
        length = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(length))
        header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
        text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
        if len(text) <= length:
            file.seek(8)
            file.write(text.ljust(length))


def load_weights(path: Path, expected_format: str, maker: str) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """Tensors and header. DataError when the file is not whole, of another format (made by `maker`), or holds NaN."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(utf8_path(path, "safetensors"), "pt") as file:
            header = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}
    except (SafetensorError, OSError) as error:
        raise DataError(f"{path}: not a complete safetensors file ({error})") from None
    if header.get("format") != expected_format:
        raise DataError(f"{path}: format {header.get('format')!r}, expected {expected_format!r}, written by `{maker}`")
    if not all(torch.isfinite(value).all() for value in tensors.values()):
        raise DataError(f"{path}: holds NaN or infinite weights; train again or use another checkpoint")
    return tensors, header


def load_state(model: torch.nn.Module, tensors: dict[str, torch.Tensor], path: Path) -> None:
    """Put the tensors of a file into a model, in the model's precision. DataError when names or shapes differ."""
    try:
        model.load_state_dict(tensors)
    except RuntimeError as error:
        raise DataError(f"{path}: weights don't fit the configuration: {str(error).splitlines()[1].strip()}") from None


def find_weights(name: str, shipped: Path, maker: str, option: str = "--model") -> Path:
    """A model's file: a path, `best.safetensors` of a training folder, or a shipped name. UsageError when there is none."""
    path = locate_weights(name, [shipped])
    if path is not None:
        return path
    if Path(name, "config.json").is_file():
        last = Path(name, "last.safetensors")
        now = f"{last} has the weights of its last epoch; " if last.is_file() else ""
        raise UsageError(
            f"{option} {name}: this training has no best.safetensors yet; {now}run its `{maker}` again to continue it"
        )
    raise UsageError(
        f"{option} {name}: no such file; give a .safetensors file, a folder made by `{maker}`"
        f" or a shipped model ({', '.join(shipped_models(shipped)) or 'none in this installation'})"
    )
