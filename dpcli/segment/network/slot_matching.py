"""The match of one frame's slots with another's: nearest points, overlap, Hungarian assignment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from dpcli.ops import gather_points, knn


def hungarian_assignment(score: Tensor) -> Tensor:
    """Returns the optimal assignment, row by row, of score (B,S,G), maximized (Kuhn 1955): columns (B,S) i64.

    With fewer columns than rows, rows left over get -1. A score that is not finite counts as worst. Ties as scipy
    decides.

    >>> hungarian_assignment(torch.tensor([[[0.9, 0.8], [0.7, 0.1]]])).tolist()  # 0.8 + 0.7 beats 0.9 + 0.1
    [[1, 0]]
    """
    from scipy.optimize import linear_sum_assignment

    values = np.nan_to_num(score.detach().cpu().numpy().astype(np.float64), nan=-1e9, posinf=1e9, neginf=-1e9)
    columns = np.full(values.shape[:2], -1, np.int64)
    for item, matrix in zip(columns, values):
        row, column = linear_sum_assignment(matrix, maximize=True)
        item[row] = column
    return torch.from_numpy(columns).to(score.device)


def soft_iou(mask1: Tensor, mask2: Tensor) -> Tensor:
    """Returns the intersection over union of every pair of slots: (B,N,S), (B,N,G) -> (B,S,G); 0 for two empty slots.

    For soft masks the intersection is the sum of products, so a slot's overlap with itself may be below 1.
    """
    both = mask1.mT @ mask2
    either = mask1.sum(1)[:, :, None] + mask2.sum(1)[:, None, :] - both
    return both / either.clamp(min=1e-10)


def carry_mask(points1: Tensor, flow: Tensor, mask1: Tensor, points2: Tensor) -> Tensor:
    """Returns frame 1's mask on frame 2: each of points2 (B,M,3) takes the row of the nearest point moved by its flow.

    points1 (B,N,3), flow (B,N,3), mask1 (B,N,S) -> (B,M,S).
    """
    _, nearest = knn(points2, points1 + flow, 1)
    return gather_points(mask1, nearest[..., 0])


def match_slots(
    points1: Tensor,  # [B, N, 3]
    flow: Tensor,  # [B, N, 3]
    mask1: Tensor,  # [B, N, S]
    points2: Tensor,  # [B, M, 3]
    mask2: Tensor,  # [B, M, S]
) -> Tensor:  # [B, S]
    """Returns the order (B,S) i64 of frame 2's slots that agrees with frame 1's.

    mask2[b][:, order[b]] is to be compared with mask1[b]. Frame 1's mask is carried along the flow, both are made hard
    (ties to the lowest slot), and the assignment maximizes the sum of IoU (Hungarian method), as OGC (Song and Yang
    2022) does. Carries no gradient.

    Two points whose parts have changed their numbers:

    >>> points, still = torch.tensor([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]]), torch.zeros(1, 2, 3)
    >>> match_slots(points, still, torch.eye(2)[None], points, torch.eye(2)[None, :, [1, 0]]).tolist()
    [[1, 0]]
    """
    carried = carry_mask(points1, flow, mask1.detach(), points2)
    return hungarian_assignment(soft_iou(one_hot(carried), one_hot(mask2)))


def permute_slots(mask: Tensor, order: Tensor) -> Tensor:
    """Returns mask (B,N,S) with its slots in the order (B,S): out[b,n,s] = mask[b,n,order[b,s]]; differentiable."""
    return mask.gather(2, order[:, None, :].expand(-1, mask.shape[1], -1))


def one_hot(mask: Tensor) -> Tensor:
    """Returns 1 at the largest entry of each row of (...,S), 0 elsewhere; ties to the lowest index."""
    return torch.zeros_like(mask).scatter_(-1, mask.argmax(-1, keepdim=True), 1.0)


def match_slots_through_frames(points: Sequence[Tensor], flows: Sequence[Tensor], masks: Sequence[Tensor]) -> Tensor:
    """Returns orders (T,S) i64 that give every frame frame 0's slots: masks[t][:, orders[t]].

    points: T clouds (N_t,3); flows: T - 1 or more, flows[t] (N_t,3) leads from frame t to t + 1; masks: T of (N_t,S).
    Frames are matched one to the next by soft IoU of the mask carried along the flow, and the orders are chained.
    """
    slots = masks[0].shape[1]
    orders = [torch.arange(slots, device=masks[0].device)]
    for t in range(1, len(points)):
        before = masks[t - 1][:, orders[-1]]
        carried = carry_mask(points[t - 1][None], flows[t - 1][None], before[None], points[t][None])
        orders.append(hungarian_assignment(soft_iou(carried, masks[t][None]))[0])
    return torch.stack(orders)
