"""The files that reports are tested with, and the page of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dpcli.evaluate.report import arrange, collect, report_html
from dpcli.store import CloudSequence, CloudsWriter, PartsWriter, ScoresWriter
from tests.support.report_helpers import EVIL, NAMES


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("report")


@pytest.fixture(scope="module")
def scores(folder) -> Path:
    path, noise = folder / "scores.h5", np.random.default_rng(0)
    history = {"command": f"dpc prepare msraction3d RAW {EVIL}", "seed": 3}
    with ScoresWriter(path, class_names=NAMES, provenance=history, streams=("static", "dynamic")) as writer:
        for index in range(30):
            row = noise.normal(size=3) + 1.5 * np.eye(3)[index % 3]
            writer.write(f"v{index}", row, label=index % 3, split="test", streams={"static": row, "dynamic": -row})
    return path


@pytest.fixture(scope="module")
def truth(folder) -> Path:
    """Two rigid bodies; `bad` is a sequence whose parts the prediction has all wrong."""
    path = folder / "truth.h5"
    with CloudsWriter(path, fields=("part", "pose"), length_unit="meter") as writer:
        for name in ("bad", "good", "fine", "well"):
            writer.write(_sequence(name))
    return path


@pytest.fixture(scope="module")
def parts(folder, truth) -> Path:
    path = folder / "parts.h5"
    with PartsWriter(path, num_parts=2, length_unit="meter", provenance={"command": "dpc segment predict"}) as writer:
        for name in ("bad", "good", "fine", "well"):
            sequence = _sequence(name)
            sequence.pose = None
            if name == "bad":
                sequence.part = np.tile([0, 1], len(sequence.part) // 2).astype(np.int16)
            hard = np.eye(2, dtype=np.float32)[sequence.part]
            writer.write(sequence, hard, np.array([[0, 1]]), np.tile(np.eye(4), (1, 2, 1, 1)), [np.zeros((40, 3))])
    return path


def _sequence(name: str) -> CloudSequence:
    points = np.random.default_rng(len(name)).normal(size=(40, 3)).astype(np.float32)
    part = np.repeat([0, 1], 20).astype(np.int16)
    pose = np.tile(np.eye(4), (2, 2, 1, 1))
    pose[1, 1, 0, 3] = 0.5  # body 1 moves by half a meter
    moved = points + np.where(part == 1, 0.5, 0.0)[:, None].astype(np.float32) * np.array([1, 0, 0], np.float32)
    return CloudSequence(name, np.concatenate([points, moved]), np.array([0, 40, 80]), part=np.tile(part, 2), pose=pose)


@pytest.fixture(scope="module")
def page(scores, parts, truth) -> str:
    return report_html(arrange(collect([str(scores), str(parts)], truth), title=f"A {EVIL}"))
