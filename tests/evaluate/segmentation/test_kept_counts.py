"""Kept counts of an evaluation (`-o`): evaluated again as they are, and never under choices that they were not counted with."""

from __future__ import annotations

import json

import h5py
import pytest

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.segmentation.motion_protocol import evaluate_motion
from dpcli.evaluate.segmentation.protocol import evaluate_segmentation
from dpcli.evaluate.segmentation.sequence_pass import Keeping
from tests.support.parts_helpers import perfect, truth_sequence, write_parts, write_truth


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kept")
    sequences = [truth_sequence(f"s{k}", seed=k) for k in range(2)]
    truth = write_truth(folder / "truth.h5", sequences)
    parts = write_parts(folder / "parts.h5", [perfect(one, 4) for one in sequences])
    return folder, parts, truth


@pytest.mark.parametrize("evaluate", [evaluate_segmentation, evaluate_motion])
def test_kept_counts_answer_only_what_they_were_counted_with(files, evaluate):
    folder, parts, truth = files
    kept = folder / f"{evaluate.__name__}.h5"
    first = evaluate(parts, truth, keeping=Keeping(kept))
    for same in ({}, {"truth": truth}, {"split": "test"}):
        assert str(evaluate(kept, **{"truth": None, **same}).main) == str(first.main)
    for options, words in (
        ({"protocol": "release"}, "--protocol release: .* was counted with 'dpc'"),
        ({"split": "train"}, "--split train: .* was counted with 'test'"),
        ({"truth": folder / "other.h5"}, "--truth other.h5: .* was counted with 'truth.h5'"),
        ({"keeping": Keeping(folder / "again.h5")}, "-o .*again.h5: .* holds counts already"),
    ):
        with pytest.raises(UsageError, match=words):
            evaluate(kept, **{"truth": None, **options})
    if evaluate is evaluate_segmentation:
        with pytest.raises(UsageError, match="--ignore-below 20: .* was counted with 0"):
            evaluate(kept, None, ignore_below=20)


@pytest.mark.parametrize("evaluate", [evaluate_segmentation, evaluate_motion])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda config: config.pop("truth"), "its provenance lacks truth"),
        (lambda config: config.update(protocol="relaese"), "counted by protocol 'relaese', expected dpc or release"),
    ],
)
def test_kept_counts_without_their_choices_are_refused(files, tmp_path, evaluate, change, words):
    _, parts, truth = files
    evaluate(parts, truth, keeping=Keeping(tmp_path / "edited.h5"))
    with h5py.File(tmp_path / "edited.h5", "r+") as file:
        *_, last = file["provenance"][:]
        entry = json.loads(last)
        change(entry["config"])
        file["provenance"][-1] = json.dumps(entry)
    with pytest.raises(DataError, match=words):
        evaluate(tmp_path / "edited.h5", None)


@pytest.mark.parametrize("evaluate", [evaluate_segmentation, evaluate_motion])
def test_kept_counts_of_another_version_are_refused(files, evaluate):
    folder, parts, truth = files
    kept = folder / f"old_{evaluate.__name__}.h5"
    evaluate(parts, truth, keeping=Keeping(kept))
    with h5py.File(kept, "r+") as file:
        rows = [json.loads(row) for row in file["statistics"].asstr()[:]]
        for row in rows:
            del row["statistics"][min(row["statistics"])]
        file["statistics"][:] = [json.dumps(row) for row in rows]
    with pytest.raises(DataError, match=f"{kept.name}: counted by another version of dpc; name the parts file"):
        evaluate(kept, None)
