"""Files of drawers, which many tests of the room read."""

from __future__ import annotations

from pathlib import Path

import pytest

from dpcli.store import CloudsWriter
from tests.support.commands import told
from tests.support.drawers import TRAIN, drawer, drawers, with_scene_flow


@pytest.fixture(scope="session")
def data(tmp_path_factory) -> Path:
    return drawers(tmp_path_factory.mktemp("parts") / "clouds.h5", 6)


@pytest.fixture(scope="session")
def run_folder(data, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "model"
    done = told("segment", "train", data, "-o", folder, *TRAIN)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str(folder / "best.safetensors")
    return folder


@pytest.fixture(scope="session")
def flow_data(tmp_path_factory) -> Path:
    """The sequences of `data`, whose truth is scene flow."""
    path = tmp_path_factory.mktemp("parts") / "flow.h5"
    with CloudsWriter(path, class_names=["drawer"], fields=["part", "scene_flow"]) as writer:
        for i in range(6):
            writer.write(with_scene_flow(drawer(f"d{i}", i, split="train" if i < 4 else "test", label=0)))
    return path
