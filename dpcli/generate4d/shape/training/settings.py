"""The settings of the training of a shape network, and its presets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from dpcli.generate4d.shape.config import ShapeConfig
from dpcli.runtime.settings.catalog import Catalog
from dpcli.runtime.settings.fields import Settings, setting


@dataclass(frozen=True)
class ShapeSchedule(Settings):
    """Holds how long a shape network learns, from pictures of which size, and how often it sees each."""

    steps: int = setting(20_000, "Steps of the optimizer; 0: the weights of init are only scored again.", least=0)
    batch: int = setting(64, "Pictures per step, on which the rotation of the whole object is learned.", least=1)
    decoded: int = setting(16, "Pictures of each step on which the layers are learned, too: the easier part.", least=1)
    size: int = setting(
        64, "Side of the pictures, pixels; a multiple of 2 to the number of levels.", least=16, most=1024
    )
    lr: float = setting(2e-3, "Largest learning rate; it falls to zero as a cosine.", above=0)
    round: int = setting(1024, "Pictures made per round; a training begins with four times as many.", least=1)
    rounds: int = setting(24, "Rounds of pictures that are kept.", least=1)
    reuse: int = setting(6, "Times that a picture is seen.", least=1)
    amp: bool = setting(False, "Matrix products in bfloat16: faster on processors that have it.")


@dataclass(frozen=True)
class ShapeData(Settings):
    """Holds what the pictures of a training show."""

    made: float = setting(0.5, "Share of made-up creatures and things.", least=0, most=1)
    moving: float = setting(0.35, "Share of models with animations; still models have the rest.", least=0, most=1)
    views: int = setting(
        6, "Pictures of each model in a round, in some poses; more are cheap on a GPU.", least=1, most=4096
    )
    warp: float = setting(
        0.1, "How far smooth waves bend and swell each model, so that its proportions differ.", least=0, most=0.3
    )
    held_out: str | None = setting(
        None, "A text file of models used for validation only, one path or end of a path per line."
    )
    validation: int = setting(
        384,
        "Pictures of held-out models that choose the best weights; as many of creatures, and of things, fit the confidence.",
        least=1,
    )
    init: str | None = setting(None, "Weights to start from: a file or a folder of an earlier training.")


class ShapeTraining(NamedTuple):
    """Holds all settings of a training."""

    network: ShapeConfig
    schedule: ShapeSchedule
    data: ShapeData


CATALOG = Catalog(network=ShapeConfig, schedule=ShapeSchedule, data=ShapeData)
PRESETS = {
    "release": {"network": ShapeConfig(lengths=True), "schedule": ShapeSchedule(), "data": ShapeData()},
    "gpu": {  # eight minutes of an H200; models are the bottleneck, so each is seen from many sides
        "network": ShapeConfig(widths=(48, 96, 192, 320), hidden=256, lengths=True),
        "schedule": ShapeSchedule(
            steps=9000, batch=512, decoded=512, lr=3e-3, round=2048, rounds=24, reuse=3, amp=True
        ),
        "data": ShapeData(views=24, warp=0.15, validation=768),
    },
    "tiny": {
        "network": ShapeConfig(widths=(8, 16), hidden=16, bins=5, lengths=True),
        "schedule": ShapeSchedule(steps=20, batch=4, decoded=2, size=16, round=16, rounds=2, reuse=4),
        "data": ShapeData(validation=16),
    },
}
