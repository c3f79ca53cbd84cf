"""Settings that belong together: the presets, and what a variant or a backbone changes in them.

A preset is what the thesis used, what its published code uses, or what suits a CPU. `settings.py` puts a user's choices over one.
"""

from __future__ import annotations

from typing import Any

from dpcli.classify.data.augment import AUGMENTATIONS
from dpcli.classify.network.config import RELEASE, KinetConfig
from dpcli.classify.training.run_settings import RunSettings
from dpcli.classify.training.schedule import Schedule

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


_SPARSE = {
    "backbone": "slots",
    "num_frames": 16,
    "points_per_frame": 24,
    "widths": ((64, 64), (96,)),
    "dropout": 0.4,
    "members": 4,
    "copies": True,
    "slot_details": True,
}


def _preset(network: KinetConfig, schedule: Schedule, augment: str, **run_settings: Any) -> dict[str, Any]:
    """Returns the groups of settings of a preset with the augmentation of that name."""
    run = RunSettings(augment=augment, **run_settings)
    return {"network": network, "schedule": schedule, "augmentation": AUGMENTATIONS[augment], "run": run}


PRESETS = {
    "thesis": _preset(KinetConfig(static_temporal_radius=0), Schedule(), "peers"),
    "release": _preset(
        KinetConfig.release(num_frames=32, points_per_frame=128, normalize="image"),
        Schedule(250, 250, batch=8, decay="staircase", validate_every=5),
        "release",
    ),
    "quick": _preset(KinetConfig(**_SMALL), Schedule(80, 60, batch=8, weight_decay=0.01, label_smoothing=0.1), "ours"),
    "long": _preset(
        KinetConfig(**_SMALL),
        Schedule(40, 30, batch=32, weight_decay=0.01, label_smoothing=0.1, clips_per_video=4, video_loss=True),
        "ours",
    ),
    "tiny": _preset(KinetConfig(**_TINY), Schedule(20, 40, batch=8, learning_rate=2e-3, weight_decay=0.01), "ours"),
    "sparse": _preset(
        KinetConfig(**_SPARSE),
        Schedule(
            50,
            0,
            batch=128,
            learning_rate=2e-3,
            weight_decay=0.02,
            label_smoothing=0.1,
            clips_per_video=16,
            validate_every=10,
        ),
        "sparse",
        timing="slots",
    ),
}

# What `variant` means: the fields in which the published code differs from the thesis's text, with the values of each.
VARIANT_CHANGES: dict[str, dict[str, Any]] = {
    name: {key: getattr(config, key) for key in (*RELEASE, "static_temporal_radius")}
    for name, config in (("thesis", KinetConfig()), ("release", KinetConfig.release()))
}

# the release's merge pairs PointNet++'s two stages, as two sets of neighborhoods do
_GRAPH = {"neighbors": 20, "grouping": "balanced", "merge": "residual", "static_temporal_radius": None}
_FULL = {**_GRAPH, "head": (512, 1024), "points_per_frame": 128}
_DGCNN = {**_FULL, "widths": ((64, 64, 64, 128), (1024,), (64, 128, 1024, 512, 256), (512, 256)), "dropout": 0.5}
_SPIDER = {**_FULL, "widths": ((32, 64, 128, 256), (5,), (1024, 512)), "dropout": 0.7}
_QUICK = {**_GRAPH, "head": (128, 512), "points_per_frame": 128, "reduction": 1.0}  # narrow layers: nothing to reduce
# with 32 points a frame the dynamic stream stayed at chance
_TINIER = {**_GRAPH, "head": (64, 128), "neighbors": 12, "points_per_frame": 96}

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


def backbone_changes(preset: str, backbone: str) -> dict[str, Any]:
    """Returns the fields of a preset's network that change with the backbone, by name.

    A user's own (`module:Class`) shares one set of neighborhoods between both streams, and reads those of the other fields that it needs.
    """
    if backbone == "pointnet2":
        return {"backbone": backbone}
    preset = "quick" if preset == "long" else preset  # one network
    return {"backbone": backbone, "static_temporal_radius": None, **BACKBONE_CHANGES.get(backbone, {}).get(preset, {})}
