"""From a preset and the options over it to a configuration and a schedule."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from dpcli.classify.network.backbones.interface import BACKBONES
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.presets import find_preset, with_backbone
from dpcli.classify.training.schedule import Schedule
from dpcli.errors import UsageError
from dpcli.runtime.device import cpu_count
from dpcli.runtime.mixed_precision import wanted

_RELEASE = {
    key: getattr(KinetConfig.release(), key)
    for key in (
        "variant",
        "group_size",
        "xyz_group",
        "time_input",
        "weighting",
        "merge",
        "guard",
        "fusion",
        "grouping",
        "static_temporal_radius",
    )
}


def network_config(
    preset: str, variant: str | None, changes: dict[str, Any], classes: int, backbone: str | None = None
) -> KinetConfig:
    """The preset's configuration, the variant's and the backbone's choices over it, explicit options over all."""
    config = find_preset(preset).config
    if variant == "release":
        config = config.changed(**_RELEASE)
    elif variant not in (None, "thesis"):
        raise UsageError(f"--variant {variant}: expected thesis or release")
    if backbone in BACKBONES:
        config = with_backbone(config, preset, backbone)
    elif backbone is not None:
        config = config.changed(backbone=backbone, static_temporal_radius=None)  # PointNet++'s alone
    return config.changed(num_classes=classes, **{key: value for key, value in changes.items() if value is not None})


def training_schedule(preset: str, changes: dict[str, Any], device: torch.device) -> Schedule:
    """The preset's schedule with the options that were given; on a CPU clips are loaded in the same process."""
    base = find_preset(preset).schedule
    epochs = tuple(new if new is not None else old for new, old in zip(changes.pop("epochs"), base.epochs))
    clips = changes.pop("clips_per_video") or None
    workers = changes.pop("workers")
    workers = workers if workers is not None else (0 if device.type == "cpu" else min(4, cpu_count()))
    amp = wanted(changes.pop("amp"), device)
    given = {key: value for key, value in changes.items() if value is not None}
    return replace(base, epochs=epochs, clips_per_video=clips, workers=workers, amp=amp, **given)
