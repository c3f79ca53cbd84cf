"""The picture of a fit's log: PSNR, loss and number of Gaussians over steps."""

from __future__ import annotations

from pathlib import Path

from dpcli.draw.learning_curves import Curve, Panel, draw_learning_curves


def draw_curves(rows: list[dict], path: Path) -> None:
    """Writes three panels of the log's rows as a PNG; a dotted line stands at the last row of the dense stage."""
    sparse = any(row["stage"] == "sparse" for row in rows)
    change = max((row["step"] for row in rows if row["stage"] == "dense"), default=None) if sparse else None
    panels = [
        Panel("PSNR, reference view", [Curve("psnr", "PSNR")], "dB", change=change),
        Panel("loss", [Curve("loss", "loss")], logarithmic=True, change=change),
        Panel("Gaussians", [Curve("gaussians", "Gaussians")], change=change),
    ]
    draw_learning_curves(rows, panels, path, "step")
