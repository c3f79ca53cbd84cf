"""Small pictures as markup: bars live in tables, histograms and curves are SVG, a confusion matrix is a table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

import numpy as np

from dpcli.evaluate.proportions import divide
from dpcli.evaluate.report.blocks import text_of

_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _TOP = 560, 170, 44, 34, 8
_BINS = 20
_DEEP = 0.55  # share from which a cell's text is drawn light
_ON_PAPER = 18  # classes of a confusion matrix; more are printed smaller


def histogram(values: Sequence[float], unit: str = "") -> str:
    """Returns a histogram of values as SVG, with their median marked; fractions over 0..1, others over their own range."""
    data = np.asarray(values, np.float64)
    low, high = (0.0, 1.0) if unit == "fraction" and data.min() >= 0 and data.max() <= 1 else (data.min(), data.max())
    counts, edges = np.histogram(data, _BINS, (low, high if high > low else low + 1))
    most, median = int(counts.max()), float(np.median(data))
    place = _scale(edges[0], edges[-1])
    bars = "".join(
        f'<rect class="mark" x="{place(a):.1f}" y="{_level(count / most):.1f}" width="{max(place(b) - place(a) - 1, 0.5):.1f}" '
        f'height="{_level(0) - _level(count / most):.1f}"><title>{text_of(float(a), unit)} to {text_of(float(b), unit)}: '
        f"{count}</title></rect>"
        for count, a, b in zip(counts.tolist(), edges[:-1], edges[1:], strict=True)
        if count
    )
    middle = (
        f'<line class="middle" x1="{place(median):.1f}" x2="{place(median):.1f}" y1="{_TOP}" y2="{_level(0):.1f}"/>'
    )
    words = f"{len(data)} values, {text_of(float(data.min()), unit)} to {text_of(float(data.max()), unit)}, median {text_of(median, unit)}"
    return _svg(words, bars + middle + _axes(edges[0], edges[-1], 0, most, unit)) + _caption(words)


def curve(name: str, values: Sequence[float | None]) -> str:
    """Returns a curve of a value for each frame as SVG, with gaps where it is None."""
    known = [value for value in values if value is not None]
    low, high = min(known), max(known)
    place, span = _scale(0, max(len(values) - 1, 1)), (high - low) or 1.0
    runs, path = [], ""
    for frame, value in enumerate([*values, None]):
        if value is None:
            runs += [path] if path else []
            path = ""
        else:
            path += f"{'L' if path else 'M'}{place(frame):.1f} {_level((value - low) / span):.1f}"
    lines = "".join(f'<path class="line" d="{own}"/>' for own in runs)
    words = f"{name} by frame: {text_of(low)} to {text_of(high)}, mean {text_of(sum(known) / len(known))}"
    return _svg(words, lines + _axes(0, len(values) - 1, low, high, "")) + _caption(words)


def _scale(low: float, high: float):
    width = (high - low) or 1.0
    return lambda value: _LEFT + (value - low) / width * (_WIDTH - _LEFT - 10)


def _level(share: float) -> float:
    return _HEIGHT - _BOTTOM - share * (_HEIGHT - _BOTTOM - _TOP)


def _axes(left: float, right: float, low: float, high: float, unit: str) -> str:
    place, base = _scale(left, right), _level(0)
    ticks = "".join(
        f'<text x="{place(value):.1f}" y="{base + 16:.1f}" text-anchor="{anchor}">{escape(text_of(_round(value), unit))}</text>'
        for value, anchor in ((left, "start"), ((left + right) / 2, "middle"), (right, "end"))
    )
    ends = "".join(
        f'<text x="{_LEFT - 5}" y="{_level(share) + 4:.1f}" text-anchor="end">{escape(text_of(value))}</text>'
        for share, value in ((0, low), (1, high))
    )
    return f'<line class="axis" x1="{_LEFT}" x2="{_WIDTH - 10}" y1="{base:.1f}" y2="{base:.1f}"/>{ticks}{ends}'


def _round(value: float) -> float | int:
    return int(value) if float(value).is_integer() and math.isfinite(value) else float(value)


def _svg(words: str, inside: str) -> str:
    return f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(words)}">{inside}</svg>'


def _caption(words: str) -> str:
    return f'<p class="faint">{escape(words)}.</p>'


def confusion_grid(confusion: np.ndarray, names: Sequence[str]) -> str:
    """Returns a confusion matrix, counts i64 (C,C), rows truth, as a table colored by the share of the row.

    A line of words below it tells of the cell in focus.
    """
    shares = np.nan_to_num(divide(confusion, confusion.sum(axis=1, keepdims=True)))
    titles = [f"{label} {name}".strip() for label, name in enumerate(names)]
    head = "".join(f'<th scope="col" title="{escape(title)}">{label}</th>' for label, title in enumerate(titles))
    rows = "".join(
        f'<tr><th scope="row">{escape(title)}</th>'
        + "".join(
            _grid_cell(*own, row == column)
            for column, own in enumerate(zip(confusion[row].tolist(), shares[row].tolist(), strict=True))
        )
        + "</tr>"
        for row, title in enumerate(titles)
    )
    kind = "grid many" if len(names) > _ON_PAPER else "grid"
    return (
        f'<div class="wide" tabindex="0" role="region" aria-label="Confusion matrix"><table class="{kind}" data-unit="samples">'
        f'<thead><tr><th scope="col">truth \\ predicted</th>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
        '<p class="faint says" aria-live="polite">Point at a cell, or move among them with the arrow keys.</p>'
    )


def _grid_cell(count: int, share: float, diagonal: bool) -> str:
    if not count:
        return "<td>\u00b7</td>"
    kind = (" deep" if share > _DEEP else "") + (" right" if diagonal else " wrong")
    return f'<td class="{kind.strip()}" style="--s:{share:.3f}">{count}</td>'
