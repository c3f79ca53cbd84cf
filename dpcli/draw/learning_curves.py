"""The picture of a training run: columns of its log over steps or epochs, in panels side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dpcli.draw.sheet import new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MARKED = 30  # fewer points than this are marked on their line


@dataclass(frozen=True)
class Curve:
    """Describes a line: the log's column, its name in the legend, a factor of its values, matplotlib's name of its color."""

    column: str
    label: str
    scale: float = 1.0
    color: str | None = None


@dataclass(frozen=True)
class Panel:
    """Describes a plot of curves over one column, with a second axis on the right where `right` has curves.

    rows: the log's rows that it shows; None: all. range, right_range: lowest and highest value shown, None: as it comes.
    change: where a dotted line stands.
    """

    title: str
    curves: Sequence[Curve]
    y_label: str = ""
    range: tuple[float | None, float | None] = (None, None)
    logarithmic: bool = False
    right: Sequence[Curve] = ()
    right_label: str = ""
    right_range: tuple[float | None, float | None] = (None, None)
    rows: Sequence[Mapping[str, Any]] | None = field(default=None, repr=False)
    change: float | None = None


def draw_learning_curves(rows: Sequence[Mapping[str, Any]], panels: Sequence[Panel], path: Path, x: str) -> None:
    """Writes the panels side by side as a PNG; x: the column of the horizontal axis. Values of None are left out.

    Raises DataError when it can't be written.
    """
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(5.2 * len(panels), 3.8)
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        own = rows if panel.rows is None else panel.rows
        lines = _plot(axes, own, panel.curves, x)
        axes.set(title=panel.title, xlabel=x, ylabel=panel.y_label, yscale="log" if panel.logarithmic else "linear")
        axes.set_ylim(*panel.range)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        if panel.change is not None:
            axes.axvline(panel.change, color="0.6", linestyle=":")
        if panel.right:
            right = axes.twinx()
            lines += _plot(right, own, panel.right, x)
            right.set(ylabel=panel.right_label, ylim=panel.right_range)
        if len(lines) > 1:
            axes.legend(lines, [line.get_label() for line in lines], frameon=False, fontsize=8)
    save_figure(figure, path, 120)


def _plot(axes: Axes, rows: Sequence[Mapping[str, Any]], curves: Sequence[Curve], x: str) -> list[Any]:
    lines = []
    for curve in curves:
        points = [(row[x], curve.scale * row[curve.column]) for row in rows if row.get(curve.column) is not None]
        if points:
            marker = "." if len(points) < _MARKED else None
            lines += axes.plot(*zip(*points), label=curve.label, color=curve.color, marker=marker)
    return lines
