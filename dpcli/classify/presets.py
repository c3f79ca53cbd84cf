"""Named settings of network and schedule: what the thesis used, what the release used, and what suits a CPU."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dpcli.classify.data.augment import PRESETS as AUGMENTATIONS
from dpcli.classify.data.augment import Augmentation
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.training.schedule import Schedule
from dpcli.errors import UsageError


@dataclass(frozen=True)
class Preset:
    """A configuration, a schedule and an augmentation that belong together."""

    config: KinetConfig
    schedule: Schedule
    augmentation: Augmentation


_SMALL = {
    "centroids": (256, 128),
    "neighbors": 32,
    "points_per_frame": 256,
    "radii": (0.15, 0.5),
    "normalize": "center",
    "solver": "ridge",
    "merge_norm": True,
    "xyz_group": True,
    "group_size": 3,
    "dropout": 0.2,
}
_TINY = {
    **_SMALL,
    "centroids": (128, 64),
    "neighbors": 16,
    "points_per_frame": 128,
    "dropout": 0.0,
    "widths": ((32, 64), (64, 128), (128, 256)),
}

PRESETS = {
    "thesis": Preset(KinetConfig(static_temporal_radius=0), Schedule(), AUGMENTATIONS["peers"]),
    "release": Preset(
        KinetConfig.release(num_frames=32, points_per_frame=128, normalize="image"),
        Schedule((250, 250), batch=8, decay="staircase", validate_every=5),
        AUGMENTATIONS["release"],
    ),
    "quick": Preset(
        KinetConfig(**_SMALL),
        Schedule((80, 60), batch=8, weight_decay=0.01, label_smoothing=0.1),
        AUGMENTATIONS["ours"],
    ),
    "tiny": Preset(
        KinetConfig(**_TINY), Schedule((20, 40), batch=8, learning_rate=2e-3, weight_decay=0.01), AUGMENTATIONS["ours"]
    ),
}


def find_preset(name: str) -> Preset:
    """The preset of that name; UsageError lists them."""
    if name not in PRESETS:
        raise UsageError(f"--preset {name}: expected one of {', '.join(PRESETS)}")
    return PRESETS[name]


_GRAPH = {
    "neighbors": 20,
    "grouping": "balanced",
    "merge": "residual",
    "static_temporal_radius": None,
}  # the release's merge pairs PointNet++'s two stages, as two sets of neighborhoods do
_FULL = {**_GRAPH, "head": (512, 1024), "points_per_frame": 128}
_DGCNN = {**_FULL, "widths": ((64, 64, 64, 128), (1024,), (64, 128, 1024, 512, 256), (512, 256)), "dropout": 0.5}
_SPIDER = {**_FULL, "widths": ((32, 64, 128, 256), (5,), (1024, 512)), "dropout": 0.7}
_QUICK = {**_GRAPH, "head": (128, 512), "points_per_frame": 128, "reduction": 1.0}  # narrow layers: nothing to reduce
_TINIER = {
    **_GRAPH,
    "head": (64, 128),
    "neighbors": 12,
    "points_per_frame": 96,
}  # with 32 the dynamic stream stayed at chance

# What a preset's configuration changes for a backbone whose vertices are all points of a clip: published sizes and as many
# points as the multiply-adds of table A.1 imply, or narrower and fewer where a CPU trains.
BACKBONE_CHANGES: dict[str, dict[str, dict[str, Any]]] = {
    "dgcnn": {
        "thesis": _DGCNN,
        "release": _DGCNN,
        "quick": {**_QUICK, "widths": ((32, 32, 64), (1024,), (16, 32, 64, 32, 16), (256, 128))},
        "tiny": {**_TINIER, "widths": ((16, 32), (128,), (16, 32, 64, 32, 16), (64, 32))},
    },
    "spidercnn": {
        "thesis": _SPIDER,
        "release": _SPIDER,
        "quick": {**_QUICK, "widths": ((16, 32, 64), (3,), (256, 128))},
        "tiny": {**_TINIER, "widths": ((16, 32), (3,), (64, 32))},
    },
}


def with_backbone(config: KinetConfig, preset: str, backbone: str) -> KinetConfig:
    """A preset's configuration on another backbone, with `BACKBONE_CHANGES`; a user's own (`module:Class`) changes nothing
    else and reads from the configuration what it wants."""
    return config.changed(backbone=backbone, **BACKBONE_CHANGES.get(backbone, {}).get(preset, {}))
