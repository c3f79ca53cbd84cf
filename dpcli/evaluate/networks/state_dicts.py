"""Reading published weights: plain state dicts only, nothing else is unpickled."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dpcli.errors import DataError, first_line
from dpcli.runtime.torch_files import load_plain

if TYPE_CHECKING:
    import torch


def load_tensors(path: Path) -> dict[str, torch.Tensor]:
    """Returns the tensors of a .safetensors, .pth, .pt or .bin file by name, on the CPU; nothing else is unpickled.

    A training checkpoint's `state_dict` is taken, and the prefix `module.` of parallel training dropped.
    Raises DataError for anything else, and for weights that are not finite.
    """
    state = _tensors(_read(path))
    if state is None:
        raise DataError(f"{path}: not a plain state dict; expected tensors by name")
    bad = next((name for name, value in state.items() if not value.isfinite().all()), None)
    if bad is not None:
        raise DataError(f"{path}: NaN or infinite values in {bad}; fetch it again")
    return state


def _read(path: Path) -> Any:
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about old formats, which published files have
            return load_plain(path)
    except DataError:
        raise
    except Exception as error:  # safetensors and torch each have their own
        raise DataError(f"{path}: not a plain state dict, or not whole ({first_line(error)[:150]})") from None


def _tensors(found: Any) -> dict[str, torch.Tensor] | None:
    import torch

    if isinstance(found, dict) and isinstance(found.get("state_dict"), dict):
        found = found["state_dict"]
    if not isinstance(found, dict) or not found:
        return None
    if not all(isinstance(k, str) and isinstance(v, torch.Tensor) for k, v in found.items()):
        return None
    return {name.removeprefix("module."): value for name, value in found.items()}


def fill_module(module: torch.nn.Module, state: dict[str, torch.Tensor], path: Path) -> None:
    """Puts `state` into `module`; names that it doesn't have are left alone (a classifier's last layers, say).

    Raises DataError when one of its own is missing, or has another shape. Batch norm's step counters may be missing.
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
