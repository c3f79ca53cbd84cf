"""The network that corrects an inflated silhouette: a U-Net from one picture to the layers of depth behind its pixels.

What one picture leaves open most is how the object as a whole is turned, so the network names it first, as two angles of
the plane through the middle of the object, in bins; the layers are then decoded for one choice of angles. A clip chooses
angles for all its frames together, and training decodes at the true ones, so that no average of two answers is learned.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from dpcli.generate4d.shape.config import ShapeConfig

LAYERS = 4  # front_1, back_1, front_2, back_2
_REACH = 1.25  # radians, the outermost bins of an angle
_CELLS = 3  # the coarsest features are pooled to so many cells along a side before the angles are named


class Encoded(NamedTuple):
    """Holds what is known before the angles are chosen.

    levels: features, fine to coarse. angles: logits (B,2,bins) of the turn about the vertical and about the horizontal.
    gain: (B) how much smaller the error of the layers will be than that of the inflation, as a logarithm.
    """

    levels: list[Tensor]
    angles: Tensor
    gain: Tensor


class ShapeNetwork(nn.Module):
    """Predicts layers from pictures (B,5,S,S): RGB inside the silhouette, the silhouette, its half thickness.

    S is a multiple of 2^levels. Lengths are in sides of the picture.
    """

    def __init__(self, config: ShapeConfig) -> None:
        super().__init__()
        self.config, widths = config, config.widths
        self.down = nn.ModuleList([_Block(20, widths[0]), *(_Block(a, b) for a, b in zip(widths, widths[1:]))])
        self.up = nn.ModuleList([_joint(a + b, a) for a, b in zip(widths, widths[1:])])
        self.name = nn.Sequential(
            nn.Linear(widths[-1] * _CELLS**2, config.hidden), nn.ReLU(), nn.Linear(config.hidden, 2 * config.bins + 1)
        )
        self.turn = nn.Sequential(nn.Linear(4, config.hidden), nn.ReLU(), nn.Linear(config.hidden, widths[-1]))
        self.out = nn.Conv2d(widths[0], 4 * (LAYERS + 1), 1)
        for layer in self.modules():
            if isinstance(layer, (nn.Conv2d, nn.Linear)):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
        for last in (self.name[-1], self.out):
            nn.init.normal_(last.weight, std=0.01)
            nn.init.zeros_(last.bias)
        self.register_buffer("centers", torch.linspace(-_REACH, _REACH, config.bins))

    def encode(self, pictures: Tensor) -> Encoded:
        """Returns features, angles and gain of pictures (B,5,S,S)."""
        levels: list[Tensor] = []
        x = functional.pixel_unshuffle(pictures, 2).contiguous(memory_format=torch.channels_last)
        for index, block in enumerate(self.down):
            levels.append(block(functional.max_pool2d(levels[-1], 2) if index else x))
        named = self.name(functional.adaptive_avg_pool2d(levels[-1], _CELLS).flatten(1)).float()
        return Encoded(levels, named[:, 1:].unflatten(1, (2, -1)), named[:, 0])

    def decode(self, encoded: Encoded, pictures: Tensor, angles: Tensor) -> tuple[Tensor, Tensor]:
        """Returns depth (B,4,S,S) and the logits (B,S,S) of a second interval, for angles (B,2) in radians."""
        waves = torch.cat([angles.sin(), angles.cos()], 1)
        x = encoded.levels[-1] + self.turn(waves)[:, :, None, None]
        for block, skip in zip(reversed(self.up), reversed(encoded.levels[:-1])):
            x = block(torch.cat([skip, functional.interpolate(x, scale_factor=2.0)], 1))
        out = functional.pixel_shuffle(self.out(x), 2).float()
        return out[:, :LAYERS] + inflated_layers(pictures[:, 4]) + tilted_plane(angles, out.shape[-1]), out[:, LAYERS]

    def mean_angles(self, logits: Tensor) -> Tensor:
        """Returns the mean angles (...) that logits (...,bins) stand for: where two answers are as likely, none is taken."""
        return (logits.softmax(-1) * self.centers).sum(-1)

    def angle_targets(self, angles: Tensor) -> Tensor:
        """Returns the shares (...,bins) that the bins of true angles (...) get: the two nearest, linearly."""
        step = self.centers[1] - self.centers[0]
        return (1 - (self.centers - angles.clamp(-_REACH, _REACH)[..., None]).abs() / step).clamp(min=0)


class _Block(nn.Module):
    """Two convolutions of 3 x 3 with batch normalization, which costs nothing once trained; the second adds to the first."""

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
