"""`dpc evaluate segments`: evaluates recordings cut into actions."""

from __future__ import annotations

from pathlib import Path

from dpcli.errors import UsageError
from dpcli.evaluate.bootstrap import Resampling
from dpcli.evaluate.results import Result
from dpcli.evaluate.segments.protocol import evaluate_segments, segments_json, segments_notes, segments_tables
from dpcli.store.pipes import standard_input
from dpcli.store.tables.segments import read_segments


def run_segments(source: str, truth: Path, *, intersect: bool, resampling: Resampling) -> Result:
    """Returns the metrics of a table of segments (`-`: from a pipe). Errors are those of `evaluate_segments`."""
    text = _piped() if source == "-" else None
    predicted = read_segments("stdin" if source == "-" else source, text)
    report = evaluate_segments(predicted, read_segments(truth), str(truth), intersect=intersect, resampling=resampling)
    data = segments_json(report, source)
    return Result(data, segments_tables(report), segments_notes(report))


def _piped() -> str:
    """Returns the text of a pipe. Raises UsageError where stdin is a terminal."""
    stream = standard_input()
    if stream.isatty():
        raise UsageError("- reads from a pipe, but stdin is a terminal; pipe `dpc classify predict --segments -o -` in")
    return stream.read().decode("utf-8", "replace")
