"""Trained weights on disk: the file that a name means, and what it holds, as safetensors with text in its header.

Nothing is unpickled. Finding a file and reading its header need no torch.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from dpcli import __version__
from dpcli.errors import DataError, UsageError, reading
from dpcli.regular_files import why_unreadable
from dpcli.runtime.settings.stored import StoredConfig, from_json, json_value
from dpcli.runtime.settings.value_types import numbers_in
from dpcli.runtime.whole_file import write_whole

if TYPE_CHECKING:
    import torch

SUFFIX = ".safetensors"
_SPARE = 1000  # tensors for each that is stored, and numbers more than a file holds: a network makes some that it drops
Kind = TypeVar("Kind")
Network = TypeVar("Network", bound="torch.nn.Module")


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
    """Returns the file that a name means, as `locate_weights`; DataError, which says what to give, when there is none.

    shipped: the folder of the models that come with the package, None for a kind of which there are none. maker: the
    command that writes such files. A path that was found once is taken as it is, so a command can pass it on.
    """
    path = locate_weights(name, [shipped] if shipped else [])
    if path is not None:
        return path
    if said := without_best(name):
        raise DataError(f"{option} {name}: {said}; run its `{maker}` again to continue it")
    what = why_unreadable(name) or ("holds no trained model" if Path(name).is_dir() else "no such file")
    ours = ", ".join(shipped_models(shipped)) if shipped else ""
    raise DataError(
        f"{option} {name}: {what}; give a .safetensors file, a folder made by `{maker}`"
        f" or a shipped model ({ours or 'none in this installation'})"
    )


def without_best(folder: str | Path) -> str:
    """Returns what to say of the folder of a training that has written no `best.safetensors`; "" for anything else."""
    if not Path(folder, "config.json").is_file() or Path(folder, f"best{SUFFIX}").is_file():
        return ""
    last = Path(folder, f"last{SUFFIX}")
    now = f"; {last} has the weights of its last epoch" if last.is_file() else ""
    return f"this training has no best{SUFFIX} yet{now}"


def save_weights(path: Path, tensors: dict[str, torch.Tensor], header: dict[str, str]) -> None:
    """Writes weights whole or not at all. header: text by name; `format` tells readers what it is.

    Raises DataError when they can't be written, DiskFull where the disk is full.
    """
    from safetensors.torch import save

    whole = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    # not the library's own writing: it leaves a file of another name when it is killed, and has errors of its own
    write_whole(path, _with_sorted_header(save(whole, {"version": __version__, **header})))


def _with_sorted_header(content: bytes) -> bytes:
    """Makes equal weights and texts equal bytes: the library writes the texts in another order each time."""
    length, header = int.from_bytes(content[:8], "little"), _header(content)
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    return b"".join([content[:8], text.ljust(length), content[8 + length :]]) if len(text) <= length else content


def _header(content: bytes) -> dict[str, Any]:
    """Returns the header of a file that the library has accepted: its length, 8 bytes, and JSON, perhaps with spaces behind it."""
    return json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])


def network_header(file_format: str, config: StoredConfig, notes: dict[str, Any]) -> dict[str, str]:
    """Returns the header of a network's weights file: its configuration, and notes, a small JSON object."""
    return {"format": file_format, "config": config.to_json(), "notes": json.dumps(notes, sort_keys=True)}


def load_network(
    path: Path, expected_format: str, maker: str, config: type[Kind], make: Callable[[Kind], Network]
) -> tuple[Network, dict[str, Any]]:
    """Returns the network of a weights file with a `network_header`, in eval mode, and its notes.

    make: builds it of its configuration. Raises DataError as `load_weights` and `fill_network`, and for a damaged header.
    """
    tensors, header = load_weights(path, expected_format, maker)
    sizes, notes = header_settings(path, header, config), header_value(path, header, "notes", dict)
    return fill_network(lambda: make(sizes), tensors, path), notes


def load_weights(path: Path, expected_format: str, maker: str) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """Returns tensors and header of a weights file.

    Raises DataError when the file is not whole, is not of the expected format (made by `maker`), or holds NaN.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    with reading(path):
        try:  # not the library's own opening: it takes no path that isn't UTF-8, and in older versions shares maps
            content = path.read_bytes()
            tensors = load(content)
            header = _header(content).get("__metadata__") or {}
        except (SafetensorError, OSError) as error:
            raise DataError(f"{path}: not a complete safetensors file ({error})") from None
        whole = all(value.isfinite().all() for value in tensors.values())
    if header.get("format") != expected_format:
        raise DataError(f"{path}: format {header.get('format')!r}, expected {expected_format!r}, written by `{maker}`")
    if not whole:
        raise DataError(f"{path}: holds NaN or infinite weights; train again or use another checkpoint")
    return tensors, header


def fill_network(make: Callable[[], Network], tensors: dict[str, torch.Tensor], path: Path) -> Network:
    """Returns the network that `make` builds with the tensors of a file in it, in eval mode and in the network's precision.

    Raises DataError when names, shapes or types differ, and, before much memory is asked for, when the configuration that
    `make` follows claims more weights than the file can hold.
    """
    with reading(path), _plausible_sizes(path, tensors):
        try:
            network = make()
        except UsageError as error:
            raise DataError(f"{path}: the configuration's {error}") from None
    own = network.state_dict()
    for name in [name for name in own if name in tensors]:
        if own[name].is_floating_point() != tensors[name].is_floating_point() or tensors[name].is_complex():
            raise DataError(f"{path}: {name} is of {tensors[name].dtype}, expected {own[name].dtype}")
    try:
        network.load_state_dict(tensors)
    except RuntimeError as error:
        raise DataError(f"{path}: weights don't fit the configuration: {str(error).splitlines()[1].strip()}") from None
    return network.eval()


@contextmanager
def _plausible_sizes(path: Path, tensors: dict[str, torch.Tensor]) -> Iterator[None]:
    """Raises DataError in the block where torch is asked for more, or larger, tensors than a network of these tensors has."""
    import torch
    from torch.overrides import TorchFunctionMode

    makers = {torch.empty, torch.zeros, torch.ones, torch.full, torch.rand, torch.randn, torch.linspace, torch.arange}
    held, left = sum(value.numel() for value in tensors.values()), _SPARE * (1 + len(tensors))

    class Plausible(TorchFunctionMode):
        """Looks at each size before the tensor is made."""

        def __torch_function__(self, function, types, arguments=(), named=None):
            nonlocal left
            if function in makers:
                left -= 1
                claimed = prod(abs(number) for number in numbers_in(arguments) if isinstance(number, int) and number)
                if claimed > held + _SPARE or left < 0:
                    of = f"a layer of {claimed}" if left >= 0 else "countless layers of"
                    raise DataError(
                        f"{path}: the configuration claims {of} weights, the file holds {held}; copy it again"
                    )
            return function(*arguments, **(named or {}))

    with Plausible():
        yield


def header_value(path: Path, header: dict[str, str], key: str, kind: type[Kind]) -> Kind:
    """Returns the JSON value of this kind (dict, list) in a weights file's header. Raises DataError that names the file."""
    with _named(path):
        return json_value(_entry(header, key), kind, key)


def header_settings(path: Path, header: dict[str, str], cls: type[Kind]) -> Kind:
    """Returns the configuration in a weights file's header. Raises DataError, which names the file, as `from_json`."""
    with _named(path):
        return from_json(cls, _entry(header, "config"))


def _entry(header: dict[str, str], key: str) -> str:
    if key not in header:
        raise DataError(f"its header lacks {key}")
    return header[key]


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Puts the file's name before a DataError of the block, and what to do behind it."""
    try:
        yield
    except DataError as error:
        raise DataError(f"{path}: {error}; copy it again, or make it again") from None


def weights_summary(path: Path) -> dict[str, Any]:
    """Returns format, version, bytes, how many numbers of which types, model card, and the rest of the header, as values for JSON.

    What is JSON in the header (configuration, class names, notes) is unpacked. Raises DataError when the file is not whole.
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
