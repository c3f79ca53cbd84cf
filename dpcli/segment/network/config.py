"""The sizes of a part network, the two sets of sizes there are, and the settings that choose among them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal, get_args

from dpcli.errors import UsageError
from dpcli.runtime.settings.fields import Settings, setting
from dpcli.runtime.settings.stored import StoredConfig
from dpcli.runtime.settings.value_types import numbers_in

Group = Literal["icosahedral", "trivial"]
Pooling = Literal["point", "global"]
_POSITIVE = (
    *("decoder", "motion_layers", "pool_heads", "slots", "slot_width", "slot_layers", "slot_heads", "embedding"),
    *("temperature", "points"),
)


@dataclass(frozen=True)
class NetworkSettings(Settings):
    """Holds what a user chooses of the network; `config` makes the sizes of it."""

    sizes: Literal["compact", "release"] = setting(
        "compact",
        "Widths, neighborhoods and kernels: compact (under 0.25 M parameters) or release (1.43 M, as published).",
    )
    group: Group = setting("icosahedral", "Rotation group; trivial turns equivariance off (an ablation).")
    pooling: Pooling = setting(
        "point", "What chooses the rotations of eq. 4.2: each point, or the whole cloud at once (global, an ablation)."
    )
    motion_head: bool = setting(True, "Have a motion head, which predicts each part's rotation between two frames.")
    slots: int = setting(8, "Most parts that a frame can be divided into.", least=2, most=1000)
    points: int = setting(512, "Points of each frame that the network sees.", least=32)

    def config(self) -> PartConfig:
        """Returns the sizes of the network that these settings describe."""
        chosen = {"group": self.group, "pooling": self.pooling, "slots": self.slots, "points": self.points}
        without_motion = {} if self.motion_head else {"motion_width": 0}
        return dataclasses.replace(SIZES[self.sizes](), **chosen, **without_motion)


@dataclass(frozen=True)
class Precision(Settings):
    """Holds whether the network works in mixed precision."""

    amp: bool | None = setting(
        None, "Matrix products in bfloat16, geometry in float32; none: on GPUs that have it (Ampere and later)."
    )


@dataclass(frozen=True)
class Layer:
    """Holds the sizes of one separable SE(3) convolution; lengths are in diameters of the object."""

    channels: int
    stride: int
    radius: float
    sigma: float  # a kernel point's reach, squared
    neighbors: int
    kernel_radius: float


@dataclass(frozen=True)
class PartConfig(StoredConfig):
    """Holds the sizes and switches of a part network as its weights file records them; defaults are `compact`."""

    layers: tuple[tuple[Layer, ...], ...]  # blocks of layers; every block ends in an invariant pooling
    group: Group = "icosahedral"
    kernel: Literal["vertices", "uniform"] = "vertices"  # uniform: 23 points that no rotation permutes (release)
    rule: Literal["nearest", "first"] = "nearest"  # first: in index order (release)
    pooling: Pooling = "point"
    pool_heads: int = 4
    canonical_heads: int = 4  # learned frames that give exactly invariant coordinates; 0: raw xyz (release)
    decoder: tuple[tuple[int, ...], ...] = ((96, 64), (96, 64))
    slots: int = 8
    slot_width: int = 64
    slot_layers: int = 2
    slot_heads: int = 4
    embedding: int = 64
    temperature: float = 0.05
    motion_width: int = 32  # 0: no motion head
    motion_layers: tuple[int, ...] = (32, 16)
    points: int = 512  # per frame in training

    def __post_init__(self) -> None:
        """Raises UsageError for a rotation group or pooling that does not exist, and for sizes that no network has."""
        for name, legal in (("group", get_args(Group)), ("pooling", get_args(Pooling))):
            if getattr(self, name) not in legal:
                raise UsageError(f"{name} = {getattr(self, name)}: expected one of {', '.join(legal)}")
        if (
            len(self.layers) != 2
            or len(self.decoder) != 2
            or not all((*self.layers, *self.decoder, self.motion_layers))
        ):
            raise UsageError(
                "layers, decoder, motion_layers: expected two blocks, two groups of widths and some widths"
            )
        for layer in (one for block in self.layers for one in block):
            if min(dataclasses.astuple(layer)) <= 0:
                raise UsageError(f"layers = {layer}: expected sizes above 0")
        for name in _POSITIVE:
            if min(numbers_in(getattr(self, name))) <= 0:
                raise UsageError(f"{name} = {getattr(self, name)}: expected more than 0")
        if min(self.canonical_heads, self.motion_width) < 0:
            raise UsageError("canonical_heads, motion_width: expected at least 0")


def compact() -> PartConfig:
    """Returns our sizes: less than 0.25 M parameters and 0.92 G multiply-adds per 512-point frame, all of them counted."""

    def layer(channels: int, stride: int, radius: float) -> Layer:
        return Layer(channels, stride, radius, (0.6 * radius) ** 2, 32, 0.65 * radius)

    blocks = ((layer(16, 2, 0.16), layer(16, 1, 0.23)), (layer(32, 2, 0.32), layer(32, 1, 0.45)))
    return PartConfig(blocks)


def release() -> PartConfig:
    """Returns the sizes of the network released for SAPIEN: 1,432,365 parameters."""
    rows = (
        (32, 2, 0.2, 0.02, 96),
        (32, 1, 0.08**0.5, 0.04, 48),
        (64, 1, 0.08**0.5, 0.04, 48),
        (64, 2, 0.4, 0.08, 96),
        (64, 1, 0.4, 0.08, 48),
        (128, 1, 0.4, 0.08, 48),
    )
    layers = [Layer(c, stride, radius, sigma, count, 0.7 * radius) for c, stride, radius, sigma, count in rows]
    return PartConfig(
        (tuple(layers[:3]), tuple(layers[3:])),
        kernel="uniform",
        rule="first",
        pool_heads=1,
        canonical_heads=0,
        decoder=((256, 128), (128, 128, 64)),
        slot_width=128,
        slot_heads=8,
        motion_width=128,
        motion_layers=(128, 64, 32),
    )


SIZES = {"compact": compact, "release": release}
NETWORK_PRESETS = {name: NetworkSettings(sizes=name) for name in SIZES}
