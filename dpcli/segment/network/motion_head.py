"""The equivariant motion head: each part's rotation between two frames from its features under all rotations (B.1.3).

Features obey f2(T x, T R_a) = f1(x, R_a) for a part that moves by T. So rotation a of frame 1 looks like that rotation l
of frame 2 whose R_l is nearest to T R_a, and T = R_l r^T R_a^T with a small residual r. The release feeds its label rule
T instead of T^T and so pairs rotations that don't look alike.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from dpcli.ops.rotations import mean_rotation, normalize_quaternion, quaternion_to_matrix
from dpcli.segment.network.config import PartConfig
from dpcli.segment.network.icosahedron import GROUPS, RotationGroup


def relative_labels(rotation: Tensor, group: RotationGroup) -> tuple[Tensor, Tensor]:
    """Returns, for T (...,3,3), the anchor's label i64 (...,G) and the residual (...,G,3,3) of every rotation a of the group.

    l(a) = argmax_l trace(R_a^T T R_l); the residual is R_a^T T R_l.
    """
    anchors = group.rotations_like(rotation)
    turned = torch.einsum("gij,...ik->...gjk", anchors, rotation)  # R_a^T T
    label = torch.einsum("...gjk,lkj->...gl", turned, anchors).argmax(-1)
    return label, turned @ anchors[label]


class MotionHead(nn.Module):
    """Computes confidence (B,S,a,l) of every pair of rotations, softmax over l, and residual quaternions (B,S,a,l,4)."""

    def __init__(self, config: PartConfig) -> None:
        super().__init__()
        self.config = config
        width = config.motion_width
        self.group = GROUPS[config.group]()
        self.embed = nn.Linear(config.layers[-1][-1].channels + 3, width)
        first, *rest = config.motion_layers
        self.pair = nn.Linear(2 * width, first)  # of [frame 2, frame 1], as two halves that are added for every pair
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in zip([first, *rest], rest))
        self.confidence = nn.Linear(config.motion_layers[-1], 1)
        self.residual = nn.Linear(config.motion_layers[-1], 4)
        nn.init.normal_(self.residual.weight, std=0.01)
        with torch.no_grad():
            self.residual.bias.copy_(torch.tensor([1.0, 0, 0, 0]))  # start from no residual

    def part_features(self, features: Tensor, points: Tensor, mask: Tensor) -> Tensor:
        """Returns the part-level equivariant features (B,S,G,D) of eq. 4.3, the maximum over its points.

        features (B,P,G,C), points (B,P,3), mask (B,P,S). Coordinates are centered on the part, weighted by the mask, so
        that they depend on nothing but the part.
        """
        anchors = self.group.rotations_like(points)
        share = mask / mask.sum(1, keepdim=True).clamp(min=1e-6)
        center = torch.einsum("bps,bpi->bsi", share, points)
        centered = points - torch.einsum("bps,bsi->bpi", mask, center)
        local = torch.einsum("gij,bpi->bpgj", anchors, centered)
        hidden = torch.relu(self.embed(torch.cat([features, local.to(features.dtype)], -1)))
        slots = [(hidden * mask[:, :, s, None, None]).amax(1) for s in range(mask.shape[-1])]
        return torch.stack(slots, 1)

    def forward(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """Returns confidence and residuals from `part_features` of frame 1 and, slots matched to it, of frame 2.

        Where eq. 4.4 multiplies the features of each pair of rotations, here layers see both.
        """
        half = self.pair.weight.chunk(2, 1)
        target, source = second @ half[0].T, first @ half[1].T + self.pair.bias
        hidden = torch.relu(source[:, :, :, None] + target[:, :, None])  # [B, S, a, l, D]
        for layer in self.layers:
            hidden = torch.relu(layer(hidden))
        return torch.softmax(3 * self.confidence(hidden).squeeze(-1), -1), self.residual(hidden)

    def candidates(self, confidence: Tensor, residual: Tensor, best: int = 4) -> Tensor:
        """Returns rotations (B,S,best+1,3,3) from frame 1 to 2.

        They are, for the k-th most confident target of every source, the average over sources by confidence, and the
        overall most confident pair's own.
        """
        anchors = self.group.rotations_like(confidence)
        weight, target = confidence.topk(min(best, confidence.shape[-1]), -1)  # [B, S, a, k]
        picked = residual.gather(3, target[..., None].expand(*target.shape, 4))
        turned = quaternion_to_matrix(normalize_quaternion(picked))  # r ~ R_a^T T^T R_l
        rotation = anchors[target] @ turned.mT @ anchors[:, None].mT  # T = R_l r^T R_a^T
        means = mean_rotation(rotation.transpose(2, 3), weight.transpose(2, 3))
        top = weight[..., 0].argmax(-1)[..., None, None, None, None].expand(-1, -1, 1, 1, 3, 3)
        return torch.cat([means, rotation.gather(2, top)[:, :, 0]], 2)


def rotation_loss(
    confidence: Tensor, residual: Tensor, rotation: Tensor, weight: Tensor, group: RotationGroup
) -> Tensor:
    """Returns the squared error of the residual at the labeled pair plus 0.1 of the confidences' cross-entropy.

    rotation (B,S,3,3): each part's from frame 1 to 2. weight (B,S): how much each counts, e.g. its share of the points.
    The error is taken at the labeled pair only, as in the release.
    """
    label, wanted = relative_labels(rotation.mT, group)
    at = residual.gather(3, label[..., None, None].expand(*label.shape, 1, 4)).squeeze(3)
    error = (quaternion_to_matrix(normalize_quaternion(at)) - wanted).square().mean((-1, -2))
    chosen = confidence.gather(3, label[..., None]).squeeze(-1).clamp(min=1e-8).log()
    return (weight[..., None] * (error - 0.1 * chosen)).sum() / (weight.sum() * label.shape[-1]).clamp(min=1e-6)


def choose_motion(
    rotations: Tensor, first: Tensor, mask1: Tensor, second: Tensor, mask2: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns, of candidate rotations (B,S,M,3,3), the one with the least part-level distance (B.6, B.7).

    The distance is a two-way Chamfer distance, weighted by the masks. first (B,P,3), mask1 (B,P,S), second (B,Q,3), mask2 (B,Q,S)
    matched to mask1. The translation joins the parts' weighted centers. -> rotation (B,S,3,3), translation (B,S,3).
    """
    share1, share2 = (m / m.sum(1, keepdim=True).clamp(min=1e-6) for m in (mask1, mask2))
    center1, center2 = torch.einsum("bps,bpi->bsi", share1, first), torch.einsum("bps,bpi->bsi", share2, second)
    translation = center2[:, :, None] - (rotations @ center1[:, :, None, :, None]).squeeze(-1)
    costs = []
    for m in range(rotations.shape[2]):  # one candidate at a time: (B,S,P,Q) is the largest array
        moved = torch.einsum("bsij,bpj->bspi", rotations[:, :, m], first) + translation[:, :, m, None]
        apart = torch.cdist(moved, second[:, None].expand(-1, moved.shape[1], -1, -1))
        # a point outside the part is no counterpart: it counts as 1 away, farther than any within an object
        near2 = (apart + (1 - mask2.transpose(1, 2)[:, :, None])).amin(-1)
        near1 = (apart + (1 - mask1.transpose(1, 2)[..., None])).amin(-2)
        costs.append((near2 * share1.transpose(1, 2)).sum(-1) + (near1 * share2.transpose(1, 2)).sum(-1))
    best = torch.stack(costs, -1).argmin(-1)[..., None]
    rotation = rotations.gather(2, best[..., None, None].expand(-1, -1, 1, 3, 3)).squeeze(2)
    return rotation, translation.gather(2, best[..., None].expand(-1, -1, 1, 3)).squeeze(2)
