"""Weights of the learned metrics: which files there are, where they lie, whether they are whole, and what is in them.

Nothing here downloads (see `weights_fetch`), and nothing is unpickled.
"""

from __future__ import annotations

import hashlib
import os
import warnings
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dpcli.errors import DataError, UsageError
from dpcli.runtime.toml_file import read_toml

if TYPE_CHECKING:
    import torch

LIST = Path(__file__).with_name("weights.toml")
FOLDER_VARIABLE = "DPC_WEIGHTS"
_WHOLE = 64  # hexadecimal digits of a SHA-256
_BLOCK = 1 << 20  # bytes


@dataclass(frozen=True)
class Weights:
    """One published file of weights.

    file: path inside the weights folder. size: bytes; about = True: rounded, so not compared. sha256: the whole digest,
    its first 8 digits where only those are published (torchvision puts them in the file's name), or "" for none.
    by_hand: `url` is a page to click through, not the file. script: a TorchScript archive. beside: files it needs.
    """

    name: str
    file: str
    url: str
    size: int
    license: str
    sha256: str
    used_by: str
    note: str = ""
    about: bool = False
    by_hand: bool = False
    script: bool = False
    beside: tuple[Weights, ...] = ()

    @property
    def files(self) -> tuple[Weights, ...]:
        """This file and those beside it."""
        return (self, *self.beside)


@dataclass(frozen=True)
class Checked:
    """What `check` found. state: present, absent or damaged. digest: the file's own, "" if it wasn't computed."""

    state: str
    digest: str
    said: str


@cache
def known() -> dict[str, Weights]:
    """The weights that learned metrics can use, by name, from weights.toml."""
    return {name: _entry(name, dict(fields)) for name, fields in read_toml(LIST).items()}


def _entry(name: str, fields: dict[str, Any]) -> Weights:
    shared = {key: fields[key] for key in ("license", "used_by")}
    beside = tuple(Weights(name=name, **shared, **more) for more in fields.pop("beside", []))
    return Weights(name=name, beside=beside, **fields)


def named(name: str) -> Weights:
    """One entry of the list, by its name or its file's. UsageError for another name."""
    for weights in known().values():
        if name in (weights.name, weights.file):
            return weights
    raise UsageError(f"no weights named {name!r}; there are {', '.join(known())}")


def weights_folder(given: Path | None = None) -> Path:
    """The folder of weights: the one given, else that of DPC_WEIGHTS, else `dpc/weights` in the user's cache.

    It need not exist, unless it was given: UsageError.
    """
    if given is not None:
        if not given.is_dir():
            raise UsageError(f"--weights {given}: no such folder")
        return given
    if os.environ.get(FOLDER_VARIABLE):
        return Path(os.environ[FOLDER_VARIABLE]).expanduser()
    cache_folder = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(cache_folder) if os.path.isabs(cache_folder) else Path.home() / ".cache") / "dpc" / "weights"


def find(name: str, folder: Path) -> Path:
    """Where the weights `name` lie. DataError, one line, that says what to download and where to put it."""
    weights = named(name)
    for each in weights.files:
        if not (folder / each.file).is_file():
            raise DataError(f"{folder / each.file}: no such weights; {how_to_get(weights, each, folder)}")
    return folder / weights.file


def how_to_get(weights: Weights, missing: Weights, folder: Path) -> str:
    """What to do about a missing file, in half a line."""
    by_hand = f"download {missing.url} ({size_text(missing)}) to {folder / missing.file}"
    if weights.by_hand:
        return f"{by_hand} (from that page, by hand)"
    return f"run `dpc evaluate weights fetch {weights.name}`, or {by_hand}"


def size_text(weights: Weights) -> str:
    """`244408911` bytes -> `244 MB`; the sum with `Weights.files` is the caller's."""
    return bytes_text(weights.size, weights.about)


def bytes_text(count: int, about: bool = False) -> str:
    """Bytes in decimal units, as downloads are counted: `4.97 MB`."""
    unit, per = next(((u, p) for u, p in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)) if count >= p), ("B", 1))
    return f"{'about ' if about else ''}{count / per:.3g} {unit}"


def digest_of(path: Path) -> str:
    """SHA-256 of a file, 64 hexadecimal digits."""
    found = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            found.update(block)
    return found.hexdigest()


def check(path: Path, weights: Weights, digest: bool = True) -> Checked:
    """Compare a file with its entry: size, and (unless digest is False) as much of the SHA-256 as is published."""
    if not path.is_file():
        return Checked("absent", "", f"no file {path}")
    size = path.stat().st_size
    if not weights.about and size != weights.size:
        return Checked("damaged", "", f"{size} bytes, expected {weights.size}")
    if size == 0:
        return Checked("damaged", "", "an empty file")
    if not digest:
        return Checked("present", "", "size not published" if weights.about else "size checked")
    return _check_digest(digest_of(path), weights)


def _check_digest(found: str, weights: Weights) -> Checked:
    if not found.startswith(weights.sha256):
        expected = weights.sha256 + ("…" if len(weights.sha256) < _WHOLE else "")
        return Checked("damaged", found, f"SHA-256 {found}, expected {expected}")
    if not weights.sha256:
        return Checked("present", found, f"no published digest; SHA-256 is {found}")
    whole = len(weights.sha256) == _WHOLE
    return Checked(
        "present", found, "whole SHA-256 checked" if whole else f"first 8 digits of SHA-256 checked: {found}"
    )


def check_all(weights: Weights, folder: Path, digest: bool = True) -> Checked:
    """`check` of an entry with all files beside it: the first that isn't present speaks for all."""
    found = [check(folder / each.file, each, digest) for each in weights.files]
    return next((each for each in found if each.state != "present"), found[0])


def state_of(name: str, folder: Path) -> dict[str, torch.Tensor]:
    """State dict of the weights `name`. DataError when absent, damaged, or not a plain state dict.

    The size is compared, and the digest of a TorchScript archive, which holds code.
    """
    weights, path = named(name), find(name, folder)
    found = check(path, weights, digest=weights.script)
    if found.state != "present":
        raise DataError(f"{path}: damaged weights ({found.said}); delete it and fetch it again")
    return load_state(path, script=weights.script)


def load_state(path: Path, script: bool = False) -> dict[str, torch.Tensor]:
    """The tensors of a .safetensors, .pth, .pt or .bin file by name, on the CPU; nothing else is unpickled.

    A training checkpoint's `state_dict` is taken, and the prefix `module.` of parallel training dropped.
    script: the file is a TorchScript archive. DataError for anything else, and for weights that are not finite.
    """
    state = _tensors(_read(path, script))
    if state is None:
        raise DataError(f"{path}: not a plain state dict; expected tensors by name")
    bad = next((name for name, value in state.items() if not value.isfinite().all()), None)
    if bad is not None:
        raise DataError(f"{path}: NaN or infinite values in {bad}; fetch it again")
    return state


def _read(path: Path, script: bool) -> Any:
    import torch

    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about old formats, which published files have
            if script:
                return torch.jit.load(str(path), map_location="cpu").state_dict()
            return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # pickle, zip, safetensors and torch each have their own
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise DataError(f"{path}: not a plain state dict, or not whole ({reason[:150]})") from None


def _tensors(found: Any) -> dict[str, torch.Tensor] | None:
    import torch

    if isinstance(found, dict) and isinstance(found.get("state_dict"), dict):
        found = found["state_dict"]
    if not isinstance(found, dict) or not found:
        return None
    if not all(isinstance(k, str) and isinstance(v, torch.Tensor) for k, v in found.items()):
        return None
    return {name.removeprefix("module."): value for name, value in found.items()}


def fill(module: torch.nn.Module, state: dict[str, torch.Tensor], path: Path) -> None:
    """Put `state` into `module`; names that it doesn't have are left alone (a classifier's last layers, say).

    DataError when one of its own is missing, or has another shape. Batch norm's step counters may be missing.
    """
    taken = {}
    for name, own in module.state_dict().items():
        if name not in state and name.endswith("num_batches_tracked"):
            taken[name] = own
        elif name not in state:
            raise DataError(f"{path}: no tensor {name}; expected weights of {type(module).__name__}")
        elif state[name].shape != own.shape:
            found, expected = tuple(state[name].shape), tuple(own.shape)
            raise DataError(f"{path}: {name} has shape {found}, expected {expected}")
        else:
            taken[name] = state[name]
    module.load_state_dict(taken)
