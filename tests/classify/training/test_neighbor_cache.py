"""Neighborhoods kept between epochs: the same as searched anew, the same training, nothing left behind, no room told."""

from __future__ import annotations

import json
import resource
from pathlib import Path

import numpy as np
import pytest
import torch

import dpcli.classify.training.trainer as training
from dpcli.classify.network.backbones.interface import Grouping, clip_points
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.settings import network_config
from dpcli.classify.training.neighbor_cache import NeighborCache
from dpcli.errors import UsageError
from dpcli.runtime.settings.catalog import Given
from dpcli.runtime.whole_file import DiskFull
from tests.classify.commands.test_train_predict import gestures, last_weights
from tests.support.commands import exit_code as dpc

SMALL = (
    "--preset",
    "tiny",
    "--frames",
    "4",
    "--points",
    "64",
    "--batch",
    "4",
    "--seed",
    "3",
    "--validation",
    "none",
    "--epochs",
    "0",  # only the dynamic stage keeps neighbors
    "--lr",
    "0.001",
)

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return gestures(tmp_path_factory.mktemp("data") / "clouds.h5")


def fields(groups: list[Grouping]) -> list[torch.Tensor]:
    return [tensor for group in groups for tensor in vars(group).values() if tensor is not None]


@pytest.mark.parametrize("backbone", ["pointnet2", "dgcnn", "spidercnn", "tests.support.tiny_backbone:TinyBackbone"])
def test_kept_neighborhoods_are_those_that_a_search_finds(backbone, tmp_path):
    torch.manual_seed(0)
    config = network_config(Given("tiny", sets={"frames": 3, "points": 64, "backbone": backbone}), 3)
    model, searched = Kinet(config), []

    def search(points):
        searched.append(len(points))
        return model.group(points)

    clips = torch.randn(5, 3, 64, 3) * 0.3
    cache = NeighborCache(search, tmp_path, 5)
    for numbers in ([0, 1], [1, 4, 0], [3, 2], [4, 3, 2, 1, 0]):
        found = cache(clips[numbers], torch.tensor(numbers))
        assert all(map(torch.equal, fields(found), fields(model.group(clips[numbers]))))
    assert searched == [2, 1, 2]  # each clip once
    assert not list(tmp_path.iterdir())  # a file without a name
    other = cache(clips[[1, 0]], torch.tensor([0, 1]))  # numbers of other clips: what the comparison must see
    assert not all(map(torch.equal, fields(other), fields(model.group(clips[[1, 0]]))))


def test_indices_of_more_points_than_two_bytes_count(tmp_path):
    """70,000 points: index 69,999 must come back as itself, not modulo 65,536."""
    points = torch.randn(1, 1, 70_000, 3)

    def search(some):
        cloud, times = clip_points(some)
        idx = torch.tensor([[[69_999, 0]]])
        return [Grouping(cloud, times, cloud[:, :1], times[:, :1], idx)]

    cache = NeighborCache(search, tmp_path, 1)
    assert cache(points, torch.tensor([0]))[0].idx.tolist() == [[[69_999, 0]]]


def test_a_backbone_that_groups_points_of_its_own_is_refused(tmp_path):
    def search(points):
        cloud, times = clip_points(points)
        return [Grouping(cloud + 1, times, cloud, times, torch.zeros(len(cloud), cloud.shape[1], 2, dtype=torch.int64))]

    with pytest.raises(UsageError, match="draws: this backbone groups points"):
        NeighborCache(search, tmp_path, 1)(torch.randn(1, 2, 8, 3), torch.tensor([0]))


def test_a_training_with_kept_neighbors_is_the_one_that_searches_each_time(data, tmp_path, monkeypatch):
    words = (*SMALL, "--set", "epochs_dynamic=3", "--set", "draws=2", "--set", "accumulate=2")
    searched: list[int] = []

    class Counting(NeighborCache):
        def __init__(self, search, *rest):
            super().__init__(lambda points: searched.append(len(points)) or search(points), *rest)

    class Forgetting(NeighborCache):
        def __call__(self, points, clips):
            return self.search(points)

    for name, kind in (("kept", Counting), ("searched", Forgetting)):
        monkeypatch.setattr(training, "NeighborCache", kind)
        assert dpc("classify", "train", data, "-o", tmp_path / name, *words) == 0
    assert sum(searched) == 2 * 8  # eight training videos, two draws; three epochs
    kept, anew = last_weights(tmp_path / "kept"), last_weights(tmp_path / "searched")
    assert all(torch.equal(kept[key], anew[key]) for key in kept)
    assert {path.name for path in (tmp_path / "kept").iterdir()} == {
        path.name for path in (tmp_path / "searched").iterdir()
    }
    assert json.loads((tmp_path / "kept" / "config.json").read_text())["schedule"]["draws"] == 2
    monkeypatch.setattr(training, "NeighborCache", NeighborCache)
    assert (
        dpc(
            "classify",
            "train",
            data,
            "-o",
            tmp_path / "fresh",
            *SMALL,
            "--set",
            "epochs_dynamic=3",
            "--set",
            "accumulate=2",
        )
        == 0
    )
    fresh = last_weights(tmp_path / "fresh")
    assert not all(torch.equal(kept[key], fresh[key]) for key in kept)  # draws that come back are another training
    assert json.loads((tmp_path / "fresh" / "config.json").read_text())["schedule"]["draws"] == 0


@pytest.mark.parametrize(
    ("more", "last"), [((), 4), (("--set", "clips_per_video=2", "--set", "video_loss=true"), 6)], ids=["clip", "video"]
)
def test_a_stopped_run_with_draws_goes_on_to_the_same_weights(data, tmp_path, monkeypatch, more, last):
    words = (*SMALL, "--set", "epochs_dynamic=3", "--set", "draws=2", *more)
    assert dpc("classify", "train", data, "-o", tmp_path / "whole", *words) == 0
    take, taken = training.Trainer._take, []

    def stopping(self, *batch):
        taken.append(None)
        if len(taken) == last:  # in the second epoch
            self.stop.requested, self.stop.name = True, "a test"
        return take(self, *batch)

    with monkeypatch.context() as patch:
        patch.setattr(training.Trainer, "_take", stopping)
        assert dpc("classify", "train", data, "-o", tmp_path / "parts", *words) == 75
    assert dpc("classify", "train", data, "-o", tmp_path / "parts", *words) == 0
    whole, parts = last_weights(tmp_path / "whole"), last_weights(tmp_path / "parts")
    assert all(torch.equal(whole[key], parts[key]) for key in whole)


def test_no_room_for_neighbors_is_told_before_the_work(tmp_path):
    model = Kinet(network_config(Given("tiny", sets={"frames": 2, "points": 64}), 3))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, before[1]))
    try:
        with pytest.raises(DiskFull, match="file size limit"):
            NeighborCache(model.group, tmp_path, 1000)(torch.randn(1, 2, 64, 3), torch.tensor([0]))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_draws_below_zero_are_refused(data, tmp_path, capfd):
    assert dpc("classify", "train", data, "-o", tmp_path / "run", *SMALL, "--set", "draws=-1") == 2
    assert "draws = -1: expected at least 0" in capfd.readouterr().err


def test_every_process_keeps_its_own(tmp_path):
    """Two caches of one folder, as two processes of torchrun have: neither reads what the other kept."""
    model = Kinet(network_config(Given("tiny", sets={"frames": 2, "points": 64}), 3))
    clips = torch.randn(2, 2, 64, 3)
    one, other = (NeighborCache(model.group, tmp_path, 2) for _ in range(2))
    one(clips[:1], torch.tensor([0]))
    found = other(clips[1:], torch.tensor([0]))
    np.testing.assert_array_equal(found[0].idx, model.group(clips[1:])[0].idx)
