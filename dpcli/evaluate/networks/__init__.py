"""This folder holds published networks that judge pictures and videos, in plain torch: no torchvision, no download."""

from __future__ import annotations

from contextlib import AbstractContextManager


def full_precision() -> AbstractContextManager:
    """Returns a context in which convolutions are float32 on a GPU too (torch takes TF32, of three digits) and repeatable."""
    import torch

    return torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False)
