"""The weights file of a part network, and the weights that come with the package."""

from __future__ import annotations

from pathlib import Path

from dpcli.errors import UsageError
from dpcli.runtime.weights import find_weights, load_network, network_header, save_weights, shipped_models
from dpcli.segment.network.config import PartConfig
from dpcli.segment.network.part_network import PartNetwork

_FORMAT, _MAKER = "dpc-parts-1", "dpc segment train"
SHIPPED = Path(__file__).parents[1] / "weights"


def save_model(path: Path, model: PartNetwork, notes: dict) -> None:
    """Writes the weights as float32, with the configuration and notes (a small JSON object) in the header."""
    save_weights(path, model.state_dict(), network_header(_FORMAT, model.config, notes))


def find_model(name: str | Path, option: str = "--model") -> Path:
    """Returns the file that a name means: a path, `best.safetensors` of a training folder, or a shipped name.

    option: what messages call the name. Raises UsageError when there is none.
    """
    return find_weights(name, SHIPPED, _MAKER, option)


def load_model(name: str | Path) -> tuple[PartNetwork, dict]:
    """Returns a part network in eval mode and its notes; name: what `find_model` found or takes.

    Raises DataError for a damaged file.
    """
    return load_network(find_model(name), _FORMAT, _MAKER, PartConfig, PartNetwork)


def default_model() -> str:
    """Returns the shipped model used when none is named. Raises UsageError when this installation has none."""
    names = shipped_models(SHIPPED)
    if not names:
        raise UsageError(
            "no trained part network comes with this installation; train one (`dpc segment train`) and name it with --model"
        )
    return names[0]
