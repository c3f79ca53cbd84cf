"""How canonical points move: rigid parts and what is left, blended (thesis 5.4.3, figure C.2).

Everything here is a function of a canonical position and a time, so the dense stage asks it about Gaussians and the
sparse stage about control points. Nothing here knows about pictures.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dpcli.generate4d.scene.quaternion import multiply, normalize, rotate, to_matrix

_POINT_FREQUENCIES, _TIME_FREQUENCIES = 10, 6  # thesis 5.5.1


@dataclass
class Motion:
    """Where N canonical points go at B times."""

    displacement: Tensor  # [B, N, 3]
    quaternion: Tensor  # [B, N, 4] unit, w >= 0, turns the point's own frame
    part: Tensor  # [B, N, S] probabilities (m)
    weight: Tensor  # [B, N, 1] share of the rigid motion (w), 0..1
    part_quaternion: Tensor  # [B, S, 4]
    part_translation: Tensor  # [B, S, 3]: x -> R_s x + t_s

    def part_matrix(self) -> Tensor:  # [B, S, 4, 4]
        """T_s^tau, canonical to the time's position."""
        matrix = torch.eye(4).to(self.part_translation).expand(*self.part_translation.shape[:2], 4, 4).clone()
        matrix[..., :3, :3], matrix[..., :3, 3] = to_matrix(self.part_quaternion), self.part_translation
        return matrix


def encode(
    values: Tensor,  # [..., D]
    frequencies: int,
) -> Tensor:  # [..., 2 * D * frequencies]
    """Sine and cosine of the values times 1, 2, 4, ...; the values themselves are left out, as the siblings do."""
    scaled = values[..., None] * 2.0 ** torch.arange(frequencies, device=values.device, dtype=values.dtype)
    return torch.cat([scaled.sin(), scaled.cos()], -1).flatten(-2)


class Perceptron(nn.Module):
    """ReLU layers with the input joined again half-way (the usual NeRF shape), Xavier start."""

    def __init__(self, inputs: int, width: int, depth: int) -> None:
        super().__init__()
        self.again = depth // 2 if depth > 4 else -1
        sizes = [inputs] + [width] * (depth - 1)
        self.layers = nn.ModuleList(
            nn.Linear(size + (inputs if index == self.again else 0), width) for index, size in enumerate(sizes)
        )
        for layer in self.layers:
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, x: Tensor) -> Tensor:
        hidden = x
        for index, layer in enumerate(self.layers):
            if index == self.again:
                hidden = torch.cat([hidden, x], -1)
            hidden = layer(hidden).relu()
        return hidden


def _head(width: int, outputs: int, bias: float = 0.0) -> nn.Linear:
    """A last layer that says `bias` at the start (zero translation, identity rotation: C.1.2)."""
    head = nn.Linear(width, outputs)
    nn.init.zeros_(head.weight)
    nn.init.constant_(head.bias, bias)
    return head


class MotionField(nn.Module):
    """The four networks: deformation (d, rotation), partition (m), rigid motion (R, t) and fusion (w).

    parts: S. Without `rigid` only the deformation is left (row a of Table 5.2); without `fusion` rigid and non-rigid
    displacement are added (eq. 5.5), else blended by w (eq. 5.6, with the displacement R x + t - x in place of R x + t,
    which is a position). A part turns about its center, so that turning and shifting don't fight.
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
        """Let parts start as the cells of `seeds` (S,3) among `points` (N,3), with soft walls; the network corrects them."""
        self.seed.copy_(seeds)
        spacing = torch.cdist(seeds, seeds).fill_diagonal_(torch.inf).min(1).values.mean()
        self.seed_sharpness.copy_(4.0 / spacing.clamp(min=1e-6) ** 2 if self.parts > 1 else torch.zeros(()))
        nn.init.zeros_(self.partition_head.weight)
        self.update_centers(points)

    @torch.no_grad()
    def update_centers(self, points: Tensor) -> None:
        """Turn parts about the middle of their points from now on (a change of coordinates of R, t at the next step)."""
        share = self.part_of(points, torch.zeros(1).to(points))[0]
        self.center.copy_(share.T @ points / share.sum(0)[:, None].clamp(min=1e-6))

    def part_of(self, points: Tensor, times: Tensor) -> Tensor:  # [B, N, S]
        """m: probabilities of the parts of canonical points (N,3) at times (B,) in 0..1."""
        code = encode(points, _POINT_FREQUENCIES)
        if self.by_time:
            code = _join(code, encode(times[:, None], _TIME_FREQUENCIES))
        logits = self.partition_head(self.partition(code))
        logits = logits - self.seed_sharpness * torch.cdist(points, self.seed) ** 2
        return logits.softmax(-1).expand(len(times), -1, -1)

    def part_motion(self, times: Tensor) -> tuple[Tensor, Tensor]:  # [B, S, 4], [B, S, 3]
        """(R_s, t_s) as unit quaternion and translation, x -> R x + t."""
        hidden = self.movement(encode(times[:, None], _TIME_FREQUENCIES))
        turn = _quaternion(self.movement_turn(hidden).reshape(len(times), self.parts, 3))
        shift = self.movement_shift(hidden).reshape(len(times), self.parts, 3)
        return turn, self.center - rotate(turn, self.center) + shift

    def forward(self, points: Tensor, times: Tensor) -> Motion:
        """Motion of canonical points (N,3) at times (B,) in 0..1."""
        code = _join(encode(points, _POINT_FREQUENCIES), encode(times[:, None], _TIME_FREQUENCIES))
        hidden = self.deformation(code)
        rest, turn = self.deformation_shift(hidden), _quaternion(self.deformation_turn(hidden))
        part = self.part_of(points, times)
        part_turn, part_shift = self.part_motion(times)
        if not self.rigid:
            none = torch.zeros(*rest.shape[:2], 1).to(rest)
            return Motion(rest, turn, part, none, part_turn, part_shift)
        moved = torch.einsum("bns,bsij,nj->bni", part, to_matrix(part_turn), points) + part @ part_shift
        rigid, rigid_turn = moved - points, normalize(part @ part_turn)
        if not self.fusion:
            whole = torch.ones(*rest.shape[:2], 1).to(rest)
            both = multiply(turn, rigid_turn)
            both = torch.where(both[..., :1] < 0, -both, both)
            return Motion(rigid + rest, both, part, whole, part_turn, part_shift)
        weight = self.weighing_head(self.weighing(code)).sigmoid()
        blended = normalize(weight * rigid_turn + (1 - weight) * turn)
        return Motion(weight * rigid + (1 - weight) * rest, blended, part, weight, part_turn, part_shift)


def _join(space: Tensor, time: Tensor) -> Tensor:  # [N, D], [B, E] -> [B, N, D + E]
    batch, count = len(time), len(space)
    return torch.cat([space.expand(batch, -1, -1), time[:, None].expand(-1, count, -1)], -1)


def _quaternion(vector: Tensor) -> Tensor:  # [..., 3] -> [..., 4]
    """Unit quaternion (1, v) / norm: the identity at zero, never ambiguous in sign, turns below 180 degrees."""
    return normalize(torch.cat([torch.ones_like(vector[..., :1]), vector], -1))
