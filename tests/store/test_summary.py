"""What `dpc info` tells, against values known from making the file."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter, ScoresWriter
from dpcli.store import summary as info_module
from dpcli.store.gaussians import write_scene
from dpcli.store.summary import point_ranges, summary
from tests.support.scenes import toy_scene


def write_clouds(path: Path, seed: int = 0) -> np.ndarray:
    """Three sequences: frames of 5 and 3, of 0 and 4 and 2, of 7 points. Returns all points."""
    rng = np.random.default_rng(seed)
    every = []
    sizes, samples = [(5, 3), (0, 4, 2), (7,)], [("a", "test", 1, 3), ("b", "train", 0, 1), ("c", "test", -1, 3)]
    with CloudsWriter(path, class_names=["x", "y", "z"], length_unit="mm", source="made", fields=["time"]) as writer:
        for counts, (name, split, label, subject) in zip(sizes, samples, strict=True):
            frames = [rng.normal(size=(n, 3)) for n in counts]
            time = 10.0 + 0.5 * np.arange(len(counts))
            sequence = CloudSequence.from_frames(name, frames, split=split, label=label, subject=subject, time=time)
            writer.write(sequence)
            every.append(sequence.points)
    return np.concatenate(every)


def test_summary_of_clouds_by_hand(tmp_path: Path) -> None:
    points = write_clouds(tmp_path / "c.h5")
    found = summary(tmp_path / "c.h5")
    assert found["kind"] == "clouds" and found["schema"] == 1 and found["length_unit"] == "mm"
    assert found["counts"] == {"sequences": 3, "frames": 6, "points": 21, "empty_frames": 1, "not_finite_points": 0}
    assert found["frames_per_sequence"] == {"min": 1, "median": 2, "max": 3}
    assert found["points_per_frame"] == {"min": 0, "median": 3.5, "max": 7}
    assert found["frame_interval"] == {"min": 0.5, "median": 0.5, "max": 0.5}  # steps between sequences don't count
    assert found["splits"] == {"train": 1, "test": 2} and list(found["splits"]) == ["train", "test"]
    assert found["subjects"] == {"1": 1, "3": 2} and found["cameras"] == {}
    assert found["unknown_labels"] == 1
    assert [(row["name"], row["samples"], row["splits"]) for row in found["classes"]] == [
        ("x", 1, {"train": 1}),
        ("y", 1, {"test": 1}),
        ("z", 0, {}),
    ]
    for column, axis in enumerate("xyz"):
        assert found["range"][axis] == [points[:, column].min(), points[:, column].max()]


def test_the_parts_of_each_sequence_are_counted(tmp_path: Path) -> None:
    with CloudsWriter(tmp_path / "c.h5", class_names=["x"], fields=["part"]) as writer:
        for name, ids in (("a", [[0, 2, -1], [2, 2]]), ("b", [[1, 1]]), ("c", [[0, 1], [5, 3, -1]])):
            frames = [np.ones((len(own), 3)) for own in ids]
            writer.write(CloudSequence.from_frames(name, frames, part=[np.array(own, np.int16) for own in ids]))
    assert summary(tmp_path / "c.h5")["parts_per_sequence"] == {"min": 1, "median": 2, "max": 4}


def test_activations_are_among_the_fields(tmp_path: Path) -> None:
    write_clouds(tmp_path / "c.h5")
    with h5py.File(tmp_path / "c.h5", "r+") as file:
        file["activation/dynamic"] = np.zeros(21, np.float32)
    assert summary(tmp_path / "c.h5")["fields"][-1] == "activation/dynamic"


def test_summary_of_scores(tmp_path: Path) -> None:
    path = tmp_path / "s.h5"
    with ScoresWriter(path, class_names=["x", "y"], streams=("static",), provenance={"command": "dpc made"}) as writer:
        writer.write("a", np.array([0.25, 0.75]), label=1, split="test", streams={"static": np.array([1.0, 0])})
        writer.write("b", np.array([-1.0, 2.0]), streams={"static": np.array([1.0, 0])})
    found = summary(path)
    assert found["counts"] == {"samples": 2, "classes": 2} and found["streams"] == ["static"]
    assert found["range"] == {"scores": [-1.0, 2.0]} and found["unknown_labels"] == 1
    assert found["splits"] == {"test": 1, "": 1}
    assert found["provenance"] == [{"command": "dpc made"}]


@pytest.mark.parametrize(("rows", "wide"), [(1, 1), (4, 2), (7, 3), (1000, 1024)])
def test_ranges_do_not_depend_on_the_block(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: int, wide: int
) -> None:
    points = write_clouds(tmp_path / "c.h5")
    monkeypatch.setattr(info_module, "_ROWS", rows)
    monkeypatch.setattr(info_module, "_WIDE", wide)
    with CloudsReader(tmp_path / "c.h5") as reader:
        ranges, bad = point_ranges(reader)
    assert bad == 0
    assert ranges == {axis: [points[:, i].min(), points[:, i].max()] for i, axis in enumerate("xyz")}


@pytest.mark.parametrize("rows", [2, 1000])
def test_points_that_are_no_numbers_are_counted_and_ignored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: int
) -> None:
    points = write_clouds(tmp_path / "c.h5")
    monkeypatch.setattr(info_module, "_ROWS", rows)
    with h5py.File(tmp_path / "c.h5", "r+") as file:
        for row, column, value in ((0, 0, np.nan), (1, 2, np.inf), (12, 1, -np.inf), (12, 0, np.nan)):
            file["points"][row, column] = value
    kept = np.delete(points, [0, 1, 12], axis=0)
    found = summary(tmp_path / "c.h5")
    assert found["counts"]["not_finite_points"] == 3
    assert found["range"]["x"] == [kept[:, 0].min(), kept[:, 0].max()]
    with h5py.File(tmp_path / "c.h5", "r+") as file:
        file["points"][:] = np.nan
    found = summary(tmp_path / "c.h5")
    assert found["counts"]["not_finite_points"] == 21 and found["range"] == {"x": None, "y": None, "z": None}


def test_memory_does_not_grow_with_the_file(tmp_path: Path) -> None:
    frame = np.random.default_rng(0).normal(size=(500_000, 3)).astype(np.float32)
    peaks = []
    for count in (5, 10):  # 30 and 60 MB of points
        path = tmp_path / f"{count}.h5"
        with CloudsWriter(path) as writer:
            for index in range(count):
                writer.write(CloudSequence.from_frames(f"s{index}", [frame]))
        tracemalloc.start()
        summary(path)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 40e6 and peaks[1] < 1.2 * peaks[0]


def test_a_scene_is_summarized_and_a_broken_one_is_named(tmp_path: Path) -> None:
    scene = toy_scene()
    write_scene(tmp_path / "scene.h5", scene)
    found = summary(tmp_path / "scene.h5")
    assert found["counts"]["gaussians"] == len(scene.mean) and found["counts"]["frames"] == len(scene.time)
    assert sum(found["gaussians_per_part"].values()) == len(scene.mean)
    path = tmp_path / "v.h5"
    with h5py.File(path, "w") as file:
        file.attrs.update({"dpc_kind": "gaussians", "dpc_schema": 1, "dpc_version": "9"})
        file.create_dataset("mean", data=np.zeros((5, 3), np.float32))
    with pytest.raises(DataError, match="log_scale.* missing"):
        summary(path)
