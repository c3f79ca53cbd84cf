"""The segmenter that explains all frames of a sequence by one set of rigid bodies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from dpcli.segment.multibody.explanation import Explanation
from dpcli.segment.multibody.frames import relative_motion
from dpcli.segment.multibody.search import explain_sequence
from dpcli.segment.multibody.settings import MultibodySettings
from dpcli.segment.segmenters import Flows, Segmenter

_TEMPERATURE = 0.2  # of masks, in costs of a point
_LEAST_TRUST = 0.01  # of a body that some frame doesn't show: above 0, since the likeliest body of a mask is the part
Motions = dict[tuple[int, int], tuple[Tensor, Tensor]]  # (t, u) -> motions (S,3,3), (S,3) of all parts


@dataclass(frozen=True)
class MultibodySegmenter(Segmenter):
    """Takes the bodies of one explanation of all frames as masks; their motions come with them.

    by_tracks: whether the identities of points are used where a sequence has them.
    """

    settings: MultibodySettings
    by_tracks: bool = True
    needs_flows: ClassVar[bool] = False

    @property
    def slots(self) -> int:
        """The most bodies of a sequence."""
        return self.settings.most_bodies

    def segment(self, frames: list[Tensor], flows: Flows) -> list[Tensor]:
        """Returns the masks of `explain` alone."""
        return self.explain(frames, [])[0]

    def explain(
        self, frames: list[Tensor], pairs: list[tuple[int, int]], tracks: list[np.ndarray] | None = None
    ) -> tuple[list[Tensor], Motions]:
        """Returns a mask (N_t,S) f32 for each frame (N_t,3), and the motions of all parts for the pairs of frames.

        Frames have 9 points or more and the sequence a diameter of about 1. Slots without a body stand still. tracks:
        the identity i64 (N_t) of each point, where it is known.
        """
        if len(frames) == 1:
            return [torch.eye(self.slots)[:1].repeat(len(frames[0]), 1)], {}
        found = explain_sequence([frame.numpy() for frame in frames], self.settings, tracks)
        sizes = [len(frame) for frame in frames]
        masks = list(torch.from_numpy(masks_of(found, sizes, self.slots)).split(sizes))
        return masks, {pair: self._motions(found, *pair) for pair in pairs}

    def _motions(self, found: Explanation, t: int, u: int) -> tuple[Tensor, Tensor]:
        """Returns the motions (S,3,3), (S,3) of all slots from frame t to frame u."""
        motion = np.tile(np.eye(3, 4, dtype=np.float32), (self.slots, 1, 1))
        for k, body in enumerate(found.bodies):
            motion[k] = relative_motion(body.trajectory, t, u)
        return torch.from_numpy(motion[:, :, :3].copy()), torch.from_numpy(motion[:, :, 3].copy())


def masks_of(found: Explanation, sizes: list[int], slots: int) -> np.ndarray:
    """Returns how likely each point is in each body, f32 (N,slots), of frames with these numbers of points.

    A body holds about the same share of every frame: it is trusted by its least share over its largest, and what is missing
    to 1 is spread over all slots.
    """
    likely = np.exp((found.field.min(1, keepdims=True) - found.field) / _TEMPERATURE)
    likely /= likely.sum(1, keepdims=True)
    label = likely.argmax(1)
    frames = np.split(label, np.cumsum(sizes)[:-1])
    shares = np.stack([np.bincount(own, minlength=len(found.bodies)) / max(len(own), 1) for own in frames])
    trust = np.maximum(shares.min(0) / np.maximum(shares.max(0), 1e-9), _LEAST_TRUST)[label, None]
    masks = np.repeat((1 - trust) / slots, slots, axis=1)
    masks[:, : len(found.bodies)] += trust * likely
    return masks.astype(np.float32)
