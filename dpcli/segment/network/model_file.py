"""A part network on disk."""

from __future__ import annotations

import json
from pathlib import Path

from dpcli.runtime.safetensors_file import find_weights, load_state, load_weights, save_weights
from dpcli.segment.network.config import PartConfig
from dpcli.segment.network.part_network import PartNetwork

_FORMAT, _MAKER = "dpc-parts-1", "dpc segment train"
SHIPPED = Path(__file__).parents[1] / "weights"


def save_model(path: Path, model: PartNetwork, notes: dict) -> None:
    """Weights as float32, configuration and notes (a small JSON object) in the header."""
    header = {"format": _FORMAT, "config": model.config.to_json(), "notes": json.dumps(notes, sort_keys=True)}
    save_weights(path, model.state_dict(), header)


def find_model(name: str, option: str = "--model") -> Path:
    """A network's file: a path, `best.safetensors` of a training folder, or a shipped name. UsageError when there is none."""
    return find_weights(name, SHIPPED, _MAKER, option)


def load_model(name: str, option: str = "--model") -> tuple[PartNetwork, dict]:
    """A part network in eval mode and its notes; name: a path, a training folder or a shipped model."""
    path = find_model(name, option)
    tensors, header = load_weights(path, _FORMAT, _MAKER)
    model = PartNetwork(PartConfig.from_json(header["config"]))
    load_state(model, tensors, path)
    return model.eval(), json.loads(header["notes"])
