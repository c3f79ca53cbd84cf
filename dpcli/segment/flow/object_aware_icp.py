"""Object-aware ICP (OGC, Song and Yang 2022): flow refined part by part, between points of the same part only."""

from __future__ import annotations

import torch
from torch import Tensor

from dpcli.ops import rigid_flow, weighted_kabsch
from dpcli.ops.backend import chosen_backend, run_in_threads
from dpcli.segment.network.slot_matching import match_slots, permute_slots

_TEMPERATURE = 0.01  # diameters


@torch.no_grad()
def object_aware_icp(
    points1: Tensor,  # [B, N, 3]
    points2: Tensor,  # [B, M, 3]
    mask1: Tensor,  # [B, N, S]
    mask2: Tensor,  # [B, M, S]
    flow: Tensor,  # [B, N, 3]
    iterations: int = 20,
    order: Tensor | None = None,  # [B, S]
) -> tuple[Tensor, Tensor, Tensor]:  # [B, N, 3], [B, S, 3, 3], [B, S, 3]
    """Returns refined flow (B,N,3) and the motions (B,S,3,3), (B,S,3) of frame 1's slots, from a first flow.

    Frame 2's slots are matched once (`order`: `match_slots`, if it is known already). In each iteration point i moved
    by its flow corresponds to points n with weights softmax(-|p_i + f_i - q_n| / temperature) times the probability of
    being in the same part, sum_s m1_is m2_ns; then each slot takes its weighted Kabsch motion, and the flow is their
    blend. A point whose part has no point in frame 2 keeps its correspondence of before. The temperature is 0.01
    diameters. Memory: (B,N,M). No iterations: the weighted Kabsch of the first flow. Backends: a numba kernel on CPU in
    float32, else torch; equal up to rounding.
    """
    order = match_slots(points1, flow, mask1, points2, mask2) if order is None else order
    same_part = (mask1 @ permute_slots(mask2, order).mT).log_()  # [B, N, M]
    lost = same_part.amax(-1, keepdim=True) == -torch.inf
    same_part.masked_fill_(lost, 0.0)
    for _ in range(iterations):
        flow = torch.where(lost, flow, soft_match(points1 + flow, points2, same_part, _TEMPERATURE) - points1)
        rotation, translation = weighted_kabsch(points1, points1 + flow, mask1)
        flow = rigid_flow(points1, mask1, rotation, translation)
    if iterations == 0:
        rotation, translation = weighted_kabsch(points1, points1 + flow, mask1)
        flow = rigid_flow(points1, mask1, rotation, translation)
    return flow, rotation, translation


_ROW_NS = 2.0  # measured, per pair of points


def soft_match(moved: Tensor, points: Tensor, bias: Tensor, temperature: float) -> Tensor:
    """Returns the mean (B,N,3) of points (B,M,3), weighted by softmax of bias - distance / temperature.

    bias (B,N,M) may be -inf, but not in a whole row; distances are to moved (B,N,3). Carries no gradient.
    """
    fast = chosen_backend(moved.device) == "numba" and moved.dtype == points.dtype == bias.dtype == torch.float32
    if not fast or not points.shape[1]:
        return soft_match_reference(moved, points, bias, temperature)
    from dpcli.segment.flow.soft_match_kernel import soft_match_kernel

    out = torch.empty_like(moved, memory_format=torch.contiguous_format)
    columns = torch.nn.functional.pad(points.mT, (0, -points.shape[1] % 8))  # the kernel takes eight at a time
    arrays = [x.detach().contiguous().numpy() for x in (moved, columns, bias)]
    rows = moved.shape[0] * moved.shape[1]
    run_in_threads(soft_match_kernel, (*arrays, temperature, out.numpy()), rows, _ROW_NS * points.shape[1])
    return out


def soft_match_reference(moved: Tensor, points: Tensor, bias: Tensor, temperature: float) -> Tensor:
    """Returns what `soft_match` does, from the same arguments, by torch alone; equal up to rounding."""
    logits = torch.cdist(moved, points, compute_mode="donot_use_mm_for_euclid_dist")
    return logits.div_(-temperature).add_(bias).softmax(-1) @ points
