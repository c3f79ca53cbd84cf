"""`dpc classify fuse`: the weighted mean of the scores of several models, or of one file's streams (thesis A.1.5).

Arithmetic as the thesis writes it, or geometric, which is the mean of logits that the published code takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from copy import copy
from pathlib import Path

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.path_names import short_names
from dpcli.runtime import provenance
from dpcli.runtime.progress import log
from dpcli.store import ScoresReader, ScoresWriter, input_file, output_file
from dpcli.store.pipes import refuse_repeats

_TAKEN = "fused"  # what evaluations call the main scores: no stream may
MEANS = ("arithmetic", "geometric")
_STEPS = 10_000  # of expectation-maximization; some hundred are usual
_POWER = 100.0  # scores are taken to no higher power: where every model is right, none would be high enough
_OFF = 1e-2  # how far from 1 the sum of a sample's probabilities may be: 16-bit numbers of another program
_LEAST = 1e-12  # the probability a score of 0 is taken for: one sure mistake must not decide alone


def run_fusion(
    inputs: Sequence[str],
    output: str,
    *,
    weights: str | None,
    force: bool,
    weights_from: str | None = None,
    mean: str = "arithmetic",
) -> None:
    """Scores files of the same videos, in any order, become one whose `streams` are its inputs; of one file, its streams
    get another mean.

    weights: `parse_weights`; weights_from: scores files with commas between, as many as inputs and of other, labeled
    videos, on which `likelihood_weights` chooses; mean: `pooled`.
    """
    if mean not in MEANS:
        raise UsageError(f"--mean {mean}: expected {' or '.join(MEANS)}")
    if weights is not None and weights_from is not None:
        raise UsageError("--weights says them and --weights-from chooses them; give one of the two")
    judges = weights_from.split(",") if weights_from is not None else []
    if weights_from is not None and len(judges) != len(inputs):
        raise UsageError(
            f"--weights-from {weights_from}: {len(judges)} files for {len(inputs)}; one for each, in the same order"
        )
    if list(inputs).count("-") > 1:
        raise UsageError("-: stdin is one file; name the others")
    refuse_repeats([*inputs, output])
    refuse_repeats([*judges, output])
    called = [str(Path(name)) if name != "-" else "stdin" for name in inputs]
    if len(called) > 1:  # one file's streams are known only once it is read
        parse_weights(weights, stream_names(short_names(called)))
    with ExitStack() as stack:
        paths = [stack.enter_context(input_file(name)) for name in inputs]
        target = stack.enter_context(output_file(output))
        readers = [ScoresReader(path) for path in paths]
        streams, sources, rows = _streams(readers, called)
        shares = parse_weights(weights, streams, len(inputs) == 1)
        if judges:
            held = [ScoresReader(name) for name in judges]
            _tell_other_models(held, judges, readers, called)
            shares = _chosen_weights(held, judges, streams, sources[0], mean)
        config = {
            "fuse": streams,
            "mean": mean,
            "weights": shares.tolist(),
            "sources": [reader.provenance for reader in readers],
        }
        if judges:
            config["weights_from"] = [provenance.file_digest(Path(name)) for name in judges]
        entry = provenance.record(config, 0, dict(zip(stream_names(short_names(called)), paths)))
        if not force and _already_there(target, entry):
            return
        with ScoresWriter(
            target,
            class_names=sources[0].class_names,
            source=", ".join(Path(name).name for name in called),
            provenance=entry,
            streams=streams,
            force=force,
        ) as writer:
            _write(writer, sources, rows, streams, shares, mean)
    if output != "-":
        said = "" if np.ptp(shares) == 0 else f", weights {', '.join(f'{n} {w:.3g}' for n, w in zip(streams, shares))}"
        kind = "mean" if mean == "arithmetic" else f"{mean} mean"
        print(f"{output}: {kind} of {len(streams)} scores of {len(writer)} videos{said}")


def _streams(
    readers: Sequence[ScoresReader], called: Sequence[str]
) -> tuple[list[str], list[ScoresReader], list[np.ndarray]]:
    """What is averaged: names, scores, and where each has the videos of the first. Of one file these are its streams."""
    for reader, name in zip(readers, called):
        for stream, scores in (("scores", reader.scores), *reader.streams.items()):
            bad = np.flatnonzero((scores < 0).any(1) | (np.abs(scores.sum(1, dtype=np.float64) - 1) > _OFF))
            if len(bad):
                raise DataError(
                    f"{name}: {stream} of {reader.names[bad[0]]!r} are no probabilities ({len(bad)} such samples); "
                    "expected numbers from 0 up whose sum is 1, as softmax makes of logits"
                )
    if len(readers) > 1:
        return stream_names(short_names(called)), list(readers), matching_rows(readers, called)
    if len(readers[0].streams) < 2:
        raise UsageError(f"{called[0]}: one file without streams to fuse; name two or more files")
    views = []
    for scores in readers[0].streams.values():
        view = copy(readers[0])
        view.scores = scores
        views.append(view)
    return list(readers[0].streams), views, [np.arange(len(readers[0].names))] * len(views)


def _labels(sources: Sequence[ScoresReader], rows: Sequence[np.ndarray]) -> np.ndarray:
    """i32 (S): a label that only some files know is taken from them."""
    return np.max([source.labels[at] for source, at in zip(sources, rows)], axis=0)


def parse_weights(text: str | None, names: Sequence[str], named: bool = False) -> np.ndarray:
    """Weights f64 (K) that sum to 1, from `0.5,0.5` or `static=0.3,dynamic=0.7`; None weighs all alike.

    named: names are needed, as streams have no order to go by. UsageError when they don't fit.
    """
    if text is None:
        return np.full(len(names), 1 / len(names))
    words = text.split(",")
    if named or "=" in text:
        pairs = dict(word.partition("=")[::2] for word in words)
        if set(pairs) != set(names) or len(pairs) != len(words):
            raise UsageError(f"--weights {text}: expected {','.join(f'{name}=NUMBER' for name in names)}")
        words = [pairs[name] for name in names]
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise UsageError(f"--weights {text}: expected numbers with commas, such as 0.5,0.5") from None
    if len(values) != len(names):
        raise UsageError(f"--weights {text}: {len(values)} weights for {len(names)} files; one for each")
    if not np.isfinite(values).all() or values.min() < 0 or not 0 < values.sum() < np.inf:
        raise UsageError(f"--weights {text}: expected numbers from 0 up, not all of them 0")
    return values / values.sum()


def pooled(scores: np.ndarray, weights: np.ndarray, mean: str) -> np.ndarray:
    """Mean f64 (S,C) of what K models say, scores (K,S,C), by weights (K) of sum 1; the models' order makes no difference.

    geometric: the product of the scores to the power of their weights, normalized to sum 1: softmax of the mean of logits. A
    class needs every model's consent, where arithmetic lets the surest one decide.
    """
    if mean == "arithmetic":
        return np.sort(scores * weights[:, None, None], axis=0).sum(0)
    from scipy.special import softmax

    return softmax(np.sort(_logits(scores) * weights[:, None, None], axis=0).sum(0), -1)


def _logits(scores: np.ndarray) -> np.ndarray:
    return np.log(np.clip(np.asarray(scores, np.float64), _LEAST, None))


def geometric_weights(scores: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Weights f64 (K), sum 1, of the geometric mean of scores (K,S,C) for labels i (S), by likelihood.

    Fitted as powers from 0 up whose sum is free, as that says how sure the mean is and not which class it names: a convex
    problem (multinomial regression without an intercept), solved by L-BFGS.
    """
    from scipy.optimize import minimize
    from scipy.special import logsumexp, softmax

    logits = _logits(scores)
    true = logits[:, np.arange(len(labels)), labels]  # (K,S)

    def loss(powers: np.ndarray) -> tuple[float, np.ndarray]:
        mixed = np.tensordot(powers, logits, 1)
        expected = np.einsum("ksc,sc->ks", logits, softmax(mixed, -1))
        return float((logsumexp(mixed, -1) - powers @ true).mean()), (expected - true).mean(1)

    start = np.full(len(logits), 1 / len(logits))
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=[(0, _POWER)] * len(logits)).x
    return found / found.sum() if found.sum() > 0 else start


def likelihood_weights(probabilities: np.ndarray) -> np.ndarray:
    """Weights f64 (K), sum 1, of the arithmetic mean that gives labeled samples the greatest likelihood.

    probabilities: (K,S), what each of K models gives the true class of each sample. The logarithm of the likelihood, sum_s log
    sum_k w_k p_ks, is concave in w, so expectation-maximization from equal weights ends at its maximum.
    """
    found = np.clip(np.asarray(probabilities, np.float64), _LEAST, None)
    weights = np.full(len(found), 1 / len(found))
    for _ in range(_STEPS):
        shares = weights[:, None] * found
        new = (shares / shares.sum(0)).mean(1)
        if np.abs(new - weights).max() < 1e-10:
            break
        weights = new
    return new


def _tell_other_models(
    held: Sequence[ScoresReader], judges: Sequence[str], readers: Sequence[ScoresReader], called: Sequence[str]
) -> None:
    """A warning where weights come from another model's scores: fair for a twin trained on fewer videos, else an accident."""
    for theirs, judge, reader, name in zip(held, judges, readers, called):
        one, other = _model_digest(theirs), _model_digest(reader)
        if one and other and one != other:
            log.warn(
                f"{judge}: scores of another model than {name}'s; its weights are right only for a model like that one"
            )


def _model_digest(reader: ScoresReader) -> str | None:
    """Of the model that made the scores, where their last record says it."""
    config = reader.provenance[-1].get("config") if reader.provenance else None
    return config.get("weights") if isinstance(config, dict) and "model" in config else None


def _chosen_weights(
    held: Sequence[ScoresReader], judges: Sequence[str], streams: Sequence[str], fused: ScoresReader, mean: str
) -> np.ndarray:
    """Weights chosen on labeled videos that are not among the fused ones. DataError when they don't fit."""
    names, sources, rows = _streams(held, judges)
    if len(judges) == 1 and names != list(streams):
        raise DataError(f"{judges[0]}: streams {', '.join(names)}; expected {', '.join(streams)}, as in what is fused")
    _same_classes(fused.class_names, sources[0].class_names, "what is fused", judges[0])
    both = sorted(set(fused.names) & set(sources[0].names))
    if both:
        raise DataError(
            f"{judges[0]}: {both[0]!r} is among the fused videos, too ({len(both)} such videos); weights are chosen "
            "on other videos, such as those held out of training (predict --split validation)"
        )
    labels = _labels(sources, rows)
    known = np.flatnonzero(labels >= 0)
    if not len(known):
        raise DataError(f"{judges[0]}: no video has a label; weights are chosen on labeled videos")
    scores = np.stack([source.scores[at][known] for source, at in zip(sources, rows)])
    if mean == "geometric":
        return geometric_weights(scores, labels[known])
    return likelihood_weights(scores[:, np.arange(len(known)), labels[known]])


def stream_names(wanted: Sequence[str]) -> list[str]:
    """The names wanted, numbered (`points`, `points-2`) where another has it already."""
    names: list[str] = []
    for stem in wanted:
        number, name = 1, stem
        while name in (*names, _TAKEN):
            number += 1
            name = f"{stem}-{number}"
        names.append(name)
    return names


def matching_rows(sources: Sequence[ScoresReader], called: Sequence[str]) -> list[np.ndarray]:
    """Where each file has the videos of the first one, i64 (S) each.

    DataError unless all hold the same classes and videos and, where known (label >= 0, split not empty), the same labels
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
        raise DataError(f"{other}: {len(two)} classes, in {first} {len(one)}; fuse scores of the same classes")
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


def _already_there(target: Path, entry: dict) -> bool:
    if not target.exists():
        return False
    from dpcli.classify.commands.predict import _already_scored  # imports torch, which nothing else here needs

    return _already_scored(target, entry)


def _write(
    writer: ScoresWriter,
    sources: Sequence[ScoresReader],
    rows: Sequence[np.ndarray],
    streams: Sequence[str],
    shares: np.ndarray,
    mean: str,
) -> None:
    """In the first file's order; unknown labels and splits are taken from the files that know them."""
    own = np.stack([source.scores[at] for source, at in zip(sources, rows)])  # (files, S, C)
    main = pooled(own, shares, mean)
    labels = _labels(sources, rows)
    for row, name in enumerate(sources[0].names):
        split = next((s.splits[at[row]] for s, at in zip(sources, rows) if s.splits[at[row]]), "")
        writer.write(name, main[row], label=int(labels[row]), split=split, streams=dict(zip(streams, own[:, row])))
