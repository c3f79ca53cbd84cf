"""`dpc classify predict --reject-below`: what is rejected is marked, scores stay as they are, shards and evaluation know of it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from dpcli.classify.network.model_file import save_model
from dpcli.store import CloudSequence, CloudsWriter, ScoresReader
from tests.classify.stream.test_stream import NAMES, untrained
from tests.support.commands import exit_code


@pytest.fixture
def files(tmp_path):
    save_model(tmp_path / "m.safetensors", *untrained())
    rng = np.random.default_rng(1)
    with CloudsWriter(tmp_path / "c.h5", class_names=NAMES) as writer:
        for i in range(6):
            frames = [rng.normal(size=(30, 3)) for _ in range(5)]
            writer.write(CloudSequence.from_frames(f"v{i}", frames, label=i % 3, split="test"))
    return tmp_path


def predict(folder, name: str, *words: object) -> ScoresReader:
    given = (folder / "c.h5", "--model", folder / "m.safetensors", "-o", folder / name, "--jobs", 1, *words)
    assert exit_code("classify", "predict", *map(str, given)) == 0
    return ScoresReader(folder / name)


def test_rejected_videos_are_marked_and_scores_stay(files, capsys):
    plain = predict(files, "plain.h5")
    assert plain.rejected is None
    threshold = float(np.median(plain.scores.max(1)))
    marked = predict(files, "marked.h5", "--reject-below", threshold)
    assert (marked.scores == plain.scores).all() and (marked.rejected == (plain.scores.max(1) < threshold)).all()
    assert 0 < marked.rejected.sum() < 6
    assert f"nothing recognized in {marked.rejected.sum()} of 6 videos" in capsys.readouterr().err
    exit_code("evaluate", "classification", str(files / "marked.h5"), "--json")
    kept = ~marked.rejected
    right = int((marked.scores[kept].argmax(1) == marked.labels[kept]).sum())
    assert json.loads(capsys.readouterr().out)["accepted"] == {"samples": int(kept.sum()), "correct": right}


def test_shards_join_to_the_same_marks(files):
    whole = predict(files, "whole.h5", "--reject-below", 0.6)
    for k in range(2):
        predict(files, f"part{k}.h5", "--reject-below", 0.6, "--shard", f"{k}/2")
    parts = [str(files / f"part{k}.h5") for k in range(2)]
    assert exit_code("prepare", "merge", *parts, "-o", str(files / "joined.h5")) == 0
    assert (ScoresReader(files / "joined.h5").rejected == whole.rejected).all()
    assert (files / "joined.h5").read_bytes() == (files / "whole.h5").read_bytes()
