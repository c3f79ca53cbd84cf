"""True labels of the samples of a scores file: its own, or those of a clouds file whose samples have the same names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dpcli.counted import counted
from dpcli.errors import REORDER, DataError
from dpcli.evaluate.results import LeftOut, counted_split, left_out, list_names
from dpcli.store import CloudsReader, ScoresReader


@dataclass(frozen=True)
class TruthLabels:
    """Holds the truth of each sample of a scores file, in its order.

    labels i64 (S), -1 = unknown; splits (S); in_truth bool (S): whether the truth has the sample; left_out: samples
    that only one side has.
    """

    labels: np.ndarray
    splits: list[str]
    in_truth: np.ndarray
    left_out: list[LeftOut] = field(default_factory=list)


def labels_in_file(scores: ScoresReader) -> TruthLabels:
    """Returns the labels and splits that the scores file itself holds."""
    labels = np.asarray(scores.labels)
    return TruthLabels(labels, list(scores.splits), np.ones(len(labels), bool))


def match_labels(scores: ScoresReader, truth: str | Path, split: str | None, intersect: bool) -> TruthLabels:
    """Returns the labels and splits of a clouds file, matched to the scores by the samples' names.

    Raises DataError when the classes differ, or the samples that count; with `intersect` those that only one side has
    are listed instead.
    """
    with CloudsReader(truth) as clouds:
        names, labels, splits = list(clouds.names), np.asarray(clouds.labels), list(clouds.splits)
        _check_classes(scores, truth, clouds.class_names)
    row_of = {name: index for index, name in enumerate(names)}
    unknown = [name for name in scores.names if name not in row_of]
    split = counted_split(split, splits)
    scored = set(scores.names)
    unscored = [name for name, own in zip(names, splits, strict=True) if split in ("all", own) and name not in scored]
    _check_names(scores, truth, split, unknown, [] if intersect else unscored, intersect)
    in_truth = np.array([name in row_of for name in scores.names])
    rows = np.array([row_of.get(name, 0) for name in scores.names], np.int64)
    labels = np.where(in_truth, labels[rows], -1).astype(np.int64)
    if labels.max() >= len(scores.class_names):
        worst = int(labels.argmax())
        raise DataError(
            f"{truth}: label {labels[worst]} of {scores.names[worst]!r}; "
            f"{scores.path} has the classes 0..{len(scores.class_names) - 1}"
        )
    one_sided = left_out({"the truth doesn't have": unknown, "not scored": unscored})
    return TruthLabels(labels, [splits[row] for row in rows], in_truth, one_sided)


def _check_names(
    scores: ScoresReader, truth: str | Path, split: str, unknown: list[str], unscored: list[str], intersect: bool
) -> None:
    if unknown and not intersect:
        raise DataError(
            f"{truth}: has no {list_names(unknown)}, which {scores.path} scores; was it predicted from another? "
            "--intersect evaluates what both have"
        )
    if unscored:
        kind = "samples" if split == "all" else f"{split} samples"
        raise DataError(
            f"{scores.path}: scores no {list_names(unscored)} among the {kind} of {truth}; "
            "predict them too, or choose another --split"
        )
    if len(unknown) == len(scores.names):
        raise DataError(f"{scores.path}: scores {list_names(unknown)}, of which {truth} has none")


def _check_classes(scores: ScoresReader, truth: str | Path, class_names: Sequence[str]) -> None:
    if not class_names or list(class_names) == list(scores.class_names):
        return
    advice = f"; {REORDER}" if {*class_names} <= {*scores.class_names} else ""
    if len(class_names) != len(scores.class_names):
        raise DataError(
            f"{truth}: {counted(len(class_names), 'class')}, but {scores.path} scores {len(scores.class_names)}{advice}"
        )
    pairs = enumerate(zip(class_names, scores.class_names, strict=True))
    label, (ours, theirs) = next(pair for pair in pairs if pair[1][0] != pair[1][1])
    raise DataError(f"{truth}: class {label} is {ours!r}, in {scores.path} it is {theirs!r}{advice}")
