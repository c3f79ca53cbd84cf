"""LPIPS v0.1: how different two pictures look, by the features of an image classifier (Zhang et al. 2018)."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.networks import full_precision
from dpcli.evaluate.networks.lpips_trunks import alexnet, squeezenet, vgg16
from dpcli.evaluate.networks.state_dicts import fill_module, load_tensors
from dpcli.evaluate.networks.weights import whole_weights

HEADS = Path(__file__).parent / "heads"  # the linear weights, BSD-2, see LPIPS.md there
NETS = {"alex": (alexnet, "alexnet"), "vgg": (vgg16, "vgg16"), "squeeze": (squeezenet, "squeezenet")}
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of RGB in -1..1
EPSILON = 1e-10  # added to a feature's length, not under the root
_OUTSIDE = 0.01  # how far from 0..1 a value may lie: renderers overshoot a little


class Lpips(nn.Module):
    """Computes the distance, 0 for equal pictures; a trained head weighs the squared difference of each unit feature.

    A new object has random trunk weights (for tests) and the published heads; `Lpips.load` has both published.
    Values of different nets are on different scales: never mix them. Raises UsageError for an unknown net.
    """

    def __init__(self, net: str = "vgg"):
        super().__init__()
        if net not in NETS:
            raise UsageError(f"lpips network {net!r}: expected one of {', '.join(NETS)}")
        self.net = net
        self.trunk = NETS[net][0]()
        self.register_buffer("shift", torch.tensor(SHIFT).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("scale", torch.tensor(SCALE).view(1, 3, 1, 1), persistent=False)
        self.heads = nn.ParameterList(load_heads(net, self.trunk.channels))
        self.eval().requires_grad_(False)

    @classmethod
    def load(cls, net: str, folder: Path) -> Lpips:
        """Loads the published trunk from the weights folder. Raises DataError when absent, damaged or another network's."""
        made = cls(net)
        path = whole_weights(NETS[net][1], folder)
        fill_module(made.trunk, load_tensors(path), path)
        return made

    @torch.no_grad()
    def distance(
        self,
        a: Tensor,  # [B, 3, H, W]
        b: Tensor,  # [B, 3, H, W]
        *,
        range01_mistake: bool = False,
    ) -> Tensor:  # [B]
        """Returns LPIPS of pairs of RGB pictures in 0..1: over the layers the sum of their maps' means.

        range01_mistake: DisCo's evaluation gives the network 0..1 where it expects -1..1; for its published numbers.
        Raises DataError for values that are not finite or not in 0..1, and for pictures under the trunk's `smallest`.
        """
        if a.shape != b.shape:
            raise ValueError(f"pictures of shapes {tuple(a.shape)} and {tuple(b.shape)}; expected equal ones")
        features = [self.feature_maps(x, range01_mistake=range01_mistake) for x in (a, b)]
        return sum(
            ((_unit(x) - _unit(y)).square_() * head).sum(1).mean((1, 2))
            for x, y, head in zip(*features, self.heads, strict=True)
        )

    @torch.no_grad()
    def feature_maps(
        self,
        pictures: Tensor,  # [B, 3, H, W]
        *,
        range01_mistake: bool = False,
    ) -> list[Tensor]:  # of [B, C, h, w]
        """Returns the trunk's maps of RGB pictures in 0..1, before they are made unit vectors."""
        self._check(pictures)
        pictures = pictures.to(self.shift)
        pictures = pictures if range01_mistake else 2 * pictures - 1
        with full_precision():
            return self.trunk((pictures - self.shift) / self.scale)

    def _check(self, pictures: Tensor) -> None:
        if pictures.ndim != 4 or pictures.shape[1] != 3:
            raise ValueError(f"pictures of shape {tuple(pictures.shape)}; expected (B,3,H,W)")
        height, width = pictures.shape[2:]
        if min(height, width) < self.trunk.smallest:
            raise DataError(
                f"LPIPS ({self.net}) needs pictures of at least {self.trunk.smallest} pixels a side, "
                f"but these have {height} x {width}"
            )
        if not pictures.is_floating_point():
            raise DataError(f"LPIPS needs floats in 0..1, but these are {pictures.dtype}; divide by 255")
        if not pictures.isfinite().all():
            raise DataError(f"{int((~pictures.isfinite()).sum())} values are NaN or infinite")
        low, high = (float(x) for x in pictures.aminmax()) if pictures.numel() else (0.0, 1.0)
        if low < -_OUTSIDE or high > 1 + _OUTSIDE:
            raise DataError(f"values from {low:g} to {high:g}, expected 0..1; divide by 255, or add 1 and halve")


def load_heads(net: str, channels: tuple[int, ...]) -> list[nn.Parameter]:
    """Returns the published non-negative weights of each layer's channels, f32 (1,C,1,1), as they came with `lpips` 0.1.4."""
    path = HEADS / f"lpips-v0.1-{net}.safetensors"
    state = load_tensors(path)
    heads = [state[f"lin{layer}.model.1.weight"] for layer in range(len(channels))]
    if tuple(head.shape[1] for head in heads) != channels:
        raise DataError(f"{path}: not the heads of {net}")
    return [nn.Parameter(head, requires_grad=False) for head in heads]


def _unit(features: Tensor) -> Tensor:
    """Returns each pixel's feature divided by its length."""
    return features / (features.square().sum(1, keepdim=True).sqrt() + EPSILON)
