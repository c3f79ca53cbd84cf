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
    """A block whose matrix products are made in bfloat16; nothing changes where `on` is False."""
    return torch.autocast(device.type, REDUCED, enabled=on)


def is_reduced(tensor: Tensor) -> bool:
    """Whether products of this tensor's device are made in bfloat16 here."""
    return torch.is_autocast_enabled(tensor.device.type)


def full_precision(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function in float32, whatever block it is called in: positions in bfloat16 are off by half a hundredth.

    Looks at positional arguments only: the first tensor among them says the device.
    """

    @functools.wraps(function)
    def run(*arguments: Any) -> Any:
        device = next(a.device.type for a in arguments if isinstance(a, Tensor))
        if not torch.is_autocast_enabled(device):
            return function(*arguments)
        with torch.autocast(device, enabled=False):
            return function(*(a.float() if isinstance(a, Tensor) and a.is_floating_point() else a for a in arguments))

    return run


def wanted(amp: bool | None, device: torch.device) -> bool:
    """What --amp/--no-amp mean: without either, mixed precision on CUDA and none on a CPU, which it slows down."""
    return device.type == "cuda" if amp is None else amp
