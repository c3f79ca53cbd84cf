"""A Kinet on disk, with its configuration and class names."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

from torch import nn

from dpcli.classify.network.backbones.interface import BACKBONES
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.kinet import STREAMS, Kinet
from dpcli.errors import DataError, UsageError
from dpcli.runtime.weights import fill_network, find_weights, header_settings, header_value, load_weights, save_weights


@dataclass
class ModelInfo:
    """Holds what a model file says of itself beside the weights."""

    config: KinetConfig
    class_names: list[str]
    timing: str = "clips"
    notes: dict = field(default_factory=dict)

    @property
    def streams(self) -> tuple[str, ...]:
        """Returns the names of the streams that were trained."""
        return tuple(self.notes.get("streams", STREAMS))


_FORMAT, _MAKER = "dpc-kinet-1", "dpc classify train"
SHIPPED = Path(__file__).parents[1] / "weights"


def save_model(path: Path, model: nn.Module, info: ModelInfo) -> None:
    """Writes the weights as float32; configuration, class names and notes in the header."""
    header = {
        "format": _FORMAT,
        "config": info.config.to_json(),
        "timing": info.timing,
        "class_names": json.dumps(info.class_names),
        "notes": json.dumps(info.notes, sort_keys=True),
    }
    save_weights(path, model.state_dict(), header)


def find_model(name: str | Path, option: str = "--model") -> Path:
    """Returns a model's file: a path, `best.safetensors` of a training folder, or a shipped name. Raises UsageError when there is none."""
    return find_weights(name, SHIPPED, _MAKER, option)


def load_model(name: str | Path, backbone: str | None = None) -> tuple[Kinet, ModelInfo]:
    """Returns a Kinet in eval mode; name: what `find_model` found or takes.

    Raises DataError when the file is not one of ours or its weights don't fit its configuration.

    A model on a user's own backbone (`module:Class`) needs that name typed again: a weights file must not have code run.
    """
    path = find_model(name)
    tensors, header = load_weights(path, _FORMAT, _MAKER)
    config = header_settings(path, header, KinetConfig)
    if config.backbone not in BACKBONES and ":" not in config.backbone:
        raise DataError(f"{path}: backbone = {config.backbone!r:.80}, expected {', '.join(BACKBONES)}; copy it again")
    if config.backbone not in BACKBONES and config.backbone != backbone:
        raise UsageError(
            f"{path}: made on the backbone {config.backbone}, which is code of yours; if you trust it, add --backbone {config.backbone}"
        )
    notes, names = (header_value(path, header, *one) for one in (("notes", dict), ("class_names", list)))
    timing = header.get("timing")
    if timing not in ("clips", "uniform", "slots"):
        raise DataError(f"{path}: timing = {timing!r}, expected clips, uniform or slots; copy it again")
    if len(names) != config.num_classes or not all(map(_is_text, names)):
        raise DataError(f"{path}: class_names = {names!r:.80}, expected {config.num_classes} names; copy it again")
    streams = notes.get("streams", list(STREAMS))
    if streams not in (list(STREAMS), ["static"]):
        raise DataError(
            f"{path}: streams = {streams!r:.80} in its notes, expected {', '.join(STREAMS)} or static alone"
        )
    network = fill_network(lambda: Kinet(config), tensors, path)
    return network, ModelInfo(config, names, timing, notes)


def _is_text(name: object) -> bool:
    """Returns whether a name is one that a `clouds` file can hold, such as one with a no-break space or a joiner, too."""
    return isinstance(name, str) and "\0" not in name
