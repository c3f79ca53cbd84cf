"""Metrics' names and numbers as the tables of comparisons and runs have them."""

from __future__ import annotations

import numpy as np

from dpcli.evaluate.bootstrap import Interval
from dpcli.evaluate.metric_titles import title_of
from dpcli.evaluate.text_tables import UNDEFINED


def metric_title(key: str, unit: str) -> str:
    """Returns a metric's name as tables have it, with its unit; fractions are shown in percent.

    >>> metric_title("miou", "fraction"), metric_title("epe3d", "m")
    ('mIoU (%)', 'EPE3D (m)')
    """
    name = title_of(key)
    shown = "%" if unit == "fraction" else unit
    return f"{name} ({shown})" if shown and shown != "1" else name


def number_text(value: float | None, unit: str = "", *, signed: bool = False) -> str:
    """Returns a number as tables have it: `85.1` for a fraction of 0.8512, other units to four digits; `-` for an undefined one."""
    if value is None or np.isnan(value):
        return UNDEFINED
    sign = "+" if signed else ""
    return f"{100 * value:{sign}.1f}" if unit == "fraction" else f"{value:{sign}.4g}"


def signed_ends(own: Interval, unit: str) -> str:
    """Returns the ends of an interval of a difference, `-1.2 to +3.4`; `-` where undefined."""
    if not own.defined:
        return UNDEFINED
    return f"{number_text(own.low, unit, signed=True)} to {number_text(own.high, unit, signed=True)}"


def p_value_text(value: float | None) -> str:
    """Returns a p value to three digits, never as certain as 0; `-` for an undefined one."""
    if value is None or np.isnan(value):
        return UNDEFINED
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def plain_ends(own: Interval, unit: str) -> str:
    """Returns the ends of an interval of a mean, `83.1 - 87.0`; `-` where undefined."""
    return f"{number_text(own.low, unit)} - {number_text(own.high, unit)}" if own.defined else UNDEFINED
