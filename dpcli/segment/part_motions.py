"""The rigid motion of every part between two frames, from flow and masks, and the flow that follows from it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dpcli.ops import knn, weighted_kabsch
from dpcli.ops.rigid import rigid_flow
from dpcli.ops.rotations import motion_matrix
from dpcli.runtime.tuning import torch_threads
from dpcli.segment.flow.object_aware_icp import object_aware_icp
from dpcli.segment.network.slot_matching import one_hot
from dpcli.segment.segmenters import Flows

_SMALL = 1024  # points of a frame up to which one thread is enough after the network
_TOGETHER = 8  # pairs of frames whose motions are refined at once

Pairs = list[tuple[int, int]]


def threads_for(frames: list[Tensor]) -> int:
    """Returns how many of torch's threads to use: one for small frames, of whose operations two threads gain nothing."""
    return 1 if max(len(frame) for frame in frames) <= _SMALL else torch.get_num_threads()


def fit_part_motions(
    frames: list[Tensor], masks: list[Tensor], flows: Flows, pairs: Pairs, steps: int
) -> list[tuple[Tensor, Tensor]]:
    """Returns the motions (S,3,3), (S,3) of the parts for every pair of frames, refined by `steps` of object-aware ICP.

    frames: (N_t,3); masks: (N_t,S), a part in the same column of all; flows: at least of the pairs. Pairs of equally many
    points are refined together, `_TOGETHER` at a time.
    """
    motions: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}
    by_size: dict[tuple[int, int], Pairs] = {}
    for i, j in pairs:
        by_size.setdefault((len(frames[i]), len(frames[j])), []).append((i, j))
    with torch_threads(threads_for(frames)):
        for alike in by_size.values():
            for start in range(0, len(alike), _TOGETHER):
                some = alike[start : start + _TOGETHER]
                first, second = (torch.stack([frames[pair[side]] for pair in some]) for side in (0, 1))
                mask1, mask2 = (torch.stack([masks[pair[side]] for pair in some]) for side in (0, 1))
                flow = torch.stack([flows[pair] for pair in some])
                rotation, shift = _fit_pairs(first, second, mask1, mask2, flow, steps)
                motions |= {pair: (r, t) for pair, r, t in zip(some, rotation, shift)}
    return [motions[pair] for pair in pairs]


def _fit_pairs(
    first: Tensor, second: Tensor, mask1: Tensor, mask2: Tensor, flow: Tensor, steps: int
) -> tuple[Tensor, Tensor]:
    """Returns motions (B,S,3,3), (B,S,3): the flow's own, or those of object-aware ICP where they lie nearer to frame 2."""
    start = weighted_kabsch(first, first + flow, mask1)
    if steps == 0:
        return start
    same = torch.arange(mask1.shape[2]).expand(len(first), -1)
    _, rotation, shift = object_aware_icp(first, second, mask1, mask2, flow, steps, same)
    gaps = [_measure_gap(first, second, mask1, *motion) for motion in (start, (rotation, shift))]  # [B, S] each
    better = gaps[1] <= gaps[0]
    return (torch.where(better[..., None, None], rotation, start[0]), torch.where(better[..., None], shift, start[1]))


def _measure_gap(first: Tensor, second: Tensor, mask1: Tensor, rotation: Tensor, shift: Tensor) -> Tensor:
    """Returns the mean distance (B,S) of each part's own points, moved, to frame 2."""
    share = one_hot(mask1)  # [B, N, S]
    squared, _ = knn(first + rigid_flow(first, share, rotation, shift), second, 1)
    return (share * squared.sqrt()).sum(1) / share.sum(1).clamp(min=1)


def motion_in_input_units(motion: tuple[Tensor, Tensor], mask: Tensor, scale: float, center: Tensor) -> np.ndarray:
    """Returns the motions f32 (S,4,4) in the input's own coordinates; parts without points stand still.

    motion: (S,3,3), (S,3) of clouds that were centered at `center` (3) and then scaled; mask (N,S): of frame 1.
    """
    rotation, shift = motion
    used = one_hot(mask).sum(0) > 0
    own = shift / scale + center - (rotation @ center)
    return torch.where(used[:, None, None], motion_matrix(rotation, own), torch.eye(4)).numpy()


def part_flow(points: Tensor, mask: Tensor, motion: tuple[Tensor, Tensor], scale: float) -> np.ndarray:
    """Returns the flow f32 (N,3) in the input's unit of points (N,3), scaled, that follow their parts (mask (N,S))."""
    rotation, shift = motion
    return (rigid_flow(points[None], mask[None], rotation[None], shift[None])[0] / scale).numpy()
