"""Blocks that only a classification result has: streams, classes with bars, the confusion matrix, and what is confused most."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.metric_titles import title_of
from dpcli.evaluate.report.blocks import Cell, Figure, Table, cell, interval_text, is_number, table, text_of
from dpcli.evaluate.report.charts import confusion_grid

SHOWN_HERE = ("streams", "per_class", "confusion", "reliability")
_MOST_CLASSES = 128
_MOST_PAIRS = 12


def classification_blocks(found: Mapping[str, Any]) -> list[Table | Figure]:
    """Returns tables and the matrix of a classification object; those whose numbers it lacks are left out.

    Raises DataError for a confusion matrix that is not square, or not of all classes.
    """
    metrics = found.get("metrics", {})
    classes = [row for row in metrics.get("per_class", []) if isinstance(row, Mapping)]
    blocks: list[Table | Figure] = []
    if isinstance(metrics.get("streams"), Mapping):
        blocks.append(_stream_table(found))
    if classes:
        blocks.append(_class_table(classes))
    confusion = _confusion_matrix(metrics.get("confusion"), len(classes))
    if confusion is not None:
        names = [str(row.get("name", "")) for row in classes] or [""] * len(confusion)
        blocks += _confusion_blocks(confusion, names)
    if isinstance(metrics.get("reliability"), Mapping):
        blocks += _reliability_tables(metrics["reliability"])
    return blocks


def _stream_table(found: Mapping[str, Any]) -> Table:
    streams, counts = found["metrics"]["streams"], found.get("denominators", {})
    level = found.get("intervals", {}).get("confidence")  # absent where nothing was resampled; the protocol then has it
    heading = f"{100 * level:.4g} % interval of accuracy" if is_number(level) else "interval of accuracy"
    names = list(dict.fromkeys(key for own in streams.values() for key in own if not key.endswith("_interval")))
    samples, correct = counts.get("samples"), counts.get("correct", {})
    rows = []
    for stream, own in streams.items():
        hits = f"{correct.get(stream)}/{samples}" if samples and correct.get(stream) is not None else "-"
        interval = interval_text(own.get("accuracy_interval"), "fraction") or "-"
        rows.append(
            [stream, hits, interval, *(cell(own.get(name), "fraction", bar=name == "accuracy") for name in names)]
        )
    return table("By stream", ("stream", "correct", heading, *map(title_of, names)), rows, key="streams")


def _class_table(classes: list[Mapping[str, Any]]) -> Table:
    rows = [
        [
            Cell(f"{row.get('label', number)} {row.get('name', '')}".strip(), float(number)),
            cell(row.get("recall"), "fraction", bar=True),
            cell(row.get("support")),
            cell(row.get("hits")),
            cell(row.get("precision"), "fraction"),
            cell(row.get("f1"), "fraction"),
        ]
        for number, row in enumerate(classes)
    ]
    return table(
        "By class", ("class", "accuracy (recall)", "samples", "correct", "precision", "F1"), rows, key="per_class"
    )


def _confusion_matrix(found: Any, classes: int) -> np.ndarray | None:
    """Returns the confusion matrix, i64 (C,C); None without one. Raises DataError unless it is square and has all classes."""
    if found is None:
        return None
    try:
        matrix = np.array(found, np.int64)
    except (ValueError, TypeError, OverflowError):
        matrix = np.zeros(0)
    if (
        matrix.ndim != 2
        or matrix.shape[0] != matrix.shape[1]
        or (classes and len(matrix) != classes)
        or (matrix < 0).any()
    ):
        raise DataError(
            f"metrics.confusion has shape {matrix.shape}; expected counts, one row and column for each of "
            f"{classes or 'the'} classes"
        )
    return matrix


def _confusion_blocks(confusion: np.ndarray, names: list[str]) -> list[Table | Figure]:
    note = "Rows: truth, columns: prediction; color: share of the row's truth, number: samples."
    if len(confusion) > _MOST_CLASSES:
        grid = []
    else:
        grid = [Figure("Confusion matrix", confusion_grid(confusion, names), note)]
    return [*grid, *_most_confused(confusion, names)]


def _most_confused(confusion: np.ndarray, names: list[str]) -> list[Table]:
    """Returns the pairs that are mixed up most often, most samples first, then by label."""
    wrong = confusion * (1 - np.eye(len(confusion), dtype=np.int64))
    cells = [tuple(own) for own in np.argwhere(wrong > 0).tolist()]
    cells.sort(key=lambda own: (-wrong[own], own))
    support = confusion.sum(axis=1)
    rows = [
        [
            Cell(names[a]) if names[a] else cell(a),  # a name may begin with a number, by which it is not sorted
            Cell(names[b]) if names[b] else cell(b),
            cell(int(wrong[a, b])),
            cell(float(wrong[a, b] / support[a]), "fraction", bar=True),
        ]
        for a, b in cells[:_MOST_PAIRS]
    ]
    if not rows:
        return []
    return [
        table(
            f"Confused most ({len(rows)} of {len(cells)} pairs)",
            ("truth", "predicted as", "samples", "of the truth"),
            rows,
            key="confused",
        )
    ]


def _reliability_tables(found: Mapping[str, Any]) -> list[Table]:
    """Returns the table of the bins of probability that hold samples, in a list, which is empty where none does.

    Raises ValueError where the bins' samples, probabilities and shares are not as many.
    """
    bins = list(zip(found["samples"], found["confidence"], found["accuracy"], strict=True))
    rows = [
        [
            Cell(f"{k / len(bins):.2f} to {(k + 1) / len(bins):.2f}", float(k)),
            cell(samples),
            cell(confidence, "fraction"),
            cell(right, "fraction", bar=True),
        ]
        for k, (samples, confidence, right) in enumerate(bins)
        if samples
    ]
    if not rows:
        return []
    chance = found.get("calibration_error_by_chance")
    note = f"As many perfectly calibrated samples would show a calibration error of {text_of(chance, 'fraction')} on average."
    header = ("probability of the best class", "samples", "mean probability", "right")
    return [table("Reliability", header, rows, note if is_number(chance) else "", key="reliability")]
