"""The picture of a confusion matrix, legible from 2 to some 100 classes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dpcli.draw.reliability import WIDTH, Reliability, draw_reliability
from dpcli.draw.sheet import new_figure, save_figure, shortened

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_INCH_PER_CLASS = 0.30  # a cell holds three digits at this size
_SMALLEST = 3.2  # inches of matrix, however few the classes
_LONGEST_NAME = 28  # characters of a class name on an axis
_DARK_SHARE = 0.55  # of a row, above which a cell's number is white


def draw_confusion(
    confusion: np.ndarray, class_names: Sequence[str], headline: str, path: Path, reliability: Reliability | None = None
) -> None:
    """Writes the picture of a matrix of counts, truth (rows) by prediction (columns), whole numbers (C,C).

    Color is the share of the row's truth, the number in a cell the count. reliability: to be drawn beside it. Raises
    DataError when it can't be written.
    """

    classes = len(confusion)
    side = max(_SMALLEST, _INCH_PER_CLASS * classes)
    titles = [_axis_title(label, name) for label, name in enumerate(class_names)]
    margin = 0.4 + 0.065 * max(len(title) for title in titles)  # inches for the names, at 7 points
    wide, high = side + margin + 1.0, side + margin + 0.7
    more = WIDTH if reliability is not None else 0.0
    figure = new_figure(wide + more, high)
    if more:  # beside another subfigure the names of the axes come out nearer to the edge than the space around them
        figure.get_layout_engine().set(w_pad=0.1, h_pad=0.06)
    places = figure.subfigures(1, 2, width_ratios=(wide, more)) if more else [figure]
    axes = places[0].add_subplot()
    shares = confusion / np.maximum(confusion.sum(axis=1, keepdims=True), 1)
    image = axes.imshow(shares, cmap="Blues", vmin=0, vmax=1, aspect="equal")
    _number_cells(axes, confusion, shares, min(9.0, 0.32 * 72 * side / classes))
    _name_axes(axes, titles)
    axes.set_title(headline, fontsize=8 + side / 3, parse_math=False)
    bar = places[0].colorbar(image, ax=axes, fraction=0.04, pad=0.02, shrink=min(1.0, 4 / side))
    bar.set_label("share of the true class", fontsize=7)
    bar.ax.tick_params(labelsize=7)
    if reliability is not None:
        draw_reliability(reliability, places[1])
    save_figure(figure, path)


def _axis_title(label: int, name: str) -> str:
    return f"{shortened(name, _LONGEST_NAME)} {label}".strip()


def _number_cells(axes: Axes, confusion: np.ndarray, shares: np.ndarray, size: float) -> None:
    for row, column in np.argwhere(confusion > 0):
        ink = "white" if shares[row, column] > _DARK_SHARE else "#203040"
        axes.text(column, row, str(confusion[row, column]), ha="center", va="center", fontsize=size, color=ink)


def _name_axes(axes: Axes, titles: list[str]) -> None:
    places = range(len(titles))
    axes.set_xticks(places, titles, rotation=90, fontsize=7, parse_math=False)
    axes.set_yticks(places, titles, fontsize=7, parse_math=False)
    axes.set_xticks([place - 0.5 for place in places], minor=True)
    axes.set_yticks([place - 0.5 for place in places], minor=True)
    axes.grid(which="minor", color="#e4e8ee", linewidth=0.4)
    axes.tick_params(which="both", length=0)
    axes.set_xlabel("predicted", fontsize=8)
    axes.set_ylabel("truth", fontsize=8)
