"""The learning curves of a part network's training."""

from __future__ import annotations

from pathlib import Path

from dpcli.draw.learning_curves import Curve, Panel, draw_learning_curves

COLUMNS = (
    "epoch",
    "pairs",
    "loss",
    "cold_start",
    "dynamic",
    "smooth",
    "motion",
    "mask",
    "invariance",
    "consensus",
    "flow_error",
    "validation_loss",
    "validation_rand_index",
    "learning_rate",
    "seconds",
)


_LOSSES = ("loss", "cold_start", "dynamic", "smooth", "motion", "mask")
_TRUTHS = (
    Curve("validation_rand_index", "Rand index, validation"),
    Curve("flow_error", "flow error, training (diameters)"),
    Curve("consensus", "mean consensus weight"),
)


def draw_curves(rows: list[dict], path: Path) -> None:
    """Draws the loss and its terms (left), validation and flow error where there is a truth (right), over epochs, as a PNG."""
    panels = [
        Panel("training loss and terms", [Curve(name, name) for name in _LOSSES]),
        Panel("agreement with the truth", _TRUTHS, range=(0, 1.02)),
    ]
    draw_learning_curves(rows, panels, path, "epoch")
