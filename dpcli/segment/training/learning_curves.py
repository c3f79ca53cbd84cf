"""The learning curves of a part network's training."""

from __future__ import annotations

from pathlib import Path

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


def draw_curves(rows: list[dict], path: Path) -> None:
    """Draws the loss and its terms (left), validation and flow error (right), over epochs, as a PNG.

    Of validation and flow error only what the truth of the data lets us know is drawn.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(10.5, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    for key in ("loss", "cold_start", "dynamic", "smooth", "motion", "mask"):
        _line(left, rows, key)
    _line(right, rows, "validation_rand_index", "Rand index, validation")
    _line(right, rows, "flow_error", "flow error, training (diameters)")
    _line(right, rows, "consensus", "mean consensus weight")
    left.set(title="training loss and terms", xlabel="epoch")
    right.set(title="what is known of the truth", xlabel="epoch", ylim=(0, 1.02))
    for axes in (left, right):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        if axes.get_lines():
            axes.legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=120)


def _line(axes, rows: list[dict], key: str, label: str | None = None) -> None:
    known = [(row["epoch"], row[key]) for row in rows if row.get(key) is not None]
    if known:
        axes.plot(*zip(*known), label=label or key, marker="." if len(known) < 30 else None)
