"""3D ResNet-50 (Hara et al. 2018; shortcut B), Kinetics: the network of `fid_vid_r3d50`.

Parameter names are those of resnet-50-kinetics.pth without their `module.`; its classifier isn't used.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
import torch.nn.functional as F
from torch import nn

BLOCKS = (3, 4, 6, 3)


class Bottleneck(nn.Module):
    """Applies 1x1x1, 3x3x3, 1x1x1 convolutions beside a shortcut, projected where its shape changes (type B)."""

    def __init__(self, inside: int, width: int, stride: int) -> None:
        super().__init__()
        outside = 4 * width
        self.conv1 = nn.Conv3d(inside, width, 1, bias=False)
        self.bn1 = nn.BatchNorm3d(width)
        self.conv2 = nn.Conv3d(width, width, 3, stride, padding=1, bias=False)
        self.bn2 = nn.BatchNorm3d(width)
        self.conv3 = nn.Conv3d(width, outside, 1, bias=False)
        self.bn3 = nn.BatchNorm3d(outside)
        if stride != 1 or inside != outside:
            self.downsample = nn.Sequential(nn.Conv3d(inside, outside, 1, stride, bias=False), nn.BatchNorm3d(outside))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Returns the output of `x` f32 (B,C,T,H,W)."""
        shortcut = self.downsample(x) if hasattr(self, "downsample") else x
        x = self.bn1(self.conv1(x)).relu_()
        x = self.bn2(self.conv2(x)).relu_()
        return (self.bn3(self.conv3(x)) + shortcut).relu_()


class ResNet3D50(nn.Module):
    """Computes 2048 features: the last stage averaged over time and space."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv3d(3, 64, 7, (1, 2, 2), padding=3, bias=False)
        self.bn1 = nn.BatchNorm3d(64)
        inside = 64
        for stage, blocks in enumerate(BLOCKS):
            width, stride = 64 << stage, 1 if stage == 0 else 2
            first = Bottleneck(inside, width, stride)
            inside = 4 * width
            rest = (Bottleneck(inside, width, 1) for _ in range(blocks - 1))
            self.add_module(f"layer{stage + 1}", nn.Sequential(first, *rest))
        self.eval()

    def stages(self, x: torch.Tensor) -> Iterator[tuple[str, torch.Tensor]]:
        """Yields name and output of the stem and of each of the four stages."""
        x = self.bn1(self.conv1(x)).relu_()
        x = F.max_pool3d(x, 3, 2, padding=1)
        yield "stem", x
        for stage in range(1, len(BLOCKS) + 1):
            x = getattr(self, f"layer{stage}")(x)
            yield f"layer{stage}", x

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Returns the features (B,2048) of `x` f32 (B,3,16,112,112), 0..255 less the mean color."""
        for _, found in self.stages(x):
            x = found
        return x.mean(dim=(2, 3, 4))
