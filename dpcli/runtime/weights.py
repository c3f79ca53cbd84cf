"""Trained weights on disk: the file that a name means, and what it holds, as safetensors with text in its header.

Nothing is unpickled. Finding a file and reading its header need no torch.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dpcli import __version__
from dpcli.errors import DataError, UsageError
from dpcli.path_names import utf8_path
from dpcli.runtime.whole_file import whole_file

if TYPE_CHECKING:
    import torch

SUFFIX = ".safetensors"


def shipped_models(folder: Path) -> list[str]:
    """Returns the names of the models that come with the package in `folder`; each has a card `NAME.md` beside it."""
    return sorted(path.stem for path in folder.glob(f"*{SUFFIX}"))


def locate_weights(name: str | Path, shipped: Iterable[Path]) -> Path | None:
    """Returns the file that a name means, None if there is none.

    The name is a path, a training folder (its `best.safetensors`) or that of a model in one of the folders `shipped`.
    """
    path = Path(name)
    if path.is_dir():
        path = path / f"best{SUFFIX}"
    if path.is_file():
        return path
    return next((folder / f"{name}{SUFFIX}" for folder in shipped if str(name) in shipped_models(folder)), None)


def find_weights(name: str | Path, shipped: Path | None, maker: str, option: str = "--model") -> Path:
    """Returns the file that a name means, as `locate_weights`; UsageError, which says what to give, when there is none.

    shipped: the folder of the models that come with the package, None for a kind of which there are none. maker: the
    command that writes such files. A path that was found once is taken as it is, so a command can pass it on.
    """
    path = locate_weights(name, [shipped] if shipped else [])
    if path is not None:
        return path
    if Path(name, "config.json").is_file():
        last = Path(name, "last.safetensors")
        now = f"{last} has the weights of its last epoch; " if last.is_file() else ""
        raise UsageError(
            f"{option} {name}: this training has no best.safetensors yet; {now}run its `{maker}` again to continue it"
        )
    ours = ", ".join(shipped_models(shipped)) if shipped else ""
    raise UsageError(
        f"{option} {name}: no such file; give a .safetensors file, a folder made by `{maker}`"
        f" or a shipped model ({ours or 'none in this installation'})"
    )


def save_weights(path: Path, tensors: dict[str, torch.Tensor], header: dict[str, str]) -> None:
    """Writes weights whole or not at all. header: text by name; `format` tells readers what it is."""
    from safetensors.torch import save_file

    whole = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    with whole_file(path) as part:
        save_file(whole, part, {"version": __version__, **header})
        _sort_header(part)
        umask = os.umask(0)
        os.umask(umask)
        part.chmod(0o666 & ~umask)  # the library writes files that only their owner can read


def _sort_header(path: Path) -> None:
    """Makes equal weights and texts equal bytes: the library writes the texts in another order each time. A file begins with
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
    """Returns tensors and header. DataError when the file is not whole, of another format (made by `maker`), or holds NaN."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(utf8_path(path, "safetensors"), "pt") as file:
            header = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}
    except (SafetensorError, OSError) as error:
        raise DataError(f"{path}: not a complete safetensors file ({error})") from None
    if header.get("format") != expected_format:
        raise DataError(f"{path}: format {header.get('format')!r}, expected {expected_format!r}, written by `{maker}`")
    if not all(value.isfinite().all() for value in tensors.values()):
        raise DataError(f"{path}: holds NaN or infinite weights; train again or use another checkpoint")
    return tensors, header


def load_state(model: torch.nn.Module, tensors: dict[str, torch.Tensor], path: Path) -> None:
    """Puts the tensors of a file into a model, in the model's precision. DataError when names or shapes differ."""
    try:
        model.load_state_dict(tensors)
    except RuntimeError as error:
        raise DataError(f"{path}: weights don't fit the configuration: {str(error).splitlines()[1].strip()}") from None


def weights_summary(path: Path) -> dict[str, Any]:
    """Returns format, version, bytes, how many numbers of which types, model card, and the rest of the header, as values for JSON.

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
    """Returns what JSON says; text that is none, or has numbers that JSON can't write again, stays text."""
    try:
        value = json.loads(text)
        json.dumps(value, allow_nan=False)
    except (ValueError, RecursionError):
        return text
    return value
