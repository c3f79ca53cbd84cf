"""`dpc evaluate motion`: evaluates the flow and the part motions of a parts file."""

from __future__ import annotations

from pathlib import Path

from dpcli.evaluate.bootstrap import Resampling
from dpcli.evaluate.results import Result
from dpcli.evaluate.segmentation.motion_protocol import evaluate_motion
from dpcli.evaluate.segmentation.motion_tables import motion_notes, motion_tables
from dpcli.evaluate.segmentation.result_json import motion_json
from dpcli.evaluate.segmentation.sequence_pass import NOT_KEPT, Keeping, made_by
from dpcli.store import input_file


def run_motion(
    parts: str,
    truth: Path | None,
    *,
    protocol: str,
    split: str | None,
    intersect: bool,
    resampling: Resampling,
    picture: Path | None = None,
    keeping: Keeping = NOT_KEPT,
) -> Result:
    """Returns the motion metrics of a parts file (`-`: from a pipe), or of kept statistics, and draws bars where `picture` is named.

    The other arguments and errors are those of `evaluate_motion`.
    """
    with input_file(parts) as path:
        report = evaluate_motion(
            path, truth, protocol=protocol, split=split, intersect=intersect, resampling=resampling, keeping=keeping
        )
        if picture is not None:
            from dpcli.evaluate.segmentation.class_bars import draw_motion_bars

            draw_motion_bars(report, picture)
        data = motion_json(report, parts, made_by(path))
    return Result(data, motion_tables(report), motion_notes(report))
