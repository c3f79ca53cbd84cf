"""The confusion matrix of a classification report as a picture, with its reliability diagram."""

from __future__ import annotations

from pathlib import Path

from dpcli.draw.confusion_matrix import draw_confusion
from dpcli.draw.reliability import Reliability
from dpcli.evaluate.classification.protocol import ClassificationReport
from dpcli.evaluate.text_tables import percent


def draw_confusion_matrix(report: ClassificationReport, path: Path) -> None:
    """Draws the confusion matrix of the main scores: color = share of the row's truth, number = samples. Beside it,
    where the scores are probabilities, the reliability diagram: share right over probability, with samples of each bin."""
    found = report.calibration.get(list(report.streams)[-1])
    reliability = None
    if found is not None:
        title = f"calibration error {percent(found.error)} (by chance {percent(found.by_chance)})"
        reliability = Reliability(found.samples, found.confidence, found.accuracy, title)
    draw_confusion(report.main.confusion, report.class_names, _headline(report), path, reliability)


def _headline(report: ClassificationReport) -> str:
    main = report.main
    others = [f"{name} {percent(values.accuracy)}" for name, values in list(report.streams.items())[:-1]]
    name = list(report.streams)[-1]
    first = f"{'accuracy' if name == 'scores' else name} {percent(main.accuracy)} ({main.correct}/{main.samples})"
    return "\n".join([", ".join([first, *others]), f"split {report.split}"])
