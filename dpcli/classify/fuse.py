"""`dpc classify fuse`: the mean of the scores of several models, as of two streams (thesis A.1.5)."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.runtime import provenance
from dpcli.store import ScoresReader, ScoresWriter, input_file, output_file

_TAKEN = "fused"  # what evaluations call the main scores: no stream may


def run_fusion(inputs: Sequence[str], output: str, *, weights: str | None, force: bool) -> None:
    """Scores files of the same videos, in any order, become one whose `streams` are its inputs."""
    shares = parse_weights(weights, len(inputs))
    _refuse_repeats([*inputs, output])
    with ExitStack() as stack:
        paths = [stack.enter_context(input_file(name)) for name in inputs]
        target = stack.enter_context(output_file(output))
        sources = [ScoresReader(path) for path in paths]
        called = [str(path) if name != "-" else "stdin" for name, path in zip(inputs, paths)]
        streams = stream_names(["stdin" if name == "-" else Path(name).stem for name in inputs])
        rows = matching_rows(sources, called)
        config = {"fuse": streams, "weights": shares.tolist(), "sources": [source.provenance for source in sources]}
        entry = provenance.record(config, 0, dict(zip(streams, paths)))
        if not force and _already_there(target, entry):
            return
        with ScoresWriter(target, class_names=sources[0].class_names, source=", ".join(Path(n).name for n in called),
                          provenance=entry, streams=streams, force=force) as writer:  # fmt: skip
            _write(writer, sources, rows, streams, shares)
    if output != "-":
        print(f"{output}: mean of {len(inputs)} scores of {len(writer)} videos")


def parse_weights(text: str | None, count: int) -> np.ndarray:
    """Weights f64 (count) that sum to 1, from `0.5,0.5`; None weighs all alike. UsageError when they don't fit."""
    if count < 2:
        raise UsageError(f"{count} scores file; name two or more to fuse")
    if text is None:
        return np.full(count, 1 / count)
    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        raise UsageError(f"--weights {text}: expected numbers with commas, such as 0.5,0.5") from None
    if len(values) != count:
        raise UsageError(f"--weights {text}: {len(values)} weights for {count} files; one for each")
    if not np.isfinite(values).all() or values.min() < 0 or not 0 < values.sum() < np.inf:
        raise UsageError(f"--weights {text}: expected numbers from 0 up, not all of them 0")
    return values / values.sum()


def stream_names(stems: Sequence[str]) -> list[str]:
    """A name for each file: its stem, numbered (`scores`, `scores-2`) where another has it already."""
    names: list[str] = []
    for stem in stems:
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
            raise DataError(f"{lacker}: no scores of {missing[0]!r}, which {holder} has ({len(missing)} such videos); "
                            "predict the same videos with each model")  # fmt: skip


def _same_truth(
    one: ScoresReader, rows: np.ndarray, two: ScoresReader, others: np.ndarray, first: str, other: str
) -> None:
    mine, theirs = one.labels[rows], two.labels[others]
    differ = np.flatnonzero((mine != theirs) & (mine >= 0) & (theirs >= 0))
    if len(differ):
        at = differ[0]
        raise DataError(f"{other}: label {theirs[at]} of {one.names[rows[at]]!r}, in {first} it is {mine[at]} "
                        f"({len(differ)} such videos); these are scores of different data")  # fmt: skip
    for row, match in zip(rows, others):
        a, b = one.splits[row], two.splits[match]
        if a and b and a != b:
            raise DataError(f"{other}: {one.names[row]!r} is of split {b!r}, in {first} of {a!r}; "
                            "these are scores of different data")  # fmt: skip


def _refuse_repeats(names: Sequence[str]) -> None:
    if list(names[:-1]).count("-") > 1:
        raise UsageError("-: stdin is one file; name the others")
    paths = [Path(name).resolve() for name in names if name != "-"]
    for path in paths:
        if paths.count(path) > 1:
            raise UsageError(f"{path}: is named twice; every file once, and the output is another one")


def _already_there(target: Path, entry: dict) -> bool:
    if not target.exists():
        return False
    from dpcli.classify.commands import _already_scored  # imports torch, which nothing else here needs

    return _already_scored(target, entry)


def _write(
    writer: ScoresWriter, sources: Sequence[ScoresReader], rows: Sequence[np.ndarray], streams: Sequence[str],
    shares: np.ndarray,
) -> None:  # fmt: skip
    """In the first file's order; unknown labels and splits are taken from the files that know them."""
    own = np.stack([source.scores[at] for source, at in zip(sources, rows)])  # (files, S, C)
    weighed = np.sort(own * shares[:, None, None], axis=0)  # sorted: the sum doesn't depend on the files' order
    mean = weighed.sum(0)
    labels = np.max([source.labels[at] for source, at in zip(sources, rows)], axis=0)
    for row, name in enumerate(sources[0].names):
        split = next((s.splits[at[row]] for s, at in zip(sources, rows) if s.splits[at[row]]), "")
        writer.write(name, mean[row], label=int(labels[row]), split=split, streams=dict(zip(streams, own[:, row])))
