"""Mixed precision: matrix products in bfloat16 inside the network, all that decides about geometry in float32."""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import torch
from torch import Tensor

REDUCED = torch.bfloat16  # the exponents of float32, so that no loss scaling is needed


def reduced_products(device: torch.device, on: bool) -> AbstractContextManager:
    """Returns a context whose matrix products are made in bfloat16; nothing changes where `on` is False."""
    return torch.autocast(device.type, REDUCED, enabled=on)


def is_reduced(tensor: Tensor) -> bool:
    """Returns whether products of this tensor's device are made in bfloat16 here."""
    return torch.is_autocast_enabled(tensor.device.type)


def full_precision(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns the function made to compute in float32 in any context: positions in bfloat16 are off by half a hundredth.

    The first tensor among the positional arguments says the device.
    """

    @functools.wraps(function)
    def run(*arguments: Any, **named: Any) -> Any:
        device = next(a.device.type for a in arguments if isinstance(a, Tensor))
        if not torch.is_autocast_enabled(device):
            return function(*arguments, **named)
        with torch.autocast(device, enabled=False):
            return function(*map(_widened, arguments), **{key: _widened(value) for key, value in named.items()})

    return run


def _widened(value: Any) -> Any:
    return value.float() if isinstance(value, Tensor) and value.is_floating_point() else value


def wanted(amp: bool | None, device: torch.device) -> bool:
    """Returns what the setting `amp` means here; None: mixed precision on a GPU that multiplies in bfloat16, none elsewhere.

    A CPU would be slowed down by it, and so would GPUs before Ampere, where torch emulates bfloat16.
    """
    if amp is not None:
        return amp
    return device.type == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)
