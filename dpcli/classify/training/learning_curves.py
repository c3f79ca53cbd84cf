"""The picture of a training run."""

from __future__ import annotations

from pathlib import Path

COLUMNS = ("stage", "epoch", "loss", "train_accuracy", "validation_accuracy", "learning_rate", "seconds")


def draw_curves(rows: list[dict], path: Path) -> None:
    """Loss (left axis, log) and accuracies in % (right axis) of every stage, over epochs, as a PNG."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    stages = list(dict.fromkeys(row["stage"] for row in rows))
    figure = Figure(figsize=(5.6 * len(stages), 3.8), layout="constrained")
    for panel, stage in enumerate(stages):
        mine = [row for row in rows if row["stage"] == stage]
        epochs = [row["epoch"] for row in mine]
        axes = figure.add_subplot(1, len(stages), panel + 1)
        axes.plot(epochs, [row["loss"] for row in mine], color="0.6", label="loss")
        axes.set(title=f"{stage} stream", xlabel="epoch", ylabel="cross-entropy")
        axes.set_ylim(bottom=0)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        right = axes.twinx()
        right.plot(epochs, [100 * row["train_accuracy"] for row in mine], color="tab:blue", label="training")
        known = [
            (e, 100 * row["validation_accuracy"])
            for e, row in zip(epochs, mine)
            if row["validation_accuracy"] is not None
        ]
        if known:
            right.plot(*zip(*known), color="tab:orange", marker=".", label="validation")
        right.set(ylabel="accuracy (%)", ylim=(0, 102))
        lines = axes.get_lines() + right.get_lines()
    figure.legend(
        lines, [line.get_label() for line in lines], loc="outside lower center", ncols=len(lines), frameon=False
    )
    figure.savefig(path, dpi=120)
