"""`dpc evaluate segmentation`: evaluates the parts of a parts file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dpcli.evaluate.results import Result
from dpcli.evaluate.segmentation.protocol import evaluate_segmentation
from dpcli.evaluate.segmentation.result_json import segmentation_json
from dpcli.evaluate.segmentation.tables import segmentation_notes, segmentation_tables
from dpcli.store import input_file


def run_segmentation(parts: str, truth: Path | None, *, picture: Path | None = None, **choices: Any) -> Result:
    """Returns the segmentation metrics of a parts file (`-`: from a pipe), or of kept statistics, and draws bars where `picture` is named.

    The choices, and errors, are those of `evaluate_segmentation`.
    """
    with input_file(parts) as path:
        report = evaluate_segmentation(path, truth, **choices)
        if picture is not None:
            from dpcli.evaluate.segmentation.class_bars import draw_segmentation_bars

            draw_segmentation_bars(report, picture)
        data = segmentation_json(report, parts)
    return Result(data, segmentation_tables(report), segmentation_notes(report))
