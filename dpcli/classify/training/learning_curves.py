"""The picture of a training run."""

from __future__ import annotations

from pathlib import Path

from dpcli.draw.learning_curves import Curve, Panel, draw_learning_curves

COLUMNS = ("stage", "epoch", "loss", "train_accuracy", "validation_accuracy", "learning_rate", "seconds")


_ACCURACIES = (
    Curve("train_accuracy", "training", 100, "tab:blue"),
    Curve("validation_accuracy", "validation", 100, "tab:orange"),
)


def draw_curves(rows: list[dict], path: Path) -> None:
    """Writes loss (left axis) and accuracies in % (right axis) of every stage, over epochs, as a PNG."""
    panels = [
        Panel(
            f"{stage} stream",
            [Curve("loss", "loss", color="0.6")],
            "cross-entropy",
            range=(0, None),
            right=_ACCURACIES,
            right_label="accuracy (%)",
            right_range=(0, 102),
            rows=[row for row in rows if row["stage"] == stage],
        )
        for stage in dict.fromkeys(row["stage"] for row in rows)
    ]
    draw_learning_curves(rows, panels, path, "epoch")
