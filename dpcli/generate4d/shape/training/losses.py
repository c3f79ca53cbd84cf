"""The losses of a shape network: errors of layers and of their differences, angles and length of the whole."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from dpcli.generate4d.shape.network import Encoded, ShapeNetwork, tilted_plane
from dpcli.generate4d.shape.training.rounds import Batch

_RIDGE = 0.005  # squared sides of the picture: a narrow object has no angle to speak of
_WEIGHTS = (2.0, 1.0, 0.5, 0.5)  # of the layers: all that is shown from a side hangs on the front


def object_angles(depth: Tensor) -> Tensor:
    """Returns the angles (B,2), radians, of the plane through the middle of true layers (B,4,S,S), by least squares."""
    last = torch.where(depth[:, 3].isnan(), depth[:, 1], depth[:, 3])
    middle = (depth[:, 0] + last) / 2
    mask = (~middle.isnan()).float()
    middle = middle.nan_to_num()
    total = mask.sum((1, 2)).clamp(min=1)
    place = (torch.arange(depth.shape[-1], device=depth.device) + 0.5) / depth.shape[-1] - 0.5
    grid = torch.stack([place.expand_as(middle[0]), place[:, None].expand_as(middle[0])])

    def mean(values: Tensor) -> Tensor:
        return (values * mask[:, None]).sum((2, 3)) / total[:, None]

    offset = grid - mean(grid.expand(len(depth), -1, -1, -1))[:, :, None, None]
    variance = mean(offset.square()) + _RIDGE
    across = mean(offset[:, :1] * offset[:, 1:])[:, 0]
    toward = mean(offset * middle[:, None])
    determinant = variance[:, 0] * variance[:, 1] - across.square()
    slope = torch.stack(
        [variance[:, 1] * toward[:, 0] - across * toward[:, 1], variance[:, 0] * toward[:, 1] - across * toward[:, 0]],
        1,
    )
    return (slope / determinant[:, None]).atan()


def object_length(batch: Batch, angles: Tensor) -> Tensor:
    """Returns the logarithm (B) of how long objects are along the line of sight, beside their inflation.

    It compares standard deviations of fronts and backs, once the plane of the angles (B,2) is taken out.
    """
    depth = batch.depth
    last = torch.where(depth[:, 3].isnan(), depth[:, 1], depth[:, 3])
    ends = torch.stack([depth[:, 0], last], 1) - tilted_plane(angles, depth.shape[-1])
    own = ends.flatten(1)
    middle = own.nanmean(1, keepdim=True)
    inflated = torch.where(depth[:, 0].isnan(), torch.nan, batch.pictures[:, 4]).flatten(1)
    ratio = (own - middle).square().nanmean(1) / inflated.square().nanmean(1)
    return (0.5 * ratio.clamp(min=1e-6).log()).nan_to_num()


def depth_error(depth: Tensor, truth: Tensor) -> Tensor:
    """Returns the mean error (B) of the layers that exist, weighted by layer, in sides of the picture."""
    weight = torch.tensor(_WEIGHTS, device=depth.device)[None, :, None, None] * ~truth.isnan()
    return ((depth - truth.nan_to_num()).abs() * weight).sum((1, 2, 3)) / weight.sum((1, 2, 3)).clamp(min=1)


def difference_error(depth: Tensor, truth: Tensor) -> Tensor:
    """Returns the mean error of the differences of neighboring pixels of both first layers (B,L,H,W), at most 0.1 each."""
    total, count = depth.new_zeros(()), depth.new_zeros(())
    for axis in (2, 3):
        own, true = (torch.diff(x[:, :2], dim=axis) for x in (depth, truth))
        there = ~true.isnan()
        total = total + ((own - true.nan_to_num()).abs().clamp(max=0.1) * there).sum()
        count = count + there.sum()
    return total / count.clamp(min=1)


def shape_loss(model: ShapeNetwork, batch: Batch, guessed: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """Returns the loss and its parts. guessed: bool (D), which of the first D pictures are decoded at the network's own
    angles and length; the others at the true ones. Of the pictures behind them only these are learned.
    """
    encoded, count = model.encode(batch.pictures), len(guessed)
    truth = object_angles(batch.depth)
    angles = -(model.angle_targets(truth) * encoded.angles.log_softmax(-1)).sum(-1).mean()
    length = object_length(batch, truth)
    lengths = (
        -(model.length_targets(length) * encoded.lengths.log_softmax(-1)).sum(-1).mean() if model.config.lengths else 0
    )
    own = model.mean_angles(encoded.angles.detach()), model.mean_length(encoded.lengths.detach())
    encoded = Encoded([level[:count] for level in encoded.levels], *(part[:count] for part in encoded[1:]))
    batch = Batch(batch.pictures[:count], batch.depth[:count])
    chosen = torch.where(guessed[:, None], own[0][:count], truth[:count])
    depth, second = model.decode(encoded, batch.pictures, chosen, torch.where(guessed, own[1][:count], length[:count]))
    error = depth_error(depth, batch.depth)
    there = ~batch.depth[:, 0].isnan()
    presence = functional.binary_cross_entropy_with_logits(second[there], (~batch.depth[:, 2].isnan()).float()[there])
    smooth = difference_error(depth, batch.depth)
    loss = 10 * error.mean() + 5 * smooth + 0.3 * presence + angles + lengths
    return loss, {"depth": error.detach().mean(), "angles": angles.detach(), "second": presence.detach()}
