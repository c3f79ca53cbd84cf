"""The weights file of a shape network: half precision, with its configuration and what its confidence means."""

from __future__ import annotations

import functools
from math import isfinite
from pathlib import Path
from typing import Any

from dpcli.errors import DataError
from dpcli.generate4d.shape.config import ShapeConfig
from dpcli.generate4d.shape.network import ShapeNetwork
from dpcli.runtime.weights import find_weights, load_network, network_header, save_weights

_FORMAT, _MAKER = "dpc-shape-2", "dpc generate4d train-prior"
SHIPPED = Path(__file__).parent / "weights"
_LARGEST = 4096  # pixels
DEFAULT = "creatures"  # the shipped network


def save_shape_model(path: Path, model: ShapeNetwork, notes: dict[str, Any]) -> None:
    """Writes the weights as float16; notes: a small JSON object, `size` and `confidence` among it."""
    state = {name: value.half() if value.is_floating_point() else value for name, value in model.state_dict().items()}
    save_weights(path, state, network_header(_FORMAT, model.config, notes))


def find_shape_model(name: str | Path) -> Path:
    """Returns the weights file that a name means: a file, a training folder or a shipped network. Raises UsageError."""
    return find_weights(name, SHIPPED, _MAKER, "--prior-model")


def load_shape_model(name: str | Path) -> tuple[ShapeNetwork, dict[str, Any]]:
    """Returns a shape network in eval mode, and its notes. Raises DataError for a damaged file or one of another kind."""
    path = find_shape_model(name)
    return _read(path, path.stat().st_mtime_ns)


@functools.lru_cache(maxsize=1)
def _read(path: Path, _changed: int) -> tuple[ShapeNetwork, dict[str, Any]]:
    """Returns the network and notes of a file; `_changed`, its time of change, is there for the cache."""
    network, notes = load_network(path, _FORMAT, _MAKER, ShapeConfig, ShapeNetwork)
    size, confidence, count = notes.get("size"), notes.get("confidence"), network.config.widths[-1] + 1
    numbers = confidence if isinstance(confidence, list) else []
    if (
        type(size) is not int
        or not 16 <= size <= _LARGEST
        or len(numbers) != count
        or not all(map(_is_number, numbers))
    ):
        raise DataError(
            f"{path}: its notes say size {size!r:.40} and confidence {confidence!r:.40}, expected pixels and {count} numbers;"
            " copy it again"
        )
    return network, notes


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and isfinite(value)
