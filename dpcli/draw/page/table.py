"""Shows a classifier's scores as a page: a table of samples that can be sorted, searched and narrowed to the mistakes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dpcli.draw.page.assemble import data_page
from dpcli.draw.page.points import PageFacts

MOST_ROWS = 5000
_BEST, _DIGITS = 5, 4  # classes shown of a sample; digits of a score
_ONE = 1e-3  # how far a sum of probabilities may be from 1


def scores_page(
    facts: PageFacts,
    names: Sequence[str],
    class_names: Sequence[str],
    labels: np.ndarray,
    scores: np.ndarray,
    *,
    splits: Sequence[str],
    streams: Mapping[str, np.ndarray],
) -> str:
    """Returns the page. labels: i (S), -1 = unknown. scores: f (S,C). streams: further scores (S,C) by name, such as static.

    The first 5,000 samples become rows; the counts of right ones are of all samples. Scores that are not probabilities (each row
    positive with sum 1) are called scores.
    """
    shown = min(len(names), MOST_ROWS)
    if shown < len(names):
        facts.notes.append(f"Showing the first {shown:,} of {len(names):,} samples; the counts are of all.")
    header = facts.header() | {
        "classes": [name or f"class {at}" for at, name in enumerate(class_names)],
        "probabilities": _are_probabilities(scores),
        "streams": list(streams),
        "tally": {name: _tally(own, labels) for name, own in {"": scores, **streams}.items()},
        "rows": [_row(at, names, labels, scores, splits, streams) for at in range(shown)],
    }
    return data_page(header, "table", script=("table",))


def _are_probabilities(scores: np.ndarray) -> bool:
    return bool(scores.size and scores.min() >= 0 and np.abs(scores.sum(1) - 1).max() < _ONE)


def _tally(scores: np.ndarray, labels: np.ndarray) -> list[int]:
    """Returns how many samples are right, of how many whose label is known."""
    known = labels >= 0
    return [int((scores[known].argmax(1) == labels[known]).sum()), int(known.sum())] if scores.size else [0, 0]


def _row(
    at: int,
    names: Sequence[str],
    labels: np.ndarray,
    scores: np.ndarray,
    splits: Sequence[str],
    streams: Mapping[str, np.ndarray],
) -> dict[str, Any]:
    best = np.argsort(-scores[at], kind="stable")[:_BEST]
    return {
        "name": names[at],
        "split": splits[at],
        "label": int(labels[at]),
        "best": [[int(one), round(float(scores[at, one]), _DIGITS)] for one in best],
        "streams": [[int(own[at].argmax()), round(float(own[at].max()), _DIGITS)] for own in streams.values()],
    }
