"""AlexNet, VGG16 and SqueezeNet 1.1 up to their last feature map, with torchvision's parameter names."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Trunk(nn.Module):
    """Applies a stack of layers whose outputs are taken at a few places.

    taps: positions in `features` after which a map is taken. channels: of those maps. smallest: least height and
    width whose last map still has a pixel.
    """

    def __init__(self, layers: list[nn.Module], taps: tuple[int, ...], channels: tuple[int, ...], smallest: int):
        super().__init__()
        self.features = nn.Sequential(*layers)
        self.taps, self.channels, self.smallest = taps, channels, smallest

    def forward(
        self,
        pictures: Tensor,  # [B, 3, H, W]
    ) -> list[Tensor]:  # of [B, C, h, w]
        """Returns feature maps at the taps, the shallowest first. `pictures` are already scaled as the network was trained."""
        maps, last = [], self.taps[-1]
        for position, layer in enumerate(self.features[: last + 1]):
            pictures = layer(pictures)
            if position in self.taps:
                maps.append(pictures)
        return maps


class Fire(nn.Module):
    """Applies SqueezeNet's module: 1 x 1 to few channels, then 1 x 1 and 3 x 3 side by side (Iandola et al. 2016)."""

    def __init__(self, channels: int, squeezed: int, expanded: int):
        super().__init__()
        self.squeeze = nn.Conv2d(channels, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(
        self,
        x: Tensor,  # [B, channels, h, w]
    ) -> Tensor:  # [B, 2 expanded, h, w]
        """Returns both expansions, each after a ReLU."""
        x = self.squeeze(x).relu_()
        return torch.cat([self.expand1x1(x), self.expand3x3(x)], 1).relu_()


def alexnet() -> Trunk:
    """Returns AlexNet in torchvision's one-tower form (Krizhevsky 2014); maps relu1 to relu5."""
    return Trunk(
        [
            *_conv(3, 64, 11, stride=4, padding=2),
            nn.MaxPool2d(3, 2),
            *_conv(64, 192, 5, padding=2),
            nn.MaxPool2d(3, 2),
            *_conv(192, 384, 3, padding=1),
            *_conv(384, 256, 3, padding=1),
            *_conv(256, 256, 3, padding=1),
        ],
        taps=(1, 4, 7, 9, 11),
        channels=(64, 192, 384, 256, 256),
        smallest=31,
    )


def vgg16() -> Trunk:
    """Returns VGG16 without batch norm (Simonyan & Zisserman 2015); maps relu1_2, 2_2, 3_3, 4_3 and 5_3."""
    layers: list[nn.Module] = []
    before = 3
    for channels, times in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        layers += [nn.MaxPool2d(2, 2)] if layers else []
        for _ in range(times):
            layers += _conv(before, channels, 3, padding=1)
            before = channels
    return Trunk(layers, taps=(3, 8, 15, 22, 29), channels=(64, 128, 256, 512, 512), smallest=16)


def squeezenet() -> Trunk:
    """Returns SqueezeNet 1.1 (Iandola et al. 2016); maps after the first ReLU and after fires 3, 5, 6, 7, 8 and 9."""
    return Trunk(
        [
            *_conv(3, 64, 3, stride=2),
            _ceil_pool(),
            Fire(64, 16, 64),
            Fire(128, 16, 64),
            _ceil_pool(),
            Fire(128, 32, 128),
            Fire(256, 32, 128),
            _ceil_pool(),
            Fire(256, 48, 192),
            Fire(384, 48, 192),
            Fire(384, 64, 256),
            Fire(512, 64, 256),
        ],
        taps=(1, 4, 7, 9, 10, 11, 12),
        channels=(64, 128, 256, 384, 384, 512, 512),
        smallest=17,
    )


def _conv(before: int, channels: int, size: int, **more: int) -> list[nn.Module]:
    return [nn.Conv2d(before, channels, size, **more), nn.ReLU(inplace=True)]


def _ceil_pool() -> nn.Module:
    return nn.MaxPool2d(3, 2, ceil_mode=True)
