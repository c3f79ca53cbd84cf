"""The segmenter that explains all frames of a sequence by one set of rigid bodies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dpcli.runtime.progress import log
from dpcli.segment.multibody.explanation import Explanation
from dpcli.segment.multibody.frames import relative_motion
from dpcli.segment.multibody.search import explain_sequence
from dpcli.segment.multibody.settings import MultibodySettings
from dpcli.segment.multibody.tracks import follow_tracks, parts_of_tracks, undo_exchanges
from dpcli.segment.segmenters import Segmenter

_TEMPERATURE = 0.2  # of masks, in costs of a point
_EXCHANGES = 2  # times that exchanges of tracks are undone, since parts found without them show more of them
_LEAST_TRUST = 0.01  # of a body that some frame doesn't show: above 0, since the likeliest body of a mask is the part
Motions = dict[tuple[int, int], tuple[Tensor, Tensor]]  # (t, u) -> motions (S,3,3), (S,3) of all parts


@dataclass(frozen=True)
class MultibodySegmenter(Segmenter):
    """Takes the bodies of one explanation of all frames as masks; their motions come with them.

    by_tracks: whether the identities of points are used where a sequence has them.
    """

    settings: MultibodySettings
    by_tracks: bool = True

    @property
    def slots(self) -> int:
        """Returns the most bodies of a sequence."""
        return self.settings.max_bodies

    def explain(
        self,
        frames: list[Tensor],
        pairs: list[tuple[int, int]],
        tracks: list[np.ndarray] | None = None,
        origin: tuple[float, float, float] = (0, 0, 0),
        threads: int = 1,
        name: str = "",
    ) -> tuple[list[Tensor], Motions]:
        """Returns a mask (N_t,S) f32 for each frame (N_t,3), and the motions of all parts for the pairs of frames.

        Frames have 9 points or more and the sequence a diameter of about 1. Slots without a body stand still. tracks:
        the identity i64 (N_t) of each point, where it is known. origin: of the coordinates in which the frames were recorded.
        threads: of the search. name: of the sequence, for a warning where tracks exchange their identities.
        """
        if len(frames) == 1:
            return [torch.eye(self.slots)[:1].repeat(len(frames[0]), 1)], {}
        if tracks is not None:
            return self._by_tracks([frame.numpy() for frame in frames], tracks, pairs, name)
        found = explain_sequence([frame.numpy() for frame in frames], self.settings, origin, threads)
        sizes = [len(frame) for frame in frames]
        masks = list(torch.from_numpy(masks_of(found, sizes, self.slots)).split(sizes))
        return masks, {pair: self._motions(found, *pair) for pair in pairs}

    def _by_tracks(
        self, clouds: list[np.ndarray], identities: list[np.ndarray], pairs: list[tuple[int, int]], name: str
    ) -> tuple[list[Tensor], Motions]:
        """Returns masks, of which each point has one alone, and motions of parts whose points are followed."""
        tracks = follow_tracks(clouds, identities)
        part, motions, exchanged = parts_of_tracks(tracks, self.settings), {}, 0
        for _ in range(_EXCHANGES):
            index, undone = undo_exchanges(tracks, part)
            if not undone:
                break
            tracks = follow_tracks(clouds, index)
            part, exchanged = parts_of_tracks(tracks, self.settings), exchanged + undone
        if exchanged:
            log.warn(
                f"{name}: tracks seem to exchange their identities: {exchanged} of {sum(map(len, clouds))} points were taken"
                " for those of the tracks at whose places they are"
            )
        for t, u in pairs:
            motion = np.tile(np.eye(3, 4), (self.slots, 1, 1))
            for k in range(part.max() + 1):
                motion[k] = tracks.motion(part == k, t, u)
            motions[t, u] = _as_tensors(motion)
        return [torch.eye(self.slots)[part[own]] for own in tracks.index], motions

    def _motions(self, found: Explanation, t: int, u: int) -> tuple[Tensor, Tensor]:
        """Returns the motions (S,3,3), (S,3) of all slots from frame t to frame u."""
        motion = np.tile(np.eye(3, 4), (self.slots, 1, 1))
        for k, body in enumerate(found.bodies):
            motion[k] = relative_motion(body.trajectory, t, u)
        return _as_tensors(motion)


def _as_tensors(motion: np.ndarray) -> tuple[Tensor, Tensor]:
    """Returns rotations (S,3,3) and shifts (S,3) of motions (S,3,4), f32."""
    both = torch.from_numpy(np.float32(motion))
    return both[:, :, :3].contiguous(), both[:, :, 3].contiguous()


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
