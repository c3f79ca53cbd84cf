"""A part network on disk."""

from __future__ import annotations

import json
from pathlib import Path

from dpcli.runtime.weights import find_weights, load_state, load_weights, save_weights
from dpcli.segment.network.config import PartConfig
from dpcli.segment.network.part_network import PartNetwork

_FORMAT, _MAKER = "dpc-parts-1", "dpc segment train"
SHIPPED = Path(__file__).parents[1] / "weights"


def save_model(path: Path, model: PartNetwork, notes: dict) -> None:
    """Weights as float32, configuration and notes (a small JSON object) in the header."""
    header = {"format": _FORMAT, "config": model.config.to_json(), "notes": json.dumps(notes, sort_keys=True)}
    save_weights(path, model.state_dict(), header)


def find_model(name: str | Path, option: str = "--model") -> Path:
    """Returns a network's file, as `find_weights`: of a path, a training folder or a shipped name. UsageError if there is none."""
    return find_weights(name, SHIPPED, _MAKER, option)


def load_model(name: str | Path) -> tuple[PartNetwork, dict]:
    """Returns a part network in eval mode and its notes; name: what `find_model` found or takes."""
    path = find_model(name)
    tensors, header = load_weights(path, _FORMAT, _MAKER)
    model = PartNetwork(PartConfig.from_json(header["config"]))
    load_state(model, tensors, path)
    return model.eval(), json.loads(header["notes"])
