"""`dpc segment profile`."""

from __future__ import annotations

import json
from typing import Any

import typer

from dpcli.cli.options import Device, Json
from dpcli.cli.settings_options import options_of
from dpcli.counted import counted
from dpcli.runtime.settings.catalog import Catalog, Given
from dpcli.segment.network.config import NETWORK_PRESETS, NetworkSettings

CATALOG = Catalog(network=NetworkSettings)
PRESETS = {name: {"network": network} for name, network in NETWORK_PRESETS.items()}


@options_of(CATALOG, ("group", "points"), presets=PRESETS, preset="compact")
def profile(given: Given, as_object: Json = False, device: Device = "auto") -> None:
    """Show a part network's true parameters and multiply-adds, the paper's count beside them, latency and memory."""
    network = CATALOG.resolve(PRESETS[str(given.preset)], given)["network"]
    from dpcli.segment.commands.profile import profile_network

    cost = profile_network(network, device)
    typer.echo(json.dumps(cost) if as_object else render_cost(cost))


def render_cost(cost: dict[str, Any]) -> str:
    """Returns the object of `profile_network` as lines for a person."""
    parameters, counts = cost["parameters"], cost["macs_per_frame"]
    parts = ", ".join(f"{key} {value:,}" for key, value in parameters.items() if key != "total")
    paper = cost["paper_style_parameters"]
    shares = ", ".join(f"{key.replace('_', ' ')} {value / 1e6:.0f}" for key, value in counts.items() if key != "total")
    return "\n".join(
        [
            f"part network, {cost['group']} group, {cost['points']} points a frame, {cost['slots']} slots",
            f"parameters    {parameters['total']:,} ({parts})",
            f"  paper style {paper['total']:,}: {paper['rule']}",
            f"multiply-adds {counts['total'] / 1e9:.3f} G per frame (M: {shares})",
            f"  not counted: {cost['uncounted']}",
            f"latency       {cost['latency_ms']['four_frames']} ms for four frames on {cost['device']}"
            f" with {counted(cost['threads'], 'thread')}",
            f"peak memory   {cost['peak_memory_mb']} MB of the process",
        ]
    )
