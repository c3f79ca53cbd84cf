"""The interface of a static network, and the lookup of networks by name. Kinet asks for three methods make any of them a backbone.

A backbone turns a clip into class logits on its own (the static stream) and shows the activations of its neighborhoods
before they are pooled; the dynamic stream fits its surfaces to those. docs/backbones.md writes one from scratch.
"""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dpcli.classify.network.config import KinetConfig
from dpcli.errors import UsageError
from dpcli.ops import gather_points

BACKBONES = {
    "pointnet2": "dpcli.classify.network.backbones.pointnet2:PointNet2",
    "dgcnn": "dpcli.classify.network.backbones.dgcnn:DGCNN",
    "spidercnn": "dpcli.classify.network.backbones.spidercnn:SpiderCNN",
    "slots": "dpcli.classify.network.backbones.point_slots:PointSlots",
}


@dataclass
class Grouping:
    """Holds the centroids of one stage and their neighbors among its points. Frame numbers are float."""

    points: Tensor  # (B,N,3) what is grouped
    times: Tensor  # (B,N)
    centers: Tensor  # (B,M,3)
    center_times: Tensor  # (B,M)
    idx: Tensor  # (B,M,K) i64 into the N points
    columns: Tensor | None = None  # (B,N,F) what clips say of a point beside its place

    def neighbor_times(self) -> Tensor:
        """Returns the frame number of each neighbor, (B,M,K)."""
        return gather_points(self.times[..., None], self.idx)[..., 0]

    def relative(self) -> Tensor:
        """Returns neighbor minus centroid, (B,M,K,3)."""
        return gather_points(self.points, self.idx) - self.centers[:, :, None]


@dataclass
class Stage:
    """Holds one set of neighborhoods and the layers that act on it: activations (B,M,K,C) before pooling, non-negative or not."""

    grouping: Grouping
    activations: list[Tensor]


class Backbone(nn.Module, ABC):
    """Classifies point clouds: a static network. Built as `Class(config)`; `config.num_classes` is the width of its logits.

    `tap_widths` are the channels of the activations that `taps` shows, a tuple a stage; () for a network without a dynamic
    stream. The points that a stage groups are
    the centroids of the stage before (in DGCNN: all points, every time).
    """

    tap_widths: tuple[tuple[int, ...], ...]

    @abstractmethod
    def group(self, points: Tensor, times: Tensor) -> list[Grouping]:
        """Returns neighborhoods, which follow from positions alone. points (B,N,3) of all frames, times (B,N) frame numbers."""

    @abstractmethod
    def forward(self, groups: list[Grouping]) -> Tensor:
        """Returns class logits (B,C), which the static stream is trained with."""

    @abstractmethod
    def taps(self, groups: list[Grouping]) -> tuple[list[Stage], Tensor]:
        """Returns what the dynamic stream reads, in eval mode: each stage with its activations; and the logits."""


def resolve_backbone(name: str) -> type[nn.Module]:
    """Returns the class of a built-in name or of `module:Class`. Raises UsageError when there is none or it isn't a backbone.

    A module of the user's is imported, and so executed: only a name that the user typed may come here.
    """
    place = BACKBONES.get(name, name)
    module, _, attribute = place.partition(":")
    if not attribute:
        raise UsageError(f"backbone = {name}: expected {', '.join(BACKBONES)} or your own as module:Class")
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise UsageError(f"backbone = {name}: {error}; is its folder on PYTHONPATH?") from None
    left = getattr(found, "__abstractmethods__", ())  # named by Backbone and not written
    missing = [
        name for name in ("group", "taps", "forward") if name in left or not callable(getattr(found, name, None))
    ]
    if missing or not (isinstance(found, type) and issubclass(found, nn.Module)):
        lacks = f"lacks {', '.join(missing)}" if missing else "is not a torch.nn.Module"
        raise UsageError(f"backbone = {name}: {lacks}; docs/backbones.md shows the three methods")
    return found


def build_backbone(config: KinetConfig) -> nn.Module:
    """Returns the static network that `config.backbone` names."""
    network = resolve_backbone(config.backbone)(config)
    widths = getattr(network, "tap_widths", None)
    if widths != () and (not widths or not all(isinstance(width, int) for stage in widths for width in stage)):
        raise UsageError(f"backbone = {config.backbone}: tap_widths = {widths!r}, expected integers, a tuple a stage")
    return network


def require_frozen(network: nn.Module) -> None:
    """Raises RuntimeError while a network trains: the dynamic stream reads a static one's running statistics."""
    if network.training:
        raise RuntimeError("the dynamic stream reads a frozen static network; call eval() first")


def clip_points(points: Tensor) -> tuple[Tensor, Tensor]:
    """Returns a batch of clips (B,T,P,3) as one cloud a clip: points (B,T*P,3) frame after frame, times (B,T*P)."""
    batch, frames, count = points.shape[:3]
    times = torch.arange(frames, device=points.device, dtype=points.dtype).repeat_interleave(count)
    return points.reshape(batch, frames * count, 3), times.expand(batch, -1).contiguous()
