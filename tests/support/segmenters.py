"""A segmenter made of a function, for tests that know the answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from dpcli.segment.segmenters import Flows, FrameSegmenter


@dataclass(frozen=True)
class FunctionSegmenter(FrameSegmenter):
    """Gives the masks that `function` gives for frames and flows."""

    function: Callable[[list[Tensor], Flows], list[Tensor]]

    @property
    def slots(self) -> int:
        raise NotImplementedError("nobody writes a file of these masks")

    def segment(self, frames: list[Tensor], flows: Flows) -> list[Tensor]:
        return self.function(frames, flows)
