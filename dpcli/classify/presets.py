"""Named settings of network and schedule: what the thesis used, what the release used, and what suits a CPU."""

from __future__ import annotations

from dataclasses import dataclass

from dpcli.classify.augment import PRESETS as AUGMENTATIONS
from dpcli.classify.augment import Augmentation
from dpcli.classify.config import KinetConfig
from dpcli.classify.train import Schedule
from dpcli.errors import UsageError


@dataclass(frozen=True)
class Preset:
    """A configuration, a schedule and an augmentation that belong together."""

    config: KinetConfig
    schedule: Schedule
    augmentation: Augmentation


_SMALL = {"centroids": (256, 128), "neighbors": 32, "points_per_frame": 256, "radii": (0.15, 0.5), "normalize": "center",
          "solver": "ridge", "merge_norm": True, "xyz_group": True, "group_size": 3, "dropout": 0.2}  # fmt: skip
_TINY = {**_SMALL, "centroids": (128, 64), "neighbors": 16, "points_per_frame": 128, "dropout": 0.0,
         "widths": ((32, 64), (64, 128), (128, 256))}  # fmt: skip

PRESETS = {
    "thesis": Preset(KinetConfig(), Schedule(), AUGMENTATIONS["peers"]),
    "release": Preset(
        KinetConfig.release(num_frames=32, points_per_frame=128, normalize="image"),
        Schedule((250, 250), batch=8, decay="staircase", validate_every=5), AUGMENTATIONS["release"],
    ),
    "quick": Preset(
        KinetConfig(**_SMALL), Schedule((80, 60), batch=8, weight_decay=0.01, label_smoothing=0.1), AUGMENTATIONS["ours"]
    ),
    "tiny": Preset(
        KinetConfig(**_TINY), Schedule((20, 40), batch=8, learning_rate=2e-3, weight_decay=0.01), AUGMENTATIONS["ours"]
    ),
}  # fmt: skip


def find_preset(name: str) -> Preset:
    """The preset of that name; UsageError lists them."""
    if name not in PRESETS:
        raise UsageError(f"--preset {name}: expected one of {', '.join(PRESETS)}")
    return PRESETS[name]
