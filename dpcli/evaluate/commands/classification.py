"""`dpc evaluate classification`: evaluates a scores file."""

from __future__ import annotations

from pathlib import Path

from dpcli.evaluate.bootstrap import Resampling
from dpcli.evaluate.classification.protocol import evaluate_classification
from dpcli.evaluate.classification.result_json import classification_json
from dpcli.evaluate.classification.tables import classification_notes, classification_tables
from dpcli.evaluate.results import Result
from dpcli.store import input_file


def run_classification(
    scores: str,
    truth: Path | None,
    split: str | None,
    *,
    intersect: bool,
    resampling: Resampling,
    picture: Path | None = None,
) -> Result:
    """Returns the metrics of a scores file (`-`: from a pipe), and draws its confusion matrix where `picture` is named.

    The other arguments and errors are those of `evaluate_classification`.
    """
    with input_file(scores) as path:
        report = evaluate_classification(path, truth, split, intersect=intersect, resampling=resampling)
        if picture is not None:
            from dpcli.evaluate.classification.confusion_picture import draw_confusion_matrix

            draw_confusion_matrix(report, picture)
        data = classification_json(report, scores)
    return Result(data, classification_tables(report), classification_notes(report))
