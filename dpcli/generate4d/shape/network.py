"""The network that corrects an inflated silhouette: a U-Net from one picture to the layers of depth behind its pixels.

What one picture leaves open most is how the object as a whole is turned and how long it is along the line of sight, so the
network names these first: two angles of the plane through the middle of the object, and its length beside the inflation's, in
bins. The layers are then decoded for one choice of them. A clip chooses for all its frames together, and training decodes at
the truth, so that no average of two answers is learned.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from dpcli.generate4d.shape.config import ShapeConfig

LAYERS = 4  # front_1, back_1, front_2, back_2
_REACH = 1.25  # radians, the outermost bins of an angle
_LENGTHS = -0.8, 1.8  # the outermost bins of the length, logarithms
_CELLS = 3  # the coarsest features are pooled to so many cells along a side before the angles are named


class Encoded(NamedTuple):
    """Holds what is known before the angles are chosen.

    levels: features, fine to coarse. angles: logits (B,2,bins) of the turn about the vertical and about the horizontal.
    lengths: logits (B,bins) of the logarithm of the length beside the inflation's; (B,0) from a network that doesn't name it.
    """

    levels: list[Tensor]
    angles: Tensor
    lengths: Tensor

    @property
    def overall(self) -> Tensor:
        """Returns the coarsest features (B,C), each averaged over the picture."""
        return self.levels[-1].float().mean((2, 3))


class ShapeNetwork(nn.Module):
    """Predicts layers from pictures (B,5,S,S): RGB inside the silhouette, the silhouette, its half thickness.

    S is a multiple of 2^levels. Lengths are in sides of the picture.
    """

    def __init__(self, config: ShapeConfig) -> None:
        super().__init__()
        self.config, widths = config, config.widths
        self.down = nn.ModuleList([_Block(20, widths[0]), *(_Block(a, b) for a, b in zip(widths, widths[1:]))])
        self.up = nn.ModuleList([_joint(a + b, a) for a, b in zip(widths, widths[1:])])
        named = (3 if config.lengths else 2) * config.bins
        self.name = nn.Sequential(
            nn.Linear(widths[-1] * _CELLS**2, config.hidden), nn.ReLU(), nn.Linear(config.hidden, named)
        )
        known = 5 if config.lengths else 4
        self.turn = nn.Sequential(nn.Linear(known, config.hidden), nn.ReLU(), nn.Linear(config.hidden, widths[-1]))
        self.out = nn.Conv2d(widths[0], 4 * (LAYERS + 1), 1)
        for layer in self.modules():
            if isinstance(layer, (nn.Conv2d, nn.Linear)):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
        for last in (self.name[-1], self.out):
            nn.init.normal_(last.weight, std=0.01)
            nn.init.zeros_(last.bias)
        self.register_buffer("centers", torch.linspace(-_REACH, _REACH, config.bins))
        self.register_buffer("length_centers", torch.linspace(*_LENGTHS, config.bins), persistent=False)

    def encode(self, pictures: Tensor) -> Encoded:
        """Returns features, angles and lengths of pictures (B,5,S,S)."""
        levels: list[Tensor] = []
        x = functional.pixel_unshuffle(pictures, 2).contiguous(memory_format=torch.channels_last)
        for index, block in enumerate(self.down):
            levels.append(block(functional.max_pool2d(levels[-1], 2) if index else x))
        named = self.name(functional.adaptive_avg_pool2d(levels[-1], _CELLS).flatten(1)).float()
        angles, lengths = named.split([2 * self.config.bins, named.shape[1] - 2 * self.config.bins], 1)
        return Encoded(levels, angles.unflatten(1, (2, -1)), lengths)

    def decode(self, encoded: Encoded, pictures: Tensor, angles: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        """Returns depth (B,4,S,S) and the logits (B,S,S) of a second interval, for angles (B,2) in radians and the logarithm
        (B) of the length beside the inflation's, which a network that doesn't name it leaves aside.
        """
        known, half = [angles.sin(), angles.cos()], pictures[:, 4]
        if self.config.lengths:
            known.append(length[:, None])
            half = half * length.exp()[:, None, None]
        x = encoded.levels[-1] + self.turn(torch.cat(known, 1))[:, :, None, None]
        for block, skip in zip(reversed(self.up), reversed(encoded.levels[:-1])):
            x = block(torch.cat([skip, functional.interpolate(x, scale_factor=2.0)], 1))
        out = functional.pixel_shuffle(self.out(x), 2).float()
        return out[:, :LAYERS] + inflated_layers(half) + tilted_plane(angles, out.shape[-1]), out[:, LAYERS]

    def mean_angles(self, logits: Tensor) -> Tensor:
        """Returns the mean angles (...) that logits (...,bins) stand for: where two answers are as likely, none is taken."""
        return (logits.softmax(-1) * self.centers).sum(-1)

    def mean_length(self, logits: Tensor) -> Tensor:
        """Returns the mean logarithm of the length (...) that logits (...,bins) stand for; 0 for logits of no bins."""
        if not logits.shape[-1]:
            return logits.sum(-1)
        return (logits.softmax(-1) * self.length_centers).sum(-1)

    def angle_targets(self, angles: Tensor) -> Tensor:
        """Returns the shares (...,bins) that the bins of true angles (...) get: the two nearest, linearly."""
        return _shares(self.centers, angles)

    def length_targets(self, length: Tensor) -> Tensor:
        """Returns the shares (...,bins) that the bins of true lengths (...), logarithms, get."""
        return _shares(self.length_centers, length)


def _shares(centers: Tensor, values: Tensor) -> Tensor:
    values = values.clamp(centers[0], centers[-1])
    return (1 - (centers - values[..., None]).abs() / (centers[1] - centers[0])).clamp(min=0)


class _Block(nn.Module):
    """Applies two 3 x 3 convolutions with batch normalization, which is free once trained; the second adds to the first."""

    def __init__(self, first: int, last: int) -> None:
        super().__init__()
        self.first = _joint(first, last)
        self.second = nn.Sequential(nn.Conv2d(last, last, 3, padding=1, bias=False), nn.BatchNorm2d(last))

    def forward(self, x: Tensor) -> Tensor:
        """Returns features (B,last,H,W) of features (B,first,H,W)."""
        x = self.first(x)
        return (x + self.second(x)).relu()


def _joint(first: int, last: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(first, last, 3, padding=1, bias=False), nn.BatchNorm2d(last), nn.ReLU())


def inflated_layers(half: Tensor) -> Tensor:
    """Returns the layers (B,4,S,S) that a half thickness (B,S,S) stands for: about 0, the second interval behind the first."""
    return torch.stack([-half, half, half + 0.1, half + 0.2], 1)


def tilted_plane(angles: Tensor, size: int) -> Tensor:
    """Returns the depth (B,1,S,S) of planes through the middle of the picture, turned by angles (B,2)."""
    place = (torch.arange(size, device=angles.device) + 0.5) / size - 0.5
    slope = angles.tan()[:, :, None, None]
    return (slope[:, 0] * place + slope[:, 1] * place[:, None])[:, None]
