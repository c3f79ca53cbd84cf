"""The learning curves of a shape network's training."""

from __future__ import annotations

from pathlib import Path

from dpcli.draw.learning_curves import Curve, Panel, draw_learning_curves

COLUMNS = (
    "step",
    "loss",
    "depth",
    "angles",
    "second",
    "validation_loss",
    "validation_inflated",
    "validation_angle",
    "validation_length",
    "learning_rate",
    "seconds",
)


def draw_curves(rows: list[dict], path: Path) -> None:
    """Draws errors of depth (left) and the turn of the whole (right) over steps, as a PNG."""
    panels = [
        Panel(
            "error of the layers (sides of the picture)",
            [
                Curve("depth", "training"),
                Curve("validation_loss", "held-out models"),
                Curve("validation_inflated", "inflation, held-out models"),
            ],
        ),
        Panel("error of the turn of the whole (degrees)", [Curve("validation_angle", "held-out models")]),
    ]
    draw_learning_curves(rows, panels, path, "step")
