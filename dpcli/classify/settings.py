"""The settings of a network and of a training run, made from a preset and a user's choices over it.

Each choice is a field of a dataclass: `network/config.py`, `training/schedule.py`, `data/augment.py`, `training/run_settings.py`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from dpcli.classify.data.augment import AUGMENTATIONS, Augmentation
from dpcli.classify.network.config import CROSS, KinetConfig
from dpcli.classify.presets import BACKBONE_CHANGES, PRESETS, VARIANT_CHANGES, backbone_changes
from dpcli.classify.training.run_settings import RunSettings
from dpcli.classify.training.schedule import Schedule
from dpcli.errors import UsageError
from dpcli.runtime.settings.catalog import Catalog, Given
from dpcli.runtime.settings.fields import settings_of

NETWORK = Catalog(network=KinetConfig)
TRAINING = Catalog(network=KinetConfig, schedule=Schedule, augmentation=Augmentation, run=RunSettings)
NETWORK_PRESETS = {name: {"network": groups["network"]} for name, groups in PRESETS.items()}


@dataclass(frozen=True)
class TrainingSettings:
    """Holds all settings of a training run.

    Raises UsageError where an augmentation of the speed meets clips whose frames are chosen otherwise, or a network those of
    another kind.
    """

    network: KinetConfig
    schedule: Schedule
    augmentation: Augmentation
    run: RunSettings

    def __post_init__(self) -> None:
        speed = self.augmentation.speed
        if speed and (self.run.timing == "uniform" or not self.schedule.clips_per_video):
            raise UsageError(
                f"augment_speed = {speed:g}: speed changes random clips of consecutive frames; leave it out with --timing"
                " uniform or clips_per_video = 0"
            )
        if self.run.validation == CROSS and self.network.members < 2:
            raise UsageError(
                "--validation cross: needs a network of several members, as preset sparse has; give another rule"
            )
        if self.schedule.fine_tune != "all" and not self.run.init:
            raise UsageError(f"--fine-tune {self.schedule.fine_tune}: needs a model to start from; name it with --init")
        slots = self.network.backbone == "slots"
        if slots != (self.run.timing == "slots") or (slots and self.schedule.epochs_dynamic):
            raise UsageError(
                f"backbone = {self.network.backbone} with timing = {self.run.timing} and epochs_dynamic ="
                f" {self.schedule.epochs_dynamic}: slots belongs to slots, and has no dynamic stream; take --preset sparse"
            )

    def to_toml(self, command: str) -> str:
        """Returns the settings as TOML, which `--config` reads back. command: the words that the first line names."""
        return TRAINING.to_toml({one.name: getattr(self, one.name) for one in fields(self)}, command)


def network_config(given: Given, classes: int) -> KinetConfig:
    """Returns the preset's network with what was given over it, for so many classes. Raises UsageError where it doesn't fit."""
    base = NETWORK_PRESETS[given.preset or ""]
    return NETWORK.resolve(base, Given(config=_all_values(given)))["network"].changed(num_classes=classes)


def training_settings(given: Given, base: Mapping[str, Any] | None = None) -> TrainingSettings:
    """Returns the preset's settings, or those of other groups, with what was given over them.

    Raises UsageError where they don't fit together.
    """
    values = _all_values(given)
    if values.get("pretrain"):
        if values.get("frames", 1) != 1 or values.get("epochs_dynamic", 0) != 0:
            raise UsageError(
                "pretrain trains the static stream on clips of one frame; leave out --frames and epochs_dynamic"
            )
        values |= {"frames": 1, "temporal_radius": 0, "epochs_dynamic": 0}  # a single cloud a video
    return TrainingSettings(**TRAINING.resolve(base or PRESETS[given.preset or ""], Given(config=values)))


def about_unread(settings: TrainingSettings, typed: Collection[str]) -> list[str]:
    """Returns a sentence for each setting of the command line, by public name, that changes nothing beside the others."""
    reasons: dict[str, str] = {}
    for applies, names, why in _unread_rules(settings):
        for name in sorted(set(names) & set(typed)) if applies else ():
            reasons.setdefault(name, why)
    return [f"{name} changes nothing: {why}; leave it out" for name, why in reasons.items()]


def _unread_rules(settings: TrainingSettings) -> list[tuple[bool, Collection[str], str]]:
    """Returns whether a rule applies, the settings that are then unread, and why. A user's own backbone reads what it likes."""
    network, schedule, change, run = settings.network, settings.schedule, settings.augmentation, settings.run
    slots, graph = network.backbone == "slots", network.backbone in BACKBONE_CHANGES
    return [
        (slots, set(_PUBLIC[KinetConfig].values()) - _READ_BY_SLOTS, "the backbone slots doesn't read it"),
        (slots, ("drop_short", "augment_still"), "a clip of the backbone slots is a whole video"),
        (graph, ("centroids", "radius"), f"{network.backbone} takes the nearest neighbors of every point"),
        (
            graph and network.grouping == "first",
            ("grouping",),
            f"{network.backbone} takes the nearest neighbors, or balanced ones",
        ),
        (not slots and network.solver == "ridge", ("guard",), "solver = ridge needs no guard"),
        (not slots and not network.normals, ("solver", "guard", "weighting"), "normals = false fits no surfaces"),
        (not slots and network.merge == "cross", ("merge_norm",), "merge = cross has no batch norm"),
        (run.pretrain, ("temporal_radius",), "clips of pretrain have one frame"),
        (
            run.timing == "clips",
            ("augment_crop",),
            "clips of consecutive frames are never all of a video (--timing uniform)",
        ),
        (not change.scale, ("augment_per_axis",), "augment_scale = 0"),
        (
            not (change.scale or change.turn or change.tilt or change.warp),
            ("augment_origin",),
            "no augmentation scales or turns",
        ),
        (not schedule.epochs_dynamic, ("lr_dynamic", "draws"), "there is no dynamic stage"),
        (run.validation == "none", ("validate_every", "validation_clips"), "no video validates"),
    ]


def with_classes(settings: TrainingSettings, classes: int) -> TrainingSettings:
    """Returns the settings with a network for so many classes."""
    return replace(settings, network=settings.network.changed(num_classes=classes))


def _all_values(given: Given) -> dict[str, Any]:
    """Returns every value that stands over the preset's, by public name: what is given, and below it what that implies."""
    typed = {**given.sets, **given.flags}
    config = {
        name: value
        for name, value in given.config.items()
        if not any(name in members and _changes(head, given.config, typed) for head, members in _IMPLIED.items())
    }
    values = {**config, **typed}
    return {**_implied_values(values, given.preset or ""), **values}


def _implied_values(values: Mapping[str, Any], preset: str) -> dict[str, Any]:
    """Returns what the settings that stand for several imply, by public name."""
    network: dict[str, Any] = {}
    if values.get("variant", PRESETS[preset]["network"].variant) != PRESETS[preset]["network"].variant:
        network |= VARIANT_CHANGES[values["variant"]]
    if "backbone" in values:
        network |= backbone_changes(preset, values["backbone"])
    if values.get("normals") is False:
        network["weighting"] = "none"
    implied = {_PUBLIC[KinetConfig][key]: value for key, value in network.items()}
    if "augment" in values:
        named = AUGMENTATIONS[values["augment"]]
        implied |= {name: getattr(named, field) for field, name in _PUBLIC[Augmentation].items()}
    return implied


def _changes(name: str, config: Mapping[str, Any], typed: Mapping[str, Any]) -> bool:
    """Returns whether the command line says another value of a setting than the file of settings."""
    return name in typed and typed[name] != config.get(name)


_PUBLIC = {cls: {one.field: one.name for one in settings_of(cls)} for cls in (KinetConfig, Augmentation)}
# Settings that stand for several, with those several: where the command line changes one, a file's values of these give way.
_IMPLIED = {
    "variant": {_PUBLIC[KinetConfig][key] for key in VARIANT_CHANGES["release"]},
    "backbone": {
        _PUBLIC[KinetConfig][key] for of in BACKBONE_CHANGES.values() for changes in of.values() for key in changes
    },
    "normals": {"weighting"},
    "augment": set(_PUBLIC[Augmentation].values()),
}
_READ_BY_SLOTS = {"frames", "points", "backbone", "widths", "dropout", "members", "copies", "slot_details"}
