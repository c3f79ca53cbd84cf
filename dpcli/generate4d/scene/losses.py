"""The losses of a fit on pictures, silhouettes and shape; those that find parts are in `identification.py`."""

from __future__ import annotations

import torch
from torch import Tensor

from dpcli.ops.gather import gather_points
from dpcli.ops.rotations import nearest_rotation


def picture_loss(
    rendered: Tensor,  # [C, H, W, 3] on the background
    alpha: Tensor,  # [C, H, W, 1]
    target: Tensor,  # [C, H, W, 4] color times alpha, alpha
    background: Tensor,  # [C, 3]
    foreground: float,
) -> Tensor:
    """Returns the reconstruction loss (C.8 to C.10), mean squared errors.

    They are that of colors on a background plus `foreground` times that of the silhouette (the foreground loss).
    """
    truth = target[..., :3] + (1 - target[..., 3:]) * background[:, None, None]
    return (rendered - truth).square().mean() + foreground * (alpha - target[..., 3:]).square().mean()


def arap_loss(
    rest: Tensor,  # [N, 3]
    moved: Tensor,  # [B, N, 3]
    neighbors: Tensor,  # [N, H]
) -> Tensor:
    """Returns the as-rigid-as-possible energy (Sorkine and Alexa 2007): how far edges to neighbors are from one rotation.

    The best rotation of each point is found without gradient. A row's own index, where neighbors lack, adds nothing.
    """
    before = (rest[neighbors] - rest[:, None]).detach()  # [N, H, 3]
    after = gather_points(moved, neighbors.expand(len(moved), -1, -1)) - moved[:, :, None]  # [B, N, H, 3]
    with torch.no_grad():
        covariance = torch.einsum("bnhi,nhj->bnij", after, before)
        rotation = nearest_rotation(covariance)
    return (after - torch.einsum("bnij,nhj->bnhi", rotation, before)).square().sum(-1).mean()


def thickness_loss(moved: Tensor, anchor: Tensor, view_axis: Tensor) -> Tensor:  # [B, N, 3], [N, 3], [3]
    """Returns the mean squared drift along the line of sight (unit vector) from where each Gaussian should stay.

    Moved positions count, not canonical ones: a motion of all frames hides there as well, and away from the camera
    everything looks smaller.
    """
    return ((moved - anchor) @ view_axis).square().mean()
