"""`dpc segment profile`: what a part network costs."""

from __future__ import annotations

from typing import Any

from dpcli.runtime.device import choose_device
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.segment.network.config import NetworkSettings
from dpcli.segment.network.cost import measure_cost


def profile_network(settings: NetworkSettings, device: str) -> dict[str, Any]:
    """Returns parameters, multiply-adds, latency and memory of a part network with random weights."""
    keep_freed_memory()
    return measure_cost(settings.config(), choose_device(device))
