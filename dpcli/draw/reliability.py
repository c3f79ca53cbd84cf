"""The reliability diagram: the share of samples that are right over the probability a classifier gave them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

WIDTH = 3.6  # inches
_BAR, _GAP = "#4a7ebb", "#d9614c"


@dataclass(frozen=True)
class Reliability:
    """Holds bins of equal width from 0 to 1: samples i64 (B), mean probability and share right f64 (B), NaN where empty."""

    samples: np.ndarray
    confidence: np.ndarray
    accuracy: np.ndarray
    title: str


def draw_reliability(found: Reliability, figure: Figure | SubFigure) -> None:
    """Draws share right over probability, the gap to the diagonal in red, and below it how many samples each bin has."""
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    width = 1 / len(found.samples)
    left = width * np.arange(len(found.samples))
    full = found.samples > 0
    upper.plot([0, 1], [0, 1], color="#8894a4", linewidth=0.8, linestyle="--", zorder=1)
    upper.bar(left[full], found.accuracy[full], width, align="edge", color=_BAR, edgecolor="white", linewidth=0.5)
    upper.vlines(found.confidence[full], found.accuracy[full], found.confidence[full], color=_GAP, linewidth=2.2)
    upper.set(ylim=(0, 1), xlim=(0, 1), ylabel="share right")
    upper.set_title(found.title, fontsize=8)
    lower.bar(left, found.samples, width, align="edge", color="#9aa7b8", edgecolor="white", linewidth=0.5)
    lower.set(xlabel="probability of the best class", ylabel="samples")
    lower.locator_params(axis="y", integer=True, nbins=5, min_n_ticks=1)
    for axes in (upper, lower):
        axes.tick_params(labelsize=7)
        axes.xaxis.label.set_size(8)
        axes.yaxis.label.set_size(8)
