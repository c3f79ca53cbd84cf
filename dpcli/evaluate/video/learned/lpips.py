"""LPIPS of videos: frame by frame, by the network of `networks/lpips.py`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dpcli.evaluate.video.learned.base import PerFrameMetric
from dpcli.evaluate.video.protocol import Networks


class LpipsMetric(PerFrameMetric):
    """Measures LPIPS (Zhang et al. 2018) between each frame and its truth."""

    name = "lpips"

    def __init__(self, networks: Networks, folder: Path, device: str) -> None:
        super().__init__()
        from dpcli.evaluate.networks.lpips import Lpips

        self._network, self._networks, self._device = Lpips.load(networks.lpips, folder).to(device), networks, device

    def measure(self, predicted: np.ndarray, truth: np.ndarray) -> float:
        """Returns LPIPS of one frame f32 (3,H,W) in 0..1; DataError for a picture too small for the network."""
        import torch

        pair = (torch.from_numpy(np.ascontiguousarray(p))[None].to(self._device) for p in (predicted, truth))
        return float(self._network.distance(*pair, range01_mistake=self._networks.lpips_range01)[0])

    def choices(self) -> dict[str, Any]:
        given = "0..1, as DisCo gives them by mistake" if self._networks.lpips_range01 else "-1..1"
        return {"network": f"{self._networks.lpips}, v0.1", "colors": given}
