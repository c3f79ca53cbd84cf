"""Sizes of the flow network; two named configurations."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass

from dpcli.errors import UsageError


@dataclass(frozen=True)
class FlowConfig:
    """Widths and neighborhoods. Defaults are `compact`, ours, for training on a CPU. Lengths: diameters of the object."""

    local: tuple[int, int] = (24, 48)  # channels at N/2 and N/4 points
    deep: tuple[int, int] = (64, 96)  # at N/8 and N/16: what the global correlation compares
    hidden: int = 64  # of the gated recurrent unit
    head: int = 48  # of the flow regressor
    neighbors: int = 16
    correlated: int = 8  # nearest points of the other frame, compared with each warped point
    radius: float = 0.1  # farther ones are replaced by the nearest
    iterations: int = 4
    norm: str = "layer"  # or batch
    support: float = 10.0  # global correlation looks no farther

    def to_json(self) -> str:
        return json.dumps(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, text: str) -> FlowConfig:
        values = json.loads(text)
        return cls(**{key: tuple(v) if isinstance(v, list) else v for key, v in values.items()})


def release() -> FlowConfig:
    """The widths stated for FlowStep3D on SAPIEN. What is known of it leaves joints open, so the count differs from its
    629,207 parameters, and its checkpoints don't load."""
    return FlowConfig(local=(32, 64), deep=(128, 256), hidden=128, head=128, norm="batch")


FLOW_CONFIGS = {"compact": FlowConfig, "release": release}


def find_flow_config(name: str) -> FlowConfig:
    """A named configuration. UsageError lists the names."""
    if name not in FLOW_CONFIGS:
        raise UsageError(f"--config {name}: expected one of {', '.join(FLOW_CONFIGS)}")
    return FLOW_CONFIGS[name]()
