"""Inflated Inception-v1 (I3D, Carreira & Zisserman 2017) on RGB, Kinetics-400: the network of the Frechet video distance.

Parameter names are those of i3d_pretrained_400.pt. The TorchScript file i3d_torchscript.pt is run as it is.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import nn

from dpcli.errors import DataError, first_line

CLASSES = 400
# channels in -> 1x1x1; 1x1x1, 3x3x3; 1x1x1, 3x3x3; 1x1x1 behind the pool (table 1 of Szegedy et al. 2015)
MIXED = {
    "Mixed_3b": (192, (64, 96, 128, 16, 32, 32)),
    "Mixed_3c": (256, (128, 128, 192, 32, 96, 64)),
    "Mixed_4b": (480, (192, 96, 208, 16, 48, 64)),
    "Mixed_4c": (512, (160, 112, 224, 24, 64, 64)),
    "Mixed_4d": (512, (128, 128, 256, 24, 64, 64)),
    "Mixed_4e": (512, (112, 144, 288, 32, 64, 64)),
    "Mixed_4f": (528, (256, 160, 320, 32, 128, 128)),
    "Mixed_5b": (832, (256, 160, 320, 32, 128, 128)),
    "Mixed_5c": (832, (384, 192, 384, 48, 128, 128)),
}
# kernel and stride of the pools, by the stage that they stand before
POOLS = {
    "Conv3d_2b_1x1": ((1, 3, 3), (1, 2, 2)),
    "Mixed_3b": ((1, 3, 3), (1, 2, 2)),
    "Mixed_4b": ((3, 3, 3), (2, 2, 2)),
    "Mixed_5b": ((2, 2, 2), (2, 2, 2)),
}


def same_padding(size: int, kernel: int, stride: int) -> tuple[int, int]:
    """Returns TensorFlow's SAME padding: zeros before and behind an axis so that its length becomes ceil(size / stride).

    The odd one goes behind.
    """
    missing = max((-(-size // stride) - 1) * stride + kernel - size, 0)
    return missing // 2, missing - missing // 2


def pad_same(x: torch.Tensor, kernel: tuple[int, ...], stride: tuple[int, ...]) -> torch.Tensor:
    """Returns `x` f32 (B,C,T,H,W) with `same_padding` on its last three axes."""
    sides = [same_padding(size, k, s) for size, k, s in zip(x.shape[2:], kernel, stride, strict=True)]
    return F.pad(x, [side for pair in reversed(sides) for side in pair])


def pool_same(x: torch.Tensor, kernel: tuple[int, ...], stride: tuple[int, ...]) -> torch.Tensor:
    """Returns the largest value of each window; the zeros around are never larger than activations behind a ReLU."""
    return F.max_pool3d(pad_same(x, kernel, stride), kernel, stride)


class Unit(nn.Module):
    """Applies a convolution with SAME padding, batch norm and ReLU."""

    def __init__(self, inside: int, outside: int, kernel: int, stride: int = 1, bn_eps: float = 1e-5) -> None:
        super().__init__()
        self.conv3d = nn.Conv3d(inside, outside, kernel, stride, bias=False)
        self.bn = nn.BatchNorm3d(outside, eps=bn_eps)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Returns the output of `x` f32 (B,C,T,H,W)."""
        padded = pad_same(x, self.conv3d.kernel_size, self.conv3d.stride)
        return self.bn(self.conv3d(padded)).relu_()


class Mixed(nn.Module):
    """Applies an Inception block: four branches side by side."""

    def __init__(self, inside: int, widths: tuple[int, ...], bn_eps: float) -> None:
        super().__init__()
        self.b0 = Unit(inside, widths[0], 1, bn_eps=bn_eps)
        self.b1a = Unit(inside, widths[1], 1, bn_eps=bn_eps)
        self.b1b = Unit(widths[1], widths[2], 3, bn_eps=bn_eps)
        self.b2a = Unit(inside, widths[3], 1, bn_eps=bn_eps)
        self.b2b = Unit(widths[3], widths[4], 3, bn_eps=bn_eps)
        self.b3b = Unit(inside, widths[5], 1, bn_eps=bn_eps)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Returns the output of `x` f32 (B,C,T,H,W)."""
        pooled = pool_same(x, (3, 3, 3), (1, 1, 1))
        return torch.cat([self.b0(x), self.b1b(self.b1a(x)), self.b2b(self.b2a(x)), self.b3b(pooled)], dim=1)


class Logits(nn.Module):
    """Applies the last 1x1x1 convolution, with a bias and nothing behind it."""

    def __init__(self, inside: int, classes: int) -> None:
        super().__init__()
        self.conv3d = nn.Conv3d(inside, classes, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Returns the output of `x` f32 (B,C,T,H,W)."""
        return self.conv3d(x)


class I3D(nn.Module):
    """Computes 400 logits, before the softmax, averaged over time.

    avg_pool: frames of the last average pool, 2 (VideoGPT, TF) or 1 (DisCo). bn_eps: 1e-5 (VideoGPT) or 1e-3 (DisCo).
    """

    def __init__(self, avg_pool: int = 2, bn_eps: float = 1e-5) -> None:
        super().__init__()
        self.avg_pool = (avg_pool, 7, 7)
        self.Conv3d_1a_7x7 = Unit(3, 64, 7, 2, bn_eps)
        self.Conv3d_2b_1x1 = Unit(64, 64, 1, 1, bn_eps)
        self.Conv3d_2c_3x3 = Unit(64, 192, 3, 1, bn_eps)
        for name, (inside, widths) in MIXED.items():
            self.add_module(name, Mixed(inside, widths, bn_eps))
        self.logits = Logits(1024, CLASSES)
        self.eval()

    def stages(self, x: torch.Tensor) -> Iterator[tuple[str, torch.Tensor]]:
        """Yields name and output of every stage up to Mixed_5c (B,1024,ceil(T/8),7,7)."""
        for name, stage in self.named_children():
            if name == "logits":
                return
            if name in POOLS:
                x = pool_same(x, *POOLS[name])
            x = stage(x)
            yield name, x

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Returns the logits (B,400) of `x` f32 (B,3,T,224,224) in -1..1. T of 9 frames at least where avg_pool is 2, else 1."""
        for _, found in self.stages(x):
            x = found
        x = F.avg_pool3d(x, self.avg_pool, stride=1)
        return self.logits(x).mean(dim=(2, 3, 4))


class ScriptedI3D(nn.Module):
    """Runs i3d_torchscript.pt (StyleGAN-V), its own code, asked for logits of pictures that are prepared already."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        try:
            self.script = torch.jit.load(str(path), map_location="cpu").eval()
        except (RuntimeError, ValueError) as error:
            raise DataError(f"{path}: not a TorchScript file ({first_line(error)[:150]})") from None

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Returns the logits (B,400) of `x` f32 (B,3,T,224,224) in -1..1."""
        return self.script(x, rescale=False, resize=False, return_features=True)
