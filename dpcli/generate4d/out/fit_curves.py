"""The picture of a fit's log: PSNR, loss and number of Gaussians over steps."""

from __future__ import annotations

from pathlib import Path


def draw_curves(rows: list[dict], path: Path) -> None:
    """Write three small plots of the log's rows as one PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3), layout="constrained")
    axes = figure.subplots(1, 3)
    steps = [row["step"] for row in rows]
    change = next((row["step"] for row in rows if row["stage"] == "sparse"), None)
    for axis, key, label in zip(
        axes, ("psnr", "loss", "gaussians"), ("PSNR, reference view (dB)", "loss", "Gaussians")
    ):
        axis.plot(steps, [row[key] for row in rows])
        axis.set(xlabel="step", title=label)
        if change is not None:
            axis.axvline(change, color="0.6", linestyle=":")
    axes[1].set_yscale("log")
    figure.savefig(path, format="png", dpi=100)
