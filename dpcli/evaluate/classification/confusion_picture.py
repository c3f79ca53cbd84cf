"""The confusion matrix as a picture, legible from 2 to some 100 classes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.evaluate.classification.protocol import ClassificationReport
from dpcli.evaluate.classification.tables import percent
from dpcli.evaluate.proportions import divide
from dpcli.runtime.whole_file import FIGURES, check_target

_INCH_PER_CLASS = 0.30  # a cell holds three digits at this size
_SMALLEST = 3.2  # inches of matrix, however few the classes
_LONGEST_NAME = 28  # characters of a class name on an axis


def check_picture(path: Path) -> None:
    """`check_target` for the figures of this package."""
    check_target(path, "--picture", FIGURES)


def confusion_picture(report: ClassificationReport, path: Path) -> None:
    """Draw the confusion matrix of the main scores: color = share of the row's truth, number = samples."""
    from matplotlib.figure import Figure

    confusion = report.main.confusion
    classes = len(confusion)
    side = max(_SMALLEST, _INCH_PER_CLASS * classes)
    titles = [_title(label, name) for label, name in enumerate(report.class_names)]
    margin = 0.4 + 0.065 * max(len(title) for title in titles)  # inches for the names, at 7 points
    figure = Figure(figsize=(side + margin + 1.0, side + margin + 0.7), layout="constrained")
    axes = figure.add_subplot()
    shares = np.nan_to_num(divide(confusion, confusion.sum(axis=1, keepdims=True)))
    image = axes.imshow(shares, cmap="Blues", vmin=0, vmax=1, aspect="equal")
    _number_cells(axes, confusion, shares, min(9.0, 0.32 * 72 * side / classes))
    _name_axes(axes, titles)
    axes.set_title(_headline(report), fontsize=8 + side / 3, parse_math=False)
    bar = figure.colorbar(image, ax=axes, fraction=0.04, pad=0.02, shrink=min(1.0, 4 / side))
    bar.set_label("share of the true class", fontsize=7)
    bar.ax.tick_params(labelsize=7)
    figure.savefig(path, dpi=150)


def _title(label: int, name: str) -> str:
    short = name if len(name) <= _LONGEST_NAME else name[: _LONGEST_NAME - 1] + "…"
    return f"{short} {label}".strip()


def _headline(report: ClassificationReport) -> str:
    main = report.main
    others = [f"{name} {percent(values.accuracy)}" for name, values in list(report.streams.items())[:-1]]
    name = list(report.streams)[-1]
    first = f"{'accuracy' if name == 'scores' else name} {percent(main.accuracy)} ({main.correct}/{main.samples})"
    return "\n".join([", ".join([first, *others]), f"split {report.split}"])


def _number_cells(axes, confusion: np.ndarray, shares: np.ndarray, size: float) -> None:
    for row, column in np.argwhere(confusion > 0):
        axes.text(
            column,
            row,
            str(confusion[row, column]),
            ha="center",
            va="center",
            fontsize=size,
            color="white" if shares[row, column] > 0.55 else "#203040",
        )


def _name_axes(axes, titles: list[str]) -> None:
    places = range(len(titles))
    axes.set_xticks(places, titles, rotation=90, fontsize=7, parse_math=False)
    axes.set_yticks(places, titles, fontsize=7, parse_math=False)
    axes.set_xticks([place - 0.5 for place in places], minor=True)
    axes.set_yticks([place - 0.5 for place in places], minor=True)
    axes.grid(which="minor", color="#e4e8ee", linewidth=0.4)
    axes.tick_params(which="both", length=0)
    axes.set_xlabel("predicted", fontsize=8)
    axes.set_ylabel("truth", fontsize=8)
