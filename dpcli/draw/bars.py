"""Pictures of numbers by class: horizontal bars in panels, and a histogram beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dpcli.draw.sheet import new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_INCH_PER_ROW = 0.75
_WIDTH, _SHORT_TITLE, _INCH_PER_LETTER = 5.2, 12, 0.065  # of a panel whose titles have so many letters; at 8 points


@dataclass(frozen=True)
class Bars:
    """Holds a panel of bars: a group of them for each title, the first at the top; undefined numbers (nan) have no bar.

    values: name in the legend -> one number for each title. most: the axis reaches at least this far; nothing beyond
    is shown when `cut`.
    """

    titles: Sequence[str]
    values: Mapping[str, Sequence[float]]
    unit: str
    most: float | None = None
    cut: bool = False

    def draw(self, axes: Axes) -> None:
        """Draws the bars on matplotlib's axes."""
        places, height = np.arange(len(self.titles)), 0.8 / len(self.values)
        for number, (name, lengths) in enumerate(self.values.items()):
            offset = (number - (len(self.values) - 1) / 2) * height
            axes.barh(places + offset, np.nan_to_num(lengths), height, label=name)
        axes.set_yticks(places, self.titles, fontsize=8, parse_math=False)
        axes.set_ylim(len(self.titles) - 0.4, -0.6)
        axes.grid(axis="x", color="#e4e8ee", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.legend(fontsize=7, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(self.values), frameon=False)
        axes.set_xlabel(self.unit)
        if self.most is not None:
            axes.set_xlim(0, self.most if self.cut else max(self.most, axes.get_xlim()[1]))


@dataclass(frozen=True)
class Histogram:
    """Holds a panel that counts values (N), without undefined ones (nan), in 20 equal bins from 0 to `most`."""

    values: np.ndarray
    unit: str
    counted: str
    most: float = 100

    def draw(self, axes: Axes) -> None:
        """Draws the histogram on matplotlib's axes."""
        from matplotlib.ticker import MaxNLocator

        axes.hist(self.values[~np.isnan(self.values)], bins=np.linspace(0, self.most, 21), color="#4c72b0")
        axes.yaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        axes.set_box_aspect(0.75)
        axes.set_anchor("N")
        axes.set_xlabel(self.unit)
        axes.set_ylabel(self.counted)


def draw_panels(panels: Sequence[Bars | Histogram], rows: int, headline: str, path: Path) -> None:
    """Writes panels side by side, as high as so many groups of bars need. Raises DataError when it can't be written."""

    longest = max((len(title) for panel in panels if isinstance(panel, Bars) for title in panel.titles), default=0)
    width = _WIDTH + _INCH_PER_LETTER * max(0, longest - _SHORT_TITLE)
    figure = new_figure(width * len(panels), 1.6 + _INCH_PER_ROW * max(rows, 3))
    for number, panel in enumerate(panels):
        panel.draw(figure.add_subplot(1, len(panels), number + 1))
    figure.suptitle(headline, fontsize=10, parse_math=False)
    save_figure(figure, path)
