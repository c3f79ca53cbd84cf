"""Draws segmentation and motion metrics by class, as bars."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.evaluate.metric_titles import title_of
from dpcli.evaluate.segmentation.motion_protocol import MotionReport
from dpcli.evaluate.segmentation.protocol import SegmentationReport
from dpcli.evaluate.segmentation.tables import class_rows

_SHOWN = ("ap", "pq", "f1", "miou", "ri")
_INCH_PER_ROW = 0.75


def draw_segmentation_bars(report: SegmentationReport, path: Path) -> None:
    """Draws the scores of each class and of all sequences, and how the mIoU of the sequences is spread."""
    rows = class_rows(report.main, report.classes, report.class_names)
    bars, spread = _panels(len(rows), 2)
    values = {title_of(key): [100 * getattr(own, key) for _, own in rows] for key in _SHOWN}
    _bars(bars, [f"{title} ({own.objects})" for title, own in rows], values)
    bars.set_xlabel("%")
    bars.set_xlim(0, max(100, bars.get_xlim()[1]))
    objects = report.objects.object_iou
    spread.hist(100 * objects[~np.isnan(objects)], bins=np.linspace(0, 100, 21), color="#4c72b0")
    spread.set_xlabel("mIoU of a sequence, %")
    spread.set_ylabel("sequences")
    bars.figure.suptitle(f"Parts, protocol {report.protocol}, split {report.split}", fontsize=10, parse_math=False)
    bars.figure.savefig(path, dpi=150)


def draw_motion_bars(report: MotionReport, path: Path) -> None:
    """Draws the end-point error of each class and of all sequences beside that of predicting no motion, and the shares."""
    rows = class_rows(report.main, report.classes, report.class_names)
    errors, accuracy = _panels(len(rows), 2)
    titles = [f"{title} ({own.pairs})" for title, own in rows]
    values = {"EPE3D": [own.epe3d for _, own in rows], "predicting no motion": [own.still for _, own in rows]}
    _bars(errors, titles, values)
    errors.set_xlabel(report.length_unit or "length units")
    found = {
        f"{name} {tau:g}": [100 * getattr(own.shares[tau], name.lower()) for _, own in rows]
        for tau in report.main.shares
        for name in ("AccS", "AccR")
    }
    _bars(accuracy, titles, found)
    accuracy.set_xlabel("% of points")
    accuracy.set_xlim(0, 100)
    errors.figure.suptitle(f"Flow, protocol {report.protocol}, split {report.split}", fontsize=10, parse_math=False)
    errors.figure.savefig(path, dpi=150)


def _panels(rows: int, count: int) -> list:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2 * count, 1.6 + _INCH_PER_ROW * max(rows, 3)), layout="constrained")
    return [figure.add_subplot(1, count, number + 1) for number in range(count)]


def _bars(axes, titles: list[str], values: dict[str, list[float]]) -> None:
    """Draws one group of horizontal bars for each title, the first at the top; undefined numbers have no bar."""
    places, height = np.arange(len(titles)), 0.8 / len(values)
    for number, (name, lengths) in enumerate(values.items()):
        offset = (number - (len(values) - 1) / 2) * height
        axes.barh(places + offset, np.nan_to_num(lengths), height, label=name)
    axes.set_yticks(places, titles, fontsize=8, parse_math=False)
    axes.invert_yaxis()
    axes.grid(axis="x", color="#e4e8ee", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.legend(fontsize=7, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(values), frameon=False)
