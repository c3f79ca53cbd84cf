"""`dpc evaluate motion`: evaluates the flow and the part motions of a parts file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dpcli.evaluate.results import Result
from dpcli.evaluate.segmentation.motion_protocol import evaluate_motion
from dpcli.evaluate.segmentation.motion_tables import motion_notes, motion_tables
from dpcli.evaluate.segmentation.result_json import motion_json
from dpcli.store import input_file


def run_motion(parts: str, truth: Path | None, *, picture: Path | None = None, **choices: Any) -> Result:
    """Returns the motion metrics of a parts file (`-`: from a pipe), or of kept statistics, and draws bars where `picture` is named.

    The choices, and errors, are those of `evaluate_motion`.
    """
    with input_file(parts) as path:
        report = evaluate_motion(path, truth, **choices)
        if picture is not None:
            from dpcli.evaluate.segmentation.class_bars import draw_motion_bars

            draw_motion_bars(report, picture)
        data = motion_json(report, parts)
    return Result(data, motion_tables(report), motion_notes(report))
