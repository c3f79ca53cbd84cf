"""Sparse control points that carry the Gaussians by linear blend skinning (eq. 5.8, C.12)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding_bag

from dpcli.generate4d.scene.motion import Motion
from dpcli.ops.farthest_point_sampling import fps
from dpcli.ops.gather import gather_points
from dpcli.ops.nearest_neighbors import knn
from dpcli.ops.rotations import multiply_quaternions, normalize_quaternion, quaternion_to_matrix


class ControlPoints(nn.Module):
    """Holds K canonical positions (K,3) and log radii (K), both learned; `neighbors` of them move each Gaussian."""

    def __init__(self, positions: Tensor, neighbors: int = 8) -> None:
        super().__init__()
        self.neighbors = min(neighbors, len(positions))
        self.position = nn.Parameter(positions.detach().clone())
        spacing = mean_neighbor_distance(positions)
        self.log_radius = nn.Parameter(spacing.clamp(min=1e-4).log())

    @classmethod
    def among(cls, points: Tensor, count: int, neighbors: int = 8) -> ControlPoints:
        """Returns at most `count` of the points (N,3) as control points, chosen by farthest point sampling."""
        chosen = fps(points.detach()[None], min(count, len(points)))[0]
        return cls(points[chosen], neighbors)

    def nearest(self, points: Tensor) -> Tensor:  # [N, 3] -> [N, k]
        """Returns the indices of the control points that will move each point."""
        return knn(points.detach()[None], self.position.detach()[None], self.neighbors)[1][0]

    def weights(self, points: Tensor, nearest: Tensor) -> Tensor:  # [N, k]
        """Returns the weighting ratio omega of C.12: exp(-d^2 / radius^2), normalized over the neighbors; stable far away."""
        controls = torch.cat([self.position, self.log_radius[:, None]], -1)
        near = gather_points(controls[None], nearest[None])[0]
        squared = (points[:, None] - near[..., :3]).square().sum(-1)
        return (-squared / (2 * near[..., 3]).exp()).softmax(-1)

    def carry(
        self,
        points: Tensor,  # [N, 3]
        nearest: Tensor,  # [N, k]
        motion: Motion,  # of the control points
    ) -> tuple[Tensor, Tensor]:  # [B, N, 3], [B, N, 4]
        """Returns positions of canonical points at the motion's times, and quaternions that turn their frames (eq. 5.8).

        The motion's quaternions must lie in one hemisphere (w >= 0), as `MotionField` gives them, so that they can be averaged.
        """
        weights = self.weights(points, nearest)
        matrix = quaternion_to_matrix(motion.quaternion)  # [B, K, 3, 3]
        shift = self.position + motion.displacement - (matrix @ self.position[..., None]).squeeze(-1)
        table = torch.cat([matrix.flatten(-2), shift, motion.quaternion], -1)  # [B, K, 16]
        count = len(table)
        blended = embedding_bag(  # sum_k omega_k (R_k x + b_k) = (sum_k omega_k R_k) x + sum_k omega_k b_k
            nearest, table.permute(1, 0, 2).flatten(1), per_sample_weights=weights, mode="sum"
        )
        blended = blended.reshape(-1, count, 16).transpose(0, 1)
        matrix, shift, turn = blended.split([9, 3, 4], -1)
        moved = (matrix.unflatten(-1, (3, 3)) * points[:, None]).sum(-1) + shift
        return moved, normalize_quaternion(turn)


def mean_neighbor_distance(points: Tensor) -> Tensor:  # [N, 3] -> [N]
    """Returns the mean distance of each point to its 3 nearest others; 0.01 where there is no other."""
    count = min(3, len(points) - 1)
    if count < 1:
        return torch.full((len(points),), 0.01).to(points)
    squared, _ = knn(points.detach()[None], points.detach()[None], count + 1)
    return squared[0, :, 1:].sqrt().mean(1)


def turn_frames(turn: Tensor, quaternion: Tensor) -> Tensor:  # [B, N, 4], [N, 4] -> [B, N, 4]
    """Returns the quaternions of Gaussians after a turn."""
    return multiply_quaternions(turn, normalize_quaternion(quaternion).expand_as(turn))
