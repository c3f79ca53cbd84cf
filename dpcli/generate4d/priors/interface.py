"""The interface of a prior: it judges renders from cameras that the video doesn't show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    import torch

RelativeCamera = tuple[float, float, float]  # azimuth, elevation (radians), radius, each minus the reference camera's


class Prior(Protocol):
    """Judges renders from cameras that the video doesn't show. `progress` and `generator` make it repeatable."""

    def prepare(
        self,
        reference_frames: np.ndarray,  # [T, H, W, 4]
    ) -> None:
        """Gets ready; called once before the first loss. reference_frames: the video, u8 RGBA with straight alpha."""

    def loss(
        self,
        renders: torch.Tensor,  # [B, H, W, 3]
        cameras: Sequence[RelativeCamera],  # B
        frames: Sequence[int],  # B
        progress: float,
        generator: torch.Generator,
    ) -> torch.Tensor:  # scalar
        """Returns the loss of B renders, RGB in 0..1 on white, of `frames` (indices into the video) seen by `cameras`.

        progress: share of the fit that is done, 0..1. generator: the only source of randomness.
        """
