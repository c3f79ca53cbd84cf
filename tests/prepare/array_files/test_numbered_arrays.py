"""Arrays whose names a number counts: the frames of a sequence, or the parts of one cloud."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.prepare.scans.array_sequences import ArraySequences
from dpcli.store import CloudsReader
from tests.support.commands import told

POINTS = np.float32(np.random.default_rng(2).normal(size=(50, 3)) + 4)
BESIDE = {
    "colors": np.random.default_rng(3).integers(0, 256, (50, 3)).astype(np.uint8),
    "triangles": np.random.default_rng(4).integers(0, 50, (90, 3)),
    "normals": POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True),
}


@pytest.mark.parametrize("what", BESIDE)
@pytest.mark.parametrize("form", ["npz", "h5"])
def test_what_belongs_to_one_cloud_is_no_second_frame(tmp_path, form, what):
    """As `numpy.savez(file, points, colors)` and XDMF (``data0``, ``data1``) call them."""
    for frame in range(3):
        path = tmp_path / "in" / f"{frame}.{form}"
        path.parent.mkdir(exist_ok=True)
        if form == "npz":
            np.savez(path, POINTS, BESIDE[what])
        else:
            with h5py.File(path, "w") as file:
                file["data0"], file["data1"] = POINTS, BESIDE[what]
    words = ("-o", tmp_path / "out.h5", "--jobs", 1, "--item-seconds", 0)
    for raw in (tmp_path / "in", path):
        run = told("prepare", "clouds", raw, *words)
        assert run.returncode == 3 and not (tmp_path / "out.h5").exists()


@pytest.mark.parametrize(
    "frames", [[POINTS, POINTS + 0.1], [POINTS / 5, POINTS / 5.1, POINTS / 5.2], [BESIDE["normals"]] * 2]
)
def test_numbered_frames_are_said_to_be_taken_so(tmp_path, frames):
    """Also points on a sphere, which look like directions."""
    np.savez(tmp_path / "in.npz", *frames)
    run = told("prepare", "clouds", tmp_path / "in.npz", "-o", tmp_path / "out.h5", "--jobs", 1, "--item-seconds", 0)
    assert f"{len(frames)} frames" in run.stdout and f"arr_0 to arr_{len(frames) - 1} taken as its frames" in run.stderr


@pytest.mark.parametrize("empty", [np.zeros(0), np.zeros((0, 0)), np.zeros((0, 3)), np.zeros(0, int)])
@pytest.mark.parametrize("form", ["npz", "h5", "npy of objects"])
def test_a_frame_in_which_nothing_was_seen_keeps_its_time(tmp_path, form, empty):
    frames = [POINTS, POINTS[:30] + 0.1, empty, POINTS[:20] + 0.3]
    path = tmp_path / f"in.{form.split()[0]}"
    if form == "npz":
        np.savez(path, *frames)
    elif form == "h5":
        with h5py.File(path, "w") as file:
            for place, frame in enumerate(frames):
                file[f"frame_{place}"] = frame
    else:
        objects = np.empty(4, object)
        objects[:] = frames
        np.save(path, objects, allow_pickle=True)
    run = told("prepare", "clouds", path, "-o", tmp_path / "out.h5", "--jobs", 1, "--item-seconds", 0, "--fps", 2)
    assert not run.returncode and "frames without points dropped: 1" in run.stderr
    with CloudsReader(tmp_path / "out.h5") as reader:
        sample = reader.read(0)
    assert np.allclose(sample.time, [0, 0.5, 1.5]) and np.diff(sample.frame_offsets).tolist() == [50, 30, 20]


def read(path, **options) -> tuple[list[str], list[np.ndarray], list[np.ndarray | None], str]:
    """The names, points and times of the sequences in a file, and the first line of its summary."""
    reader = ArraySequences(path, **options)
    items = reader.items()
    found = [reader.read(item, np.random.default_rng(0)).sequence for item in items]
    return (
        [item.name for item in items],
        [one.points for one in found],
        [one.time for one in found],
        reader.summary(items)[0],
    )


MANY = [np.float32(POINTS[: 20 + t] + t) for t in range(12)]
SECONDS = np.arange(12) * 0.1


@pytest.mark.parametrize("form", ["h5", "npz"])
@pytest.mark.parametrize("names", ["frame_{}/points", "{}/xyz", "scans/scan{}/points", "t_{}/pc", "{}"])
def test_groups_whose_names_count_frames_are_frames(tmp_path, form, names):
    """In the order of their numbers, without leading zeros; also several sequences of them, and what else lies in each group."""
    path = tmp_path / f"in.{form}"
    for sequences in ([""], ["walk_1/", "walk_2/"]):
        data = {f"{one}{names.format(t)}": MANY[t] for one in sequences for t in range(12)}
        if "/" in names:
            beside = {f"{key.rpartition('/')[0]}/colors": np.zeros((len(data[key]), 3), np.uint8) for key in data}
            data |= beside | {f"{key.rpartition('/')[0]}/pose": np.eye(4) for key in data}
        np.savez(path, **data) if form == "npz" else write(path, data)
        found, points, times, said = read(path)
        assert len(found) == len(sequences) and all(np.array_equal(one, np.concatenate(MANY)) for one in points)
        assert times == [None] * len(found) and "taken as its frames" in said and ("colors" in said) == ("/" in names)


def write(path, data, attributes=()) -> None:
    """An HDF5 file of arrays by name, with attributes (name, attribute, value)."""
    with h5py.File(path, "w") as file:
        for name, values in data.items():
            file[name] = values
        for name, attribute, value in attributes:
            file[name].attrs[attribute] = value


@pytest.mark.parametrize("name", ["object_{}/points", "sample_{}/points", "frame_{}/cam_0/points", "frame_0/{}/points"])
def test_groups_of_something_else_are_no_frames(tmp_path, name):
    write(tmp_path / "in.h5", {name.format(t): MANY[t] for t in range(12)})
    (item,) = ArraySequences(tmp_path / "in.h5").items()
    assert "one cloud, or none" in item.problem


@pytest.mark.parametrize("place", ["attribute of the group", "attribute", "number", "list", "list above", "names"])
def test_times_of_numbered_frames_are_read(tmp_path, place):
    data = {f"all/{t}/points": MANY[t] for t in range(12)}
    attributes = []
    if place.startswith("attribute"):
        group = place.endswith("group")
        attributes = [(f"all/{t}" if group else f"all/{t}/points", "timestamp", 7 + SECONDS[t]) for t in range(12)]
    elif place == "number":
        data |= {f"all/{t}/time_ms": np.int64(100 * t + 7) for t in range(12)}
    elif place == "names":
        data = {f"all/{1700000000 + SECONDS[t]:.6f}/points": MANY[t] for t in range(12)}
    else:
        data |= {"timestamps" if place.endswith("above") else "all/stamps": 1_700_000_000_000 + np.arange(12) * 100}
    write(tmp_path / "in.h5", data, attributes)
    _, points, (time,), _ = read(tmp_path / "in.h5")
    assert np.array_equal(points[0], np.concatenate(MANY)) and np.allclose(time, SECONDS)


def test_times_beside_lists_and_dates_are_read(tmp_path):
    frames = np.empty(12, object)
    frames[:] = MANY
    moments = np.datetime64("2024-03-05T23:59:59.500") + np.arange(12) * np.timedelta64(100, "ms")
    for name, values in (("time", SECONDS + 3), ("stamps", moments)):
        np.savez(tmp_path / "in.npz", points=frames, **{name: values})
        _, _, (time,), _ = read(tmp_path / "in.npz")
        assert np.allclose(time, SECONDS)


def test_times_that_do_not_rise_are_named(tmp_path):
    write(tmp_path / "in.h5", {"points": np.stack([POINTS + t / 50 for t in range(12)]), "time": np.zeros(12)})
    _, _, times, said = read(tmp_path / "in.h5")
    assert times == [None] and said.endswith("not read: time")


def test_missing_numbers_leave_a_gap_and_are_named(tmp_path):
    write(tmp_path / "in.h5", {f"frame_{t}/points": MANY[t] for t in (0, 1, 2, 5, 6)})
    _, _, (time,), said = read(tmp_path / "in.h5", fps=10)
    assert np.allclose(time, [0, 0.1, 0.2, 0.5, 0.6]) and "without 3 to 4" in said


@pytest.mark.parametrize("place", ["attribute", "number", "list", "object array"])
def test_clouds_with_a_label_each_may_be_samples(tmp_path, place):
    """As those of 3D MNIST are, a group each; whoever knows better says so."""
    path = tmp_path / "in.h5"
    if place == "object array":
        frames = np.empty(12, object)
        frames[:] = MANY
        np.savez(path := tmp_path / "in.npz", points=frames, labels=np.arange(12) % 3)
    else:
        data = {f"{t}/points": MANY[t] for t in range(12)}
        data |= {f"{t}/label": np.int64(t % 3) for t in range(12)} if place == "number" else {}
        data |= {"labels": np.arange(12) % 3} if place == "list" else {}
        write(path, data, [(f"{t}", "label", t % 3) for t in range(12)] if place == "attribute" else ())
    (item,) = (reader := ArraySequences(path)).items()
    with pytest.raises(DataError, match="a number in 'labels?' for each of its 12 clouds"):
        reader.read(item, np.random.default_rng(0))
    assert np.array_equal(read(path, axes="TNC")[1][0], np.concatenate(MANY))


def test_labels_beside_a_list_of_sequences_are_read(tmp_path):
    sequences = np.empty(3, object)
    sequences[:] = [np.stack([POINTS + t / 50 for t in range(4 + k)]) for k in range(3)]
    np.savez(tmp_path / "in.npz", clouds=sequences, y=np.array([1, 0, 1]))
    assert [item.label for item in ArraySequences(tmp_path / "in.npz").items()] == [1, 0, 1]
