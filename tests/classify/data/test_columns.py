"""The columns that a network for sparse clouds reads: what numbers, counts and dates is left out by its values, with the reason."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.classify.data.columns import telling_columns
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter
from dpcli.store.schema import kept_name

SENSELESS = {
    "row": "numbers the points of a frame",
    "line of the table": "numbers the points of a frame",
    "frame": "rises or falls with time",
    "counter of 8 bits": "rises or falls with time",
    "seconds": "rises or falls with time",
    "stamp": "rises or falls with time",
    "time left": "rises or falls with time",
    "recording": "tells which video it is",
    "class": "tells which video it is",
    "tracker's number": "tells which video it is",
    "version": "is 3 everywhere",
    "broken": "has no number",
    "noise": "might as well be drawn at random",
    "number of 8": "might as well be drawn at random",
}
TELLING = ("speed", "intensity", "angle", "error")


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """Thirty videos of three classes; the speed goes with the class, the intensity with the distance, the angle with x,
    and of the error the spread alone with the class."""
    rng, path = np.random.default_rng(0), tmp_path_factory.mktemp("columns") / "c.h5"
    points = 0
    with CloudsWriter(path, class_names=list("abc"), fields=list(map(kept_name, (*TELLING, *SENSELESS)))) as writer:
        for k in range(30):
            sizes = rng.integers(1, 9 + 2 * (k % 3), rng.integers(20, 40))  # how many points there are tells the class
            frames = [rng.normal((0, 0, 2 + k / 10), 0.3, (size, 3)).astype(np.float32) for size in sizes]
            video = CloudSequence.from_frames(f"v{k}", frames, label=k % 3, split="train")
            count, frame = len(video.points), np.repeat(np.arange(len(sizes)), sizes)
            row = np.arange(count) - np.repeat(video.frame_offsets[:-1], sizes)
            values = {
                "speed": rng.normal(k % 3 - 1, 1, count),
                "intensity": 1 / np.linalg.norm(video.points, axis=1) + rng.normal(0, 0.05, count),
                "angle": np.arctan2(video.points[:, 0], video.points[:, 2]),
                "error": np.random.default_rng(k).normal(0, 1 + k % 3, count),
                "row": row,
                "line of the table": points + np.arange(count),
                "frame": frame,
                "counter of 8 bits": (200 + 7 * k + frame) % 256,
                "seconds": frame / 15 + rng.normal(0, 0.001, count),
                "stamp": 1e6 + 60 * k + frame / 15,
                "time left": (len(sizes) - frame) / 15,
                "recording": np.full(count, k),
                "class": np.full(count, k % 3),
                "tracker's number": 5 * k + rng.integers(0, 5, count),
                "version": np.full(count, 3),
                "broken": np.full(count, np.nan),
                "noise": rng.random(count),
                "number of 8": rng.integers(0, 8, count),
            }
            points += count
            video.extra = {kept_name(name): own.astype(np.float32) for name, own in values.items()}
            writer.write(video)
    return path


def test_columns_that_number_count_and_date_are_not_read_and_the_reason_is_told(file):
    read, left_out = telling_columns(CloudsReader(file), range(30))
    assert set(read) == set(TELLING) and left_out == SENSELESS


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("frames", "points"), [(3, 4), (3, 10), (1, 30)])
def test_short_and_sparse_videos_are_judged_without_a_warning(tmp_path, frames, points):
    rng, noise = np.random.default_rng(0), kept_name("noise")
    with CloudsWriter(tmp_path / "s.h5", class_names=["a", "b"], fields=[noise]) as writer:
        for k in range(20):
            clouds = [rng.normal(0, 0.1, (points, 3)).astype(np.float32) for _ in range(frames)]
            video = CloudSequence.from_frames(f"v{k}", clouds, label=k % 2, split="train")
            video.extra = {noise: rng.random(frames * points).astype(np.float32)}
            writer.write(video)
    read, left_out = telling_columns(CloudsReader(tmp_path / "s.h5"), range(20))
    assert (read, left_out) == ((), {"noise": "might as well be drawn at random"})


def test_a_number_that_names_joints_is_read(tmp_path):
    rng, joint = np.random.default_rng(0), kept_name("joint")
    with CloudsWriter(tmp_path / "j.h5", class_names=["a", "b"], fields=[joint]) as writer:
        for k in range(16):
            frames = [(rng.normal(0, 0.1, (5, 3)) + np.arange(5)[:, None]).astype(np.float32) for _ in range(12)]
            video = CloudSequence.from_frames(f"v{k}", frames, label=k % 2, split="train")
            video.extra = {joint: np.tile(np.arange(5, dtype=np.float32), 12)}
            writer.write(video)
    assert telling_columns(CloudsReader(tmp_path / "j.h5"), range(16)) == (("joint",), {})


def test_few_videos_and_no_classes_leave_out_only_what_is_certain(file):
    reader = CloudsReader(file)
    read, left_out = telling_columns(reader, range(30), by_class=False)
    assert set(read) == {*TELLING, "noise", "number of 8"} and set(left_out) == set(SENSELESS) - {
        "noise",
        "number of 8",
    }
    read, _ = telling_columns(reader, range(6))
    assert set(read) >= {*TELLING, "noise"}
    assert telling_columns(reader, []) == (tuple(name.removeprefix("field_") for name in reader.fields), {})
