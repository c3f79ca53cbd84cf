"""`dpc classify fuse`: the weighted mean of the scores of several models, or of one file's streams."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.classify.fusion import MEANS, geometric_weights, likelihood_weights, mean_scores, parse_weights
from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.path_names import short_names
from dpcli.runtime import provenance
from dpcli.runtime.progress import log
from dpcli.store import ScoresReader, ScoresWriter, input_file, output_file
from dpcli.store.pipes import refuse_repeats
from dpcli.store.writing.already_made import WORK, already_made

_TAKEN = "fused"  # what evaluations call the main scores: no stream may
_OFF = 1e-2  # how far from 1 the sum of a sample's probabilities may be: 16-bit numbers of another program


@dataclass(frozen=True)
class Fusion:
    """Says how many videos were fused by which weights, by stream; `complete` where an earlier run had done it all."""

    videos: int
    weights: dict[str, float]
    complete: bool = False


@dataclass(frozen=True)
class _Aligned:
    """Holds the scores f32 (K,S,C) that K streams give to the same S videos, in one order, and what is known of the videos.

    labels: i32 (S), -1 where no file knows one; splits: "" likewise.
    """

    streams: list[str]
    scores: np.ndarray
    class_names: list[str]
    names: list[str]
    labels: np.ndarray
    splits: list[str]


def fuse(
    inputs: Sequence[str],
    output: str,
    *,
    weights: str | None = None,
    force: bool = False,
    weights_from: str | None = None,
    mean: str = "arithmetic",
) -> Fusion:
    """Joins scores files of the same videos, in any order, into one whose `streams` are these; of one file, averages its
    streams anew.

    weights: `parse_weights`; weights_from: scores files with commas between, as many as inputs and of other, labeled
    videos, on which `likelihood_weights` chooses; mean: `mean_scores`. Raises UsageError for words that don't fit, DataError
    for files of different data.
    """
    judges = _judges(inputs, output, weights, weights_from, mean)
    called = [str(Path(name)) if name != "-" else "stdin" for name in inputs]
    if len(called) > 1:  # one file's streams are known only once it is read
        parse_weights(weights, stream_names(short_names(called)))
    with ExitStack() as stack:
        paths = [stack.enter_context(input_file(name)) for name in inputs]
        target = stack.enter_context(output_file(output))
        readers = [ScoresReader(path) for path in paths]
        made = _aligned(readers, called)
        shares = parse_weights(weights, made.streams, len(inputs) == 1)
        _tell_rejected(readers, called)
        if judges:
            held = [ScoresReader(name) for name in judges]
            _tell_other_models(held, judges, readers, called)
            shares = _chosen_weights(held, judges, made, mean)
        config = _record(made.streams, mean, shares, readers, judges)
        entry = provenance.record(config, 0, dict(zip(stream_names(short_names(called)), paths)))
        fusion = Fusion(len(made.names), dict(zip(made.streams, shares.tolist())))
        if not force and already_made(target, entry, ScoresReader, WORK):
            return replace(fusion, complete=True)
        with ScoresWriter(
            target,
            class_names=made.class_names,
            source=", ".join(Path(name).name for name in called),
            provenance=entry,
            streams=made.streams,
            force=force,
        ) as writer:
            main = mean_scores(made.scores, shares, mean)
            for row, name in enumerate(made.names):
                own = dict(zip(made.streams, made.scores[:, row]))
                writer.write(name, main[row], label=int(made.labels[row]), split=made.splits[row], streams=own)
    return fusion


def _judges(inputs: Sequence[str], output: str, weights: str | None, weights_from: str | None, mean: str) -> list[str]:
    """Returns the files that choose the weights. Raises UsageError when the words of the command don't fit together."""
    if mean not in MEANS:
        raise UsageError(f"--mean {mean}: expected {' or '.join(MEANS)}")
    if weights is not None and weights_from is not None:
        raise UsageError("--weights gives the weights and --weights-from chooses them; give only one of the two")
    judges = weights_from.split(",") if weights_from is not None else []
    if weights_from is not None and len(judges) != len(inputs):
        raise UsageError(
            f"--weights-from {weights_from}: {counted(len(judges), 'file')} for {len(inputs)}; one for each, in the same order"
        )
    if list(inputs).count("-") > 1:
        raise UsageError("-: stdin is one file; name the others")
    refuse_repeats([*inputs, output])
    refuse_repeats([*judges, output])
    return judges


def _record(
    streams: list[str], mean: str, shares: np.ndarray, readers: Sequence[ScoresReader], judges: Sequence[str]
) -> dict[str, Any]:
    """Returns what shapes the scores, for the file's provenance."""
    config: dict[str, Any] = {
        "fuse": streams,
        "mean": mean,
        "weights": shares.tolist(),
        "sources": [reader.provenance for reader in readers],
    }
    if judges:
        config["weights_from"] = [provenance.file_digest(Path(name)) for name in judges]
    return config


def _aligned(readers: Sequence[ScoresReader], called: Sequence[str]) -> _Aligned:
    """Returns what is averaged, in the order of the first file: the scores of several files, or of one file its streams.

    A label or a split that only some files know is taken from these. Raises DataError for scores that are no probabilities and
    files of different videos, UsageError for one file without streams.
    """
    for reader, name in zip(readers, called):
        for stream, scores in (("scores", reader.scores), *reader.streams.items()):
            bad = np.flatnonzero((scores < 0).any(1) | (np.abs(scores.sum(1, dtype=np.float64) - 1) > _OFF))
            if len(bad):
                raise DataError(
                    f"{name}: {stream} of {reader.names[bad[0]]!r} are not probabilities ({len(bad)} such samples); "
                    "expected numbers from 0 up whose sum is 1, as from a softmax"
                )
    first = readers[0]
    if len(readers) == 1 and len(first.streams) < 2:
        raise UsageError(f"{called[0]}: one file without streams to fuse; name two or more files")
    rows = matching_rows(readers, called)
    if len(readers) == 1:
        streams, scores = list(first.streams), np.stack(list(first.streams.values()))
    else:
        streams = stream_names(short_names(called))
        scores = np.stack([reader.scores[at] for reader, at in zip(readers, rows)])
    labels = np.max([reader.labels[at] for reader, at in zip(readers, rows)], axis=0)
    known = zip(*([reader.splits[row] for row in at] for reader, at in zip(readers, rows)))
    splits = [next(filter(None, own), "") for own in known]
    return _Aligned(streams, scores, first.class_names, first.names, labels, splits)


def _tell_rejected(readers: Sequence[ScoresReader], called: Sequence[str]) -> None:
    """Warns of files that mark videos as not recognized: fused scores have no such marks, as thresholds were for single ones."""
    for reader, name in zip(readers, called):
        if reader.rejected is not None and reader.rejected.any():
            count = int(reader.rejected.sum())
            log.warn(
                f"{name}: marks {counted(count, 'video')} as not recognized; the fused scores mark none, since its threshold was"
                " for its own scores"
            )


def _tell_other_models(
    held: Sequence[ScoresReader], judges: Sequence[str], readers: Sequence[ScoresReader], called: Sequence[str]
) -> None:
    """Warns where weights come from another model's scores: fair for one trained on fewer videos, else an accident."""
    for theirs, judge, reader, name in zip(held, judges, readers, called):
        one, other = _model_digest(theirs), _model_digest(reader)
        if one and other and one != other:
            log.warn(
                f"{judge}: scores of another model than {name}'s; its weights are right only for a model like that one"
            )


def _model_digest(reader: ScoresReader) -> str | None:
    """Returns the digest of the model that made the scores, where their last record says it."""
    config = reader.provenance[-1].get("config") if reader.provenance else None
    return config.get("weights") if isinstance(config, dict) and "model" in config else None


def _chosen_weights(held: Sequence[ScoresReader], judges: Sequence[str], fused: _Aligned, mean: str) -> np.ndarray:
    """Returns weights chosen on labeled videos that are not among the fused ones. Raises DataError when they don't fit."""
    own = _aligned(held, judges)
    if len(judges) == 1 and own.streams != fused.streams:
        raise DataError(
            f"{judges[0]}: streams {', '.join(own.streams)}; expected {', '.join(fused.streams)}, as in what is fused"
        )
    _same_classes(fused.class_names, own.class_names, "what is fused", judges[0])
    both = sorted(set(fused.names) & set(own.names))
    if both:
        raise DataError(
            f"{judges[0]}: {both[0]!r} is among the fused videos, too ({len(both)} such videos); weights are chosen "
            "on other videos, such as those held out of training (predict --split validation)"
        )
    known = own.labels >= 0
    if not known.any():
        raise DataError(f"{judges[0]}: no video has a label; weights are chosen on labeled videos")
    scores, labels = own.scores[:, known], own.labels[known]
    if mean == "geometric":
        return geometric_weights(scores, labels)
    return likelihood_weights(scores[:, np.arange(len(labels)), labels])


def stream_names(wanted: Sequence[str]) -> list[str]:
    """Returns the names wanted, numbered (`points`, `points-2`) where another has it already."""
    names: list[str] = []
    for stem in wanted:
        number, name = 1, stem
        while name in (*names, _TAKEN):
            number += 1
            name = f"{stem}-{number}"
        names.append(name)
    return names


def matching_rows(sources: Sequence[ScoresReader], called: Sequence[str]) -> list[np.ndarray]:
    """Returns where each file has the videos of the first one, i64 (S) each.

    Raises DataError unless all hold the same classes and videos and, where known (label >= 0, split not empty), the same labels
    and splits; it names the first difference.
    """
    first, found = sources[0], []
    for source, name in zip(sources, called):
        _same_classes(first.class_names, source.class_names, called[0], name)
        _same_videos(first.names, source.names, called[0], name)
        place = {video: row for row, video in enumerate(source.names)}
        found.append(np.array([place[video] for video in first.names], np.int64))
    for k, (source, rows) in enumerate(zip(sources, found)):
        for j in range(k):
            _same_truth(sources[j], found[j], source, rows, called[j], called[k])
    return found


def _same_classes(one: list[str], two: list[str], first: str, other: str) -> None:
    if len(one) != len(two):
        raise DataError(
            f"{other}: {counted(len(two), 'class')}, in {first} {len(one)}; fuse scores of the same classes"
        )
    for index, (a, b) in enumerate(zip(one, two)):
        if a != b:
            raise DataError(f"{other}: class {index} is {b!r}, in {first} it is {a!r}; fuse scores of the same classes")


def _same_videos(one: list[str], two: list[str], first: str, other: str) -> None:
    for holder, lacker, names, others in ((first, other, one, two), (other, first, two, one)):
        there = set(others)
        missing = [name for name in names if name not in there]
        if missing:
            raise DataError(
                f"{lacker}: no scores of {missing[0]!r}, which {holder} has ({len(missing)} such videos); "
                "predict the same videos with each model"
            )


def _same_truth(
    one: ScoresReader, rows: np.ndarray, two: ScoresReader, others: np.ndarray, first: str, other: str
) -> None:
    mine, theirs = one.labels[rows], two.labels[others]
    differ = np.flatnonzero((mine != theirs) & (mine >= 0) & (theirs >= 0))
    if len(differ):
        at = differ[0]
        raise DataError(
            f"{other}: label {theirs[at]} of {one.names[rows[at]]!r}, in {first} it is {mine[at]} "
            f"({len(differ)} such videos); these are scores of different data"
        )
    for row, match in zip(rows, others):
        a, b = one.splits[row], two.splits[match]
        if a and b and a != b:
            raise DataError(
                f"{other}: {one.names[row]!r} is of split {b!r}, in {first} of {a!r}; "
                "these are scores of different data"
            )
