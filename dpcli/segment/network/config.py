"""What a part network is made of; two named configurations and their switches."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass

from dpcli.errors import UsageError


@dataclass(frozen=True)
class Layer:
    """One separable SE(3) convolution. Lengths in the input's unit (an object of diameter 1)."""

    channels: int
    stride: int
    radius: float
    sigma: float  # a kernel point's reach, squared
    neighbors: int
    kernel_radius: float


@dataclass(frozen=True)
class PartConfig:
    """Sizes and switches of the network. Defaults are `compact`."""

    layers: tuple[tuple[Layer, ...], ...]  # blocks of layers; every block ends in an invariant pooling
    group: str = "icosahedral"  # trivial: no equivariance (ablation)
    kernel: str = "vertices"  # uniform: 23 points that no rotation permutes (release)
    rule: str = "nearest"  # first: in index order (release)
    pooling: str = (
        "point"  # point: every point its own rotation weights (eq. 4.2); global: one for the cloud (ablation)
    )
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
        for option, value, known in (
            ("--group", self.group, ("icosahedral", "trivial")),
            ("--pooling", self.pooling, ("point", "global")),
        ):
            if value not in known:
                raise UsageError(f"{option} {value}: expected {' or '.join(known)}")

    def changed(self, **changes: object) -> PartConfig:
        return dataclasses.replace(self, **{key: value for key, value in changes.items() if value is not None})

    def to_json(self) -> str:
        return json.dumps(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, text: str) -> PartConfig:
        values = json.loads(text)
        values["layers"] = tuple(tuple(Layer(**layer) for layer in block) for block in values["layers"])
        for key in ("decoder", "motion_layers"):
            values[key] = tuple(tuple(v) if isinstance(v, list) else v for v in values[key])
        return cls(**values)


def compact() -> PartConfig:
    """Ours: less than 0.25 M parameters and 0.92 GMAC per 512-point frame, all of them counted."""

    def layer(channels: int, stride: int, radius: float) -> Layer:
        return Layer(channels, stride, radius, (0.6 * radius) ** 2, 32, 0.65 * radius)

    blocks = ((layer(16, 2, 0.16), layer(16, 1, 0.23)), (layer(32, 2, 0.32), layer(32, 1, 0.45)))
    return PartConfig(blocks)


def release() -> PartConfig:
    """The released SAPIEN network: 1,432,365 parameters."""
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


CONFIGS = {"compact": compact, "release": release}


def find_config(name: str) -> PartConfig:
    """A named configuration. UsageError lists the names."""
    if name not in CONFIGS:
        raise UsageError(f"--config {name}: expected one of {', '.join(CONFIGS)}")
    return CONFIGS[name]()
