"""The motion of canonical points: that of rigid parts blended with a non-rigid one (thesis 5.4.3, figure C.2).

Everything here is a function of a canonical position and a time, so the dense stage asks it about Gaussians and the
sparse stage about control points. Nothing here knows about pictures.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dpcli.ops.rotations import multiply_quaternions, normalize_quaternion, quaternion_to_matrix, rotate_by_quaternion

_POINT_FREQUENCIES, _TIME_FREQUENCIES = 10, 6  # thesis 5.5.1


@dataclass
class Motion:
    """Holds where N canonical points go at B times."""

    displacement: Tensor  # [B, N, 3]
    quaternion: Tensor  # [B, N, 4] unit, w >= 0, turns the point's own frame
    part: Tensor  # [B, N, S] probabilities (m)
    weight: Tensor  # [B, N, 1] share of the rigid motion (w), 0..1


def encode(
    values: Tensor,  # [..., D]
    frequencies: int,
) -> Tensor:  # [..., 2 * D * frequencies]
    """Returns the positional embedding (Mildenhall et al. 2020): sine and cosine of the values times 1, 2, 4, ..., without these.

    >>> encode(torch.tensor([0.0]), 2).tolist()
    [0.0, 0.0, 1.0, 1.0]
    """
    scaled = values[..., None] * 2.0 ** torch.arange(frequencies, device=values.device, dtype=values.dtype)
    return torch.cat([scaled.sin(), scaled.cos()], -1).flatten(-2)


class Perceptron(nn.Module):
    """Stacks ReLU layers with Xavier initialization; deep stacks get their input again half-way (the usual NeRF shape)."""

    def __init__(self, inputs: int, width: int, depth: int) -> None:
        super().__init__()
        self.skip_layer = depth // 2 if depth > 4 else -1
        sizes = [inputs] + [width] * (depth - 1)
        self.layers = nn.ModuleList(
            nn.Linear(size + (inputs if index == self.skip_layer else 0), width) for index, size in enumerate(sizes)
        )
        for layer in self.layers:
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, x: Tensor) -> Tensor:  # [..., inputs] -> [..., width]
        """Returns the last layer's activations."""
        hidden = x
        for index, layer in enumerate(self.layers):
            if index == self.skip_layer:
                hidden = torch.cat([hidden, x], -1)
            hidden = layer(hidden).relu()
        return hidden


def _head(width: int, outputs: int, bias: float = 0.0) -> nn.Linear:
    """Returns a last layer that gives `bias` at the start (zero translation, identity rotation: C.1.2)."""
    head = nn.Linear(width, outputs)
    nn.init.zeros_(head.weight)
    nn.init.constant_(head.bias, bias)
    return head


class MotionField(nn.Module):
    """Holds the four networks: deformation (d, rotation), partition (m), rigid motion (R, t) and fusion (w).

    parts: S. Without `rigid` only the deformation is left (row a of Table 5.2); with it, `fusion` says whether both
    motions are blended by w (`blend_motions`) or added (`add_motions`). A part turns about its center, so that turning
    and shifting don't fight. by_time: the partition depends on the time, too.
    """

    def __init__(
        self, parts: int, width: int, depth: int, rigid: bool = True, fusion: bool = True, by_time: bool = False
    ) -> None:
        super().__init__()
        self.parts, self.rigid, self.fusion, self.by_time = parts, rigid, fusion, by_time
        space, time = 6 * _POINT_FREQUENCIES, 2 * _TIME_FREQUENCIES
        self.deformation = Perceptron(space + time, width, depth)
        self.deformation_shift, self.deformation_turn = _head(width, 3), _head(width, 3)
        self.partition = Perceptron(space + (time if by_time else 0), width, max(depth // 2, 2))
        self.partition_head = nn.Linear(width, parts)
        nn.init.xavier_uniform_(self.partition_head.weight)
        nn.init.zeros_(self.partition_head.bias)
        self.movement = Perceptron(time, width, max(depth // 2, 2))
        self.movement_turn, self.movement_shift = _head(width, 3 * parts), _head(width, 3 * parts)
        self.weighing = Perceptron(space + time, width, max(depth // 2, 2))
        self.weighing_head = _head(width, 1, bias=1.0)  # mostly rigid at first: few numbers, the large movements
        self.register_buffer("center", torch.zeros(parts, 3))
        self.register_buffer("seed", torch.zeros(parts, 3))
        self.register_buffer("seed_sharpness", torch.zeros(()))

    @torch.no_grad()
    def start_parts(self, points: Tensor, seeds: Tensor) -> None:
        """Lets parts start as the cells of `seeds` (S,3) among `points` (N,3), with soft walls that the network corrects."""
        self.seed.copy_(seeds)
        spacing = torch.cdist(seeds, seeds).fill_diagonal_(torch.inf).min(1).values.mean()
        self.seed_sharpness.copy_(4.0 / spacing.clamp(min=1e-6) ** 2 if self.parts > 1 else torch.zeros(()))
        nn.init.zeros_(self.partition_head.weight)
        self.update_centers(points)

    @torch.no_grad()
    def update_centers(self, points: Tensor) -> None:
        """Turns parts about the middle of their points from now on: R and t change their coordinates at the next step."""
        share = self.part_of(points, torch.zeros(1).to(points))[0]
        self.center.copy_(share.T @ points / share.sum(0)[:, None].clamp(min=1e-6))

    def part_of(self, points: Tensor, times: Tensor) -> Tensor:  # [B, N, S]
        """Returns the part mask m, a probability of each part, of canonical points (N,3) at times (B) in 0..1."""
        code = encode(points, _POINT_FREQUENCIES)
        if self.by_time:
            code = _join_codes(code, encode(times[:, None], _TIME_FREQUENCIES))
        logits = self.partition_head(self.partition(code))
        logits = logits - self.seed_sharpness * torch.cdist(points, self.seed) ** 2
        return logits.softmax(-1).expand(len(times), -1, -1)

    def part_motion(self, times: Tensor) -> tuple[Tensor, Tensor]:  # [B, S, 4], [B, S, 3]
        """Returns R_s as unit quaternion and t_s, which take x to R x + t, at times (B) in 0..1."""
        hidden = self.movement(encode(times[:, None], _TIME_FREQUENCIES))
        turn = _quaternion(self.movement_turn(hidden).reshape(len(times), self.parts, 3))
        shift = self.movement_shift(hidden).reshape(len(times), self.parts, 3)
        return turn, self.center - rotate_by_quaternion(turn, self.center) + shift

    def forward(self, points: Tensor, times: Tensor) -> Motion:
        """Returns the motion of canonical points (N,3) at times (B) in 0..1."""
        code = _join_codes(encode(points, _POINT_FREQUENCIES), encode(times[:, None], _TIME_FREQUENCIES))
        hidden = self.deformation(code)
        rest, turn = self.deformation_shift(hidden), _quaternion(self.deformation_turn(hidden))
        part = self.part_of(points, times)
        if not self.rigid:
            return Motion(rest, turn, part, torch.zeros_like(rest[..., :1]))
        part_turn, part_shift = self.part_motion(times)
        moved = torch.einsum("bns,bsij,nj->bni", part, quaternion_to_matrix(part_turn), points) + part @ part_shift
        rigid, rigid_turn = moved - points, normalize_quaternion(part @ part_turn)
        if self.fusion:
            weight = self.weighing_head(self.weighing(code)).sigmoid()
            displacement, both = blend_motions(rigid, rigid_turn, rest, turn, weight)
        else:
            weight = torch.ones_like(rest[..., :1])
            displacement, both = add_motions(rigid, rigid_turn, rest, turn)
        return Motion(displacement, both, part, weight)


def blend_motions(
    rigid: Tensor,  # [..., 3] displacement R x + t - x
    rigid_turn: Tensor,  # [..., 4]
    rest: Tensor,  # [..., 3] non-rigid displacement d
    turn: Tensor,  # [..., 4]
    weight: Tensor,  # [..., 1] w, 0..1
) -> tuple[Tensor, Tensor]:  # [..., 3], [..., 4]
    """Returns the weighted fusion w (R x + t - x) + (1 - w) d, eq. 5.6, and the unit quaternion blended likewise.

    The thesis writes R x + t, a position, in place of the displacement. Quaternions must lie in one hemisphere.
    """
    # the turn first: gradients of a shared term are summed in the order of its uses, and the sums are kept to the bit
    both = normalize_quaternion(weight * rigid_turn + (1 - weight) * turn)
    return weight * rigid + (1 - weight) * rest, both


def add_motions(rigid: Tensor, rigid_turn: Tensor, rest: Tensor, turn: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the motion decomposition, eq. 5.5: the sum of both displacements (...,3), the product of both turns (...,4), w >= 0."""
    both = multiply_quaternions(turn, rigid_turn)
    return rigid + rest, torch.where(both[..., :1] < 0, -both, both)


def _join_codes(space: Tensor, time: Tensor) -> Tensor:  # [N, D], [B, E] -> [B, N, D + E]
    batch, count = len(time), len(space)
    return torch.cat([space.expand(batch, -1, -1), time[:, None].expand(-1, count, -1)], -1)


def _quaternion(vector: Tensor) -> Tensor:  # [..., 3] -> [..., 4]
    """Returns the unit quaternion (1, v) / norm: the identity at zero, of one sign only, turns below 180 degrees."""
    return normalize_quaternion(torch.cat([torch.ones_like(vector[..., :1]), vector], -1))
