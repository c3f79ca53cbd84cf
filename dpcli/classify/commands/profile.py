"""`dpc classify profile`: what a network costs."""

from __future__ import annotations

from typing import Any

from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network.model_file import load_model
from dpcli.classify.network_cost import measure
from dpcli.classify.settings import network_config
from dpcli.errors import UsageError
from dpcli.runtime.device import choose_device
from dpcli.runtime.settings.catalog import Given


def profile(model: str | None, given: Given, classes: int, steps: bool, device: str) -> dict[str, Any]:
    """Returns the object of `measure` for a trained model, or without one for an untrained network of a preset's settings.

    given: the preset and changes over it; of a trained model, only the backbone that may be loaded. steps: also time
    training steps.
    """
    chosen = choose_device(device)
    if model:
        network = load_model(model, given.values.get("backbone"))[0]
    else:
        network = Kinet(network_config(given, classes)).eval()
    if network.config.backbone == "slots":
        raise UsageError(
            "profile counts the operations of neighborhoods, and the backbone slots has none; give another"
        )
    return measure(network.to(chosen), chosen, steps)
