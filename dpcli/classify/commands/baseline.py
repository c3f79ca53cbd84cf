"""`dpc classify baseline`: hand-made descriptors and a random forest, which say in seconds what a network must beat."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dpcli.classify.data.columns import not_read, telling_columns
from dpcli.classify.data.copies import tell_copies
from dpcli.classify.data.descriptors import descriptors
from dpcli.classify.data.likeness import tell_mixed_sizes
from dpcli.classify.data.validation_split import about_frequent_class, about_other_splits, class_table, unknown_people
from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.path_names import first_names
from dpcli.runtime import provenance
from dpcli.runtime.progress import log
from dpcli.runtime.seeds import scikit_learn_state
from dpcli.runtime.whole_file import refuse_existing
from dpcli.store import CloudsReader, ScoresWriter, input_file, output_file
from dpcli.store.pipes import refuse_repeats

TREES = 500
_FOLDS = 5  # where a file has no test split and no people
_STEADY = 3  # videos a class at least, so that each fold has some to learn from


@dataclass(frozen=True)
class Baseline:
    """Says how a forest did: videos it learned from and judged, how many of these it got right, and who they were.

    seen: what the judged videos share with those of the training, and one class that most of them show, in words for a person.
    """

    learned: int
    judged: int
    right: int
    classes: int
    seen: str

    @property
    def accuracy(self) -> float:
        """Returns the share of the judged videos that are right, 0..1."""
        return self.right / self.judged


def baseline(data: str, *, output: str | None = None, seed: int = 0, force: bool = False) -> Baseline:
    """Trains a forest on the descriptors of a file's videos, and judges it on its test split; scores go to `output`.

    Without a test split the videos are judged in turn, by a forest that saw neither them nor, where the file knows
    people, their person. Raises DataError where nothing has a label, or a class has too few videos, UsageError, before
    anything is computed, for an output that exists.
    """
    refuse_repeats([data, *([output] if output else [])])
    if output not in (None, "-"):
        refuse_existing(str(output), force)
    with input_file(data) as path, CloudsReader(path) as reader:
        known = np.flatnonzero(reader.labels >= 0)
        if not len(known):
            raise DataError(f"{path}: no video has a label; prepare them with --labels TABLE or --label-from-folder")
        labels = reader.labels[known]
        if len(set(labels.tolist())) < 2:
            raise DataError(f"{path}: all labeled videos are of one class; expected at least two classes to tell apart")
        columns, left_out = telling_columns(reader, known.tolist(), by_class=False)
        if left_out:
            log.info(f"{path}: columns read: {', '.join(columns) or 'none'}{not_read(left_out)}")
        values = descriptors(reader, known.tolist(), columns)
        names = class_table(reader)
        scores = np.full((len(known), len(names)), np.nan, np.float32)
        rounds = list(_rounds(reader, known, labels))
        _tell_left_out(reader, known)
        tell_mixed_sizes(reader, known.tolist())
        tell_copies(reader, [(known[learned].tolist(), known[judged].tolist()) for learned, judged in rounds])
        for learned, judged in rounds:
            scores[judged] = _forest_scores(values[learned], labels[learned], values[judged], len(names), seed)
        judged = np.flatnonzero(np.isfinite(scores[:, 0]))
        _tell_unknown_classes(reader, labels, rounds, len(judged))
        if output:
            _write(reader, known[judged], scores[judged], output, seed, force)
        right = int((scores[judged].argmax(1) == labels[judged]).sum())
        learned = sum(len(one) for one, _ in rounds) // len(rounds)
        seen = "; ".join(filter(None, (_seen(reader, known, rounds), about_frequent_class(reader, known[judged]))))
        return Baseline(learned, len(judged), right, len(set(labels.tolist())), seen)


def forest_accuracy(reader: CloudsReader, learned: list[int], judged: list[int], seed: int) -> float:
    """Returns the share of the labeled sequences `judged` that a forest which saw the sequences `learned` gets right."""
    columns, _ = telling_columns(reader, learned, by_class=False)
    known, asked = (descriptors(reader, some, columns) for some in (learned, judged))
    scores = _forest_scores(known, reader.labels[learned], asked, len(class_table(reader)), seed)
    return float((scores.argmax(1) == reader.labels[judged]).mean())


def _rounds(reader: CloudsReader, known: np.ndarray, labels: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields the places among `known` that a forest learns from and those that it is judged on."""
    from sklearn.model_selection import GroupKFold, StratifiedKFold

    splits = np.array(reader.splits)[known]
    if "test" in splits:
        learned = np.flatnonzero(splits == "train" if "train" in splits else ~np.isin(splits, ("test", "validation")))
        if not len(learned):
            raise DataError(
                f"{reader.path}: all labeled videos are of the split test; a forest needs some to learn from"
            )
        yield learned, np.flatnonzero(splits == "test")
        return
    people = reader.subjects[known]
    if people.min() >= 0 and len(set(people.tolist())) > 1:
        yield from GroupKFold(min(_FOLDS, len(set(people.tolist())))).split(known, labels, people)
        return
    fewest = int(np.unique(labels, return_counts=True)[1].min())
    if fewest < 2:
        raise DataError(f"{reader.path}: a class of one video and no test split; expected at least two videos a class")
    if fewest < _STEADY:
        log.warn(f"{reader.path}: a class has only {fewest} videos; the accuracy is unreliable")
    yield from StratifiedKFold(min(_FOLDS, fewest), shuffle=True, random_state=0).split(known, labels)


def _tell_left_out(reader: CloudsReader, known: np.ndarray) -> None:
    """Counts the videos that the forest neither learns from nor is judged on, but for those of the split `validation`, with a
    message."""
    unlabeled = [reader.names[i] for i in np.setdiff1d(np.arange(len(reader)), known)]
    if unlabeled:
        log.warn(
            f"{reader.path}: {counted(len(unlabeled), 'video')} without a label left out: {first_names(unlabeled)}"
        )
    splits = {reader.splits[i] for i in known}
    others = about_other_splits(reader) if {"train", "test"} <= splits else ""
    if others:
        log.warn(f"{reader.path}: {others}")


def _tell_unknown_classes(
    reader: CloudsReader, labels: np.ndarray, rounds: list[tuple[np.ndarray, np.ndarray]], judged: int
) -> None:
    """Warns of judged videos whose class no forest that judged them had learned: they can't be right."""
    lost = np.concatenate([own[~np.isin(labels[own], labels[learned])] for learned, own in rounds])
    if len(lost):
        table = class_table(reader)
        names = [table[label] for label in np.unique(labels[lost])]
        log.warn(
            f"{reader.path}: {len(lost)} of {counted(judged, 'judged video')} count as wrong, since no other video of their"
            f" class was there to learn from: {first_names(names)}"
        )


def _forest_scores(
    learned: np.ndarray, labels: np.ndarray, judged: np.ndarray, classes: int, seed: int
) -> np.ndarray:  # [N, C]
    """Returns the probabilities that a forest gives; a class that it never saw has 0."""
    from sklearn.ensemble import RandomForestClassifier

    forest = RandomForestClassifier(TREES, random_state=scikit_learn_state(seed), n_jobs=1).fit(learned, labels)
    scores = np.zeros((len(judged), classes), np.float32)
    scores[:, forest.classes_] = forest.predict_proba(judged)
    return scores


def _seen(reader: CloudsReader, known: np.ndarray, rounds: list[tuple[np.ndarray, np.ndarray]]) -> str:
    people = reader.subjects[known]
    if people.min() < 0:
        return f"of people whom it may know: {unknown_people(reader, known)}"
    shared = [set(people[learned].tolist()) & set(people[judged].tolist()) for learned, judged in rounds]
    return (
        "of people whom it also learned from: people never seen come out lower" if any(shared) else "of unseen people"
    )


def _write(
    reader: CloudsReader, sequences: np.ndarray, scores: np.ndarray, output: str, seed: int, force: bool
) -> None:
    with output_file(output) as target:
        entry = provenance.record({"baseline": "forest", "trees": TREES}, seed, {"data": reader.path})
        words = {"class_names": class_table(reader), "source": reader.path.name, "provenance": entry, "force": force}
        with ScoresWriter(target, **words) as writer:
            for sequence, row in zip(sequences, scores):
                name, label, split = reader.names[sequence], int(reader.labels[sequence]), reader.splits[sequence]
                writer.write(name, row, label=label, split=split)
