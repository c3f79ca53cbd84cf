"""A Kinet on disk, with its configuration and class names."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

from torch import nn

from dpcli.classify.network.backbones.interface import BACKBONES
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.kinet import Kinet
from dpcli.errors import UsageError
from dpcli.runtime.weights import find_weights, load_state, load_weights, save_weights


@dataclass
class ModelInfo:
    """Holds what a model file says of itself beside the weights."""

    config: KinetConfig
    class_names: list[str]
    timing: str = "clips"
    notes: dict = field(default_factory=dict)


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
    config = KinetConfig.from_json(header["config"])
    if config.backbone not in BACKBONES and config.backbone != backbone:
        raise UsageError(
            f"{path}: made on the backbone {config.backbone}, which is code of yours; if you trust it, add --backbone {config.backbone}"
        )
    model = Kinet(config)
    load_state(model, tensors, path)
    names, notes = json.loads(header["class_names"]), json.loads(header["notes"])
    return model.eval(), ModelInfo(model.config, names, header["timing"], notes)
