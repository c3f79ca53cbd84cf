"""The segmenters, which divide the frames of a sequence into parts: the part network, and the classical methods."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from dpcli.runtime import provenance
from dpcli.runtime.seeds import SegmentStream, generator
from dpcli.segment.baselines.classical import classical_labels
from dpcli.segment.baselines.settings import ClassicalSettings
from dpcli.segment.network.model_file import find_model, load_model
from dpcli.segment.network.part_network import PartNetwork

Flows = dict[tuple[int, int], Tensor]  # (t, u) -> flow (N_t,3) of frame t's points toward frame u
_CHUNK = 8  # frames that the network sees at once


class Segmenter(ABC):
    """Divides the frames of a sequence into parts: one by one (`FrameSegmenter`), or all together with their motions."""

    @property
    @abstractmethod
    def slots(self) -> int:
        """Returns the number of columns of every mask."""

    def record(self) -> dict[str, Any]:
        """Returns what the provenance of a file says of the segmenter."""
        return {}


class FrameSegmenter(Segmenter):
    """Divides frames into soft masks.

    needs_flows: whether `segment` looks at flows, so that it must wait for them.
    """

    needs_flows: ClassVar[bool] = True

    @abstractmethod
    def segment(self, frames: list[Tensor], flows: Flows) -> list[Tensor]:
        """Returns a mask (N_t,S) f32 for each frame (N_t,3); rows sum to 1. flows: between pairs of the frames."""


@dataclass(frozen=True)
class NetworkSegmenter(FrameSegmenter):
    """Takes the masks of a part network; frames of equally many points are given to it together."""

    model: PartNetwork
    device: torch.device
    about: dict[str, Any] = field(default_factory=dict)
    needs_flows: ClassVar[bool] = False

    @classmethod
    def load(cls, name: str, device: torch.device, mixed: bool) -> NetworkSegmenter:
        """Returns a segmenter of the trained network `name`: a file, a training folder or a shipped name.

        mixed: whether its products are made in bfloat16. Raises UsageError when there is no such network.
        """
        path = find_model(name)
        model, notes = load_model(path)
        model.mixed = mixed
        about = {"model": notes, "weights": provenance.file_digest(path), **({"amp": True} if mixed else {})}
        return cls(model.to(device), device, about)

    @property
    def slots(self) -> int:
        return self.model.config.slots

    @torch.inference_mode()
    def segment(self, frames: list[Tensor], flows: Flows) -> list[Tensor]:
        if len({len(frame) for frame in frames}) == 1:
            chunks = torch.stack(frames).split(_CHUNK)
            return [mask.cpu() for chunk in chunks for mask in self.model(chunk.to(self.device)).mask]
        return [self.model(frame[None].to(self.device)).mask[0].cpu() for frame in frames]

    def record(self) -> dict[str, Any]:
        """Returns the network's notes and the digest of its file."""
        return self.about


@dataclass(frozen=True)
class ClassicalSegmenter(FrameSegmenter):
    """Takes the labels of a classical method as masks of zeros and ones."""

    settings: ClassicalSettings
    seed: int

    @property
    def slots(self) -> int:
        """Returns the most parts that the method may find."""
        return max(self.settings.max_parts, self.settings.parts or 0)

    def segment(self, frames: list[Tensor], flows: Flows) -> list[Tensor]:
        labels = classical_labels(
            [frame.numpy() for frame in frames],
            {pair: flow.numpy() for pair, flow in flows.items()},
            self.settings,
            rng=generator(self.seed, SegmentStream.CLASSICAL),
        )
        return [torch.nn.functional.one_hot(torch.from_numpy(np.int64(own)), self.slots).float() for own in labels]
