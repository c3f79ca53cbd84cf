"""The choice of the shape prior that `--prior` asks for."""

from __future__ import annotations

from dpcli.generate4d.config import Prior
from dpcli.generate4d.shape.guidance import ShapeGuidance
from dpcli.generate4d.shape.layers import ShapePrior
from dpcli.generate4d.shape.learned import Network
from dpcli.generate4d.shape.model_file import DEFAULT, SHIPPED
from dpcli.generate4d.shape.silhouette import Inflated
from dpcli.generate4d.targets import Targets
from dpcli.runtime.progress import log
from dpcli.runtime.weights import shipped_models

LEAST_CONFIDENCE = 0.5  # below it the object is unlike the creatures that the network knows


def guide(prior: Prior, targets: Targets, model: str | None = None) -> ShapeGuidance | None:
    """Returns the shape that guides a fit with this prior, or None where something else does, or nothing.

    `auto` takes the network where it is there and its confidence is at least LEAST_CONFIDENCE, else the inflated
    silhouette, and says so. model: other weights than the shipped. Raises UsageError for weights that aren't there.
    """
    if model is not None and prior in ("none", "inflated", "views"):
        log.warn(f"--prior-model {model}: is not read with --prior {prior}; give --prior network")
    if prior not in ("auto", "inflated", "network"):
        return None
    network = _network(prior, model) if prior != "inflated" else None
    if network is not None:
        guided = ShapeGuidance(network, targets)
        if prior == "network" or guided.confidence >= LEAST_CONFIDENCE:
            inflated = ShapeGuidance(Inflated(), targets)
            log.info(
                f"shape: {guided.name}, confidence {guided.confidence:.2f}; the depth is {guided.depth_share:.1f} times the"
                f" larger side in the picture ({inflated.depth_share:.1f} with --prior inflated)"
            )
            return guided
        log.info(
            f"shape: inflated silhouette; the network knows creatures, and this looks like none (confidence {guided.confidence:.2f})"
        )
    elif prior == "auto":
        log.info("shape: inflated silhouette; this installation has no shape network")
    return ShapeGuidance(Inflated(), targets)


def _network(prior: Prior, model: str | None) -> ShapePrior | None:
    """Returns the shape network; for `auto` None where no weights were shipped and none were named."""
    if prior == "auto" and model is None and DEFAULT not in shipped_models(SHIPPED):
        return None
    return Network(model or DEFAULT)
