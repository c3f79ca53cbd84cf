"""`dpc evaluate joints`: evaluates the joints of a parts file."""

from __future__ import annotations

from pathlib import Path

from dpcli.evaluate.bootstrap import Resampling
from dpcli.evaluate.joints.protocol import evaluate_joints
from dpcli.evaluate.joints.tables import joint_json, joint_notes, joint_tables
from dpcli.evaluate.results import Result
from dpcli.store import input_file


def run_joints(parts: str, truth: Path, *, split: str | None, intersect: bool, resampling: Resampling) -> Result:
    """Returns the metrics of the joints in a parts file (`-`: from a pipe). Errors are those of `evaluate_joints`."""
    with input_file(parts) as path:
        report = evaluate_joints(path, truth, split=split, intersect=intersect, resampling=resampling)
        data = joint_json(report, parts)
    return Result(data, joint_tables(report), joint_notes(report))
