"""The sizes of the flow network, the settings of its training, and their two presets; nothing here needs torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dpcli.runtime.settings.catalog import Catalog
from dpcli.runtime.settings.fields import WIDEST, Settings, setting
from dpcli.runtime.settings.stored import StoredConfig


@dataclass(frozen=True)
class FlowConfig(StoredConfig, Settings):
    """Holds the widths and neighborhoods of a flow network; defaults are `compact`, ours, for training on a CPU.

    Lengths are in diameters of the object.
    """

    local: tuple[int, int] = setting((24, 48), "Channels of the levels of N/2 and N/4 points.", least=1, most=WIDEST)
    deep: tuple[int, int] = setting(
        (64, 96),
        "Channels of the levels of N/8 and N/16 points, which the global match compares.",
        least=1,
        most=WIDEST,
    )
    hidden: int = setting(64, "Width of the gated recurrent unit.", least=1, most=WIDEST)
    head: int = setting(48, "Width of the layers that regress the flow.", least=1, most=WIDEST)
    neighbors: int = setting(16, "Neighbors in a set convolution.", least=1, most=2048)
    correlated: int = setting(
        8, "Nearest points of the other frame that a warped point is compared with.", least=1, most=2048
    )
    radius: float = setting(
        0.1, "Distance beyond which such a point is replaced by the nearest, in diameters.", above=0
    )
    iterations: int = setting(4, "Estimates of the flow: the global match, then corrections.", least=1, most=1000)
    norm: Literal["layer", "batch"] = setting("layer", "Normalization of the layers.")
    support: float = setting(10.0, "Largest distance of the global match, in diameters.", above=0)


@dataclass(frozen=True)
class FlowSchedule(Settings):
    """Holds how long a flow network learns."""

    steps: int = setting(2000, "Steps of the optimizer.", least=1)
    batch: int = setting(8, "Pairs per step.", least=1)
    points: int = setting(512, "Points of each frame that the network sees in training.", least=32)


def release() -> FlowConfig:
    """Returns the widths stated for FlowStep3D on SAPIEN.

    What is known of it leaves joints open, so the count differs from its 629,207 parameters, and its checkpoints don't
    load.
    """
    return FlowConfig(local=(32, 64), deep=(128, 256), hidden=128, head=128, norm="batch")


CATALOG = Catalog(network=FlowConfig, schedule=FlowSchedule)
PRESETS = {
    "compact": {"network": FlowConfig(), "schedule": FlowSchedule()},
    "release": {"network": release(), "schedule": FlowSchedule()},
}
