"""Draws segmentation and motion metrics by class, as bars."""

from __future__ import annotations

from pathlib import Path

from dpcli.draw.bars import Bars, Histogram, draw_panels
from dpcli.draw.sheet import shortened
from dpcli.evaluate.metric_titles import title_of
from dpcli.evaluate.segmentation.motion_protocol import MotionReport
from dpcli.evaluate.segmentation.protocol import SegmentationReport
from dpcli.evaluate.segmentation.tables import class_rows

_SHOWN = ("ap", "pq", "f1", "miou", "ri")
_LONGEST_TITLE = 32  # characters of a class and its number


def draw_segmentation_bars(report: SegmentationReport, path: Path) -> None:
    """Draws the scores of each class and of all sequences, and how the mIoU of the sequences is spread."""
    rows = class_rows(report.main, report.classes, report.class_names)
    values = {title_of(key): [100 * getattr(own, key) for _, own in rows] for key in _SHOWN}
    bars = Bars([_counted(title, own.objects) for title, own in rows], values, "%", 100)
    spread = Histogram(100 * report.objects.object_iou, "mIoU of a sequence, %", "sequences")
    draw_panels([bars, spread], len(rows), f"Parts, protocol {report.protocol}, split {report.split}", path)


def draw_motion_bars(report: MotionReport, path: Path) -> None:
    """Draws the end-point error of each class and of all sequences beside that of predicting no motion, and the shares."""
    rows = class_rows(report.main, report.classes, report.class_names)
    titles = [_counted(title, own.pairs) for title, own in rows]
    errors = {"EPE3D": [own.epe3d for _, own in rows], "predicting no motion": [own.still for _, own in rows]}
    shares = {
        f"{name} {tau:g}": [100 * getattr(own.shares[tau], name.lower()) for _, own in rows]
        for tau in report.main.shares
        for name in ("AccS", "AccR")
    }
    panels = [
        Bars(titles, errors, report.length_unit or "length units"),
        Bars(titles, shares, "% of points", 100, cut=True),
    ]
    draw_panels(panels, len(rows), f"Flow, protocol {report.protocol}, split {report.split}", path)


def _counted(title: str, count: int) -> str:
    return f"{shortened(title, _LONGEST_TITLE)} ({count})"
