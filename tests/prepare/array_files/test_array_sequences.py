"""Arrays of many clouds in every format and order, written by NumPy, h5py and SciPy: what is read is what was meant, or asked."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io

from dpcli.errors import DataError, UsageError
from dpcli.prepare.array_files.axes import axes_of, check_axes
from dpcli.prepare.scans.array_sequences import MORE_FRAMES, UNCOUNTED, ArraySequences
from dpcli.store import CloudSequence, CloudsReader
from tests.support.commands import exit_code

FORMS = ("npy", "npz", "h5", "mat", "mat packed", "mat 7.3")


def tracked(seed: int, frames: int, points: int) -> np.ndarray:
    """Points without an order that move a little from frame to frame, f32 (T,N,3)."""
    rng = np.random.default_rng(seed)
    start, step = rng.normal(size=(points, 3)), rng.normal(size=3) * 0.03
    return np.array([start + t * step + rng.normal(size=(points, 3)) * 0.01 for t in range(frames)], np.float32)


def untracked(seed: int, frames: int, points: int) -> np.ndarray:
    """Points that are measured anew in every frame, f32 (T,N,3)."""
    return np.random.default_rng(seed).normal(size=(frames, points, 3)).astype(np.float32)


def rows_and_columns(height: int, width: int) -> np.ndarray:
    """One cloud of a depth camera, f64 (H,W,3)."""
    v, u = np.mgrid[:height, :width]
    z = 2 + 0.2 * np.sin(u / 9) + 0.1 * np.cos(v / 7)
    return np.stack([(u - width / 2) * z / 60, (v - height / 2) * z / 60, z], -1)


def write(path: Path, form: str, **arrays: np.ndarray) -> Path:
    """Writes arrays into a file of a form; a .npy holds the first alone."""
    path = path.with_suffix(f".{form.split()[0]}")
    path.parent.mkdir(parents=True, exist_ok=True)
    if form == "npy":
        np.save(path, next(iter(arrays.values())))
    elif form == "npz":
        np.savez(path, **arrays)
    elif form == "mat 7.3":
        with h5py.File(path, "w", userblock_size=512) as file:
            for name, values in arrays.items():
                file[name] = np.atleast_2d(values).T
        with path.open("r+b") as file:
            file.write(b"MATLAB 7.3 MAT-file")
    elif form == "h5":
        with h5py.File(path, "w") as file:
            for name, values in arrays.items():
                file[name] = values
    else:
        scipy.io.savemat(path, arrays, do_compression=form == "mat packed")
    return path


def read(raw: Path, *options: str) -> dict[str, list[np.ndarray]]:
    """The frames of each sequence by its name, as the command reads them."""
    output = raw.parent / f"{raw.stem}-{len(options)}.converted"
    words = ("prepare", "clouds", raw, "-o", output, "--jobs", 1, "--item-seconds", 0, "--force", *options)
    if exit_code(*words):
        raise DataError("refused")
    with CloudsReader(output) as reader:
        samples = [reader.read(place) for place in range(len(reader))]
    return {s.name: np.split(s.points, s.frame_offsets[1:-1]) for s in samples}


def same(found: list[np.ndarray], frames: np.ndarray | list[np.ndarray]) -> bool:
    return len(found) == len(frames) and all(np.allclose(a, b, atol=1e-5) for a, b in zip(found, frames))


@pytest.mark.parametrize("form", FORMS)
def test_one_sequence_in_any_order_of_axes(tmp_path, form):
    clouds = tracked(1, 12, 90)
    for order in permutations(range(3)):
        write(tmp_path / "raw" / "".join("TNC"[k] for k in order), form, points=clouds.transpose(order))
    found = read(tmp_path / "raw")
    assert len(found) == 6
    for order, frames in found.items():
        assert same(frames, clouds), order


@pytest.mark.parametrize("form", FORMS)
def test_many_sequences_in_one_array_with_their_labels(tmp_path, form):
    for make in (tracked, untracked):
        clouds = np.stack([make(k, 6, 40) for k in range(3)])
        path = write(tmp_path / make.__name__, form, X=clouds, y=np.array([2, 0, 1]))
        found = read(path)
        assert list(found) == [f"{path.stem}/{k}" for k in range(3)]
        assert all(same(found[f"{path.stem}/{k}"], clouds[k]) for k in range(3))
        if form != "npy":
            with CloudsReader(tmp_path / f"{path.stem}-0.converted") as reader:
                assert [reader.read(k).label for k in range(3)] == [2, 0, 1]


@pytest.mark.parametrize("form", FORMS[1:])
def test_counts_masks_and_times_beside_the_clouds(tmp_path, form):
    clouds, counts = untracked(3, 8, 30), np.array([4, 30, 7, 12, 5, 9, 30, 1])
    mask = np.random.default_rng(4).uniform(size=(8, 30)) < 0.5
    times = np.cumsum(np.linspace(0.1, 0.2, 8))
    found = read(write(tmp_path / "counts", form, points=clouds, num_points=counts, timestamps=times))["counts"]
    assert same(found, [frame[:count] for frame, count in zip(clouds, counts)])
    with CloudsReader(tmp_path / "counts-0.converted") as reader:
        assert np.allclose(reader.read(0).time, times - times[0])
    path = write(tmp_path / "mask", form, points=clouds, mask=mask.astype(np.uint8))
    found = read(path)["mask"]
    assert same(found, [frame[own] for frame, own in zip(clouds, mask)])
    reader = ArraySequences(path, stride=2)
    notes = reader.read(reader.items()[0], np.random.default_rng(0)).notes
    assert notes == {UNCOUNTED: np.count_nonzero(~mask[::2])}


@pytest.mark.parametrize("told", ["mm", b"millimeters", np.array([b"mm"])])
def test_what_attributes_of_an_hdf5_say_of_its_numbers(tmp_path, told):
    """As xarray and netCDF write them: whole numbers that are packed, and a unit."""
    clouds = np.round(untracked(11, 8, 30), 3) * 1000
    stored = np.round((clouds - 20) / 0.5).astype(np.int16)
    stored[0, :4] = -32768
    path = write(tmp_path / "packed", "h5", points=stored, plain=clouds)
    with h5py.File(path, "r+") as file:
        file["points"].attrs.update({"scale_factor": 0.5, "add_offset": [20.0], "_FillValue": np.int16(-32768)})
        file["points"].attrs["units"] = file["plain"].attrs["units"] = told
    expected = [clouds[0, 4:] / 1000, *clouds[1:] / 1000]
    assert all(np.abs(a - b).max() < 4e-4 for a, b in zip(read(path)["packed"], expected, strict=True))
    with h5py.File(path, "r+") as file:
        del file["points"]
    assert same(read(path, "--unit", "m")["packed"], np.float32(clouds / 1000))


@pytest.mark.parametrize(
    ("told", "seconds"),
    [("hours since 2024-03-05", 3600), (b"milliseconds", 1e-3), ("s", 1), ("days", 86400), ("ticks", 0)],
)
def test_units_of_times_that_attributes_of_an_hdf5_tell(tmp_path, told, seconds):
    path = write(tmp_path / "timed", "h5", points=untracked(12, 5, 30), time=np.arange(5) * 1.5)
    with h5py.File(path, "r+") as file:
        file["time"].attrs["units"] = told
    read(path)
    with CloudsReader(tmp_path / "timed-0.converted") as reader:
        time = reader.read(0).time
    assert np.allclose(time, np.arange(5) * 1.5 * seconds) if seconds else time is None


def test_values_and_shape_that_leave_a_choice_are_asked_for(tmp_path, capsys):
    for name, array, answer, frames in (
        ("grid", rows_and_columns(24, 32), "NNC", [rows_and_columns(24, 32).reshape(-1, 3)]),
        ("radar", untracked(5, 60, 20), "TNC", untracked(5, 60, 20)),
        ("shapes", untracked(6, 60, 20), "bnc", None),
        ("skeleton", tracked(7, 60, 20).transpose(1, 0, 2), "NTC", tracked(7, 60, 20)),
    ):
        path = write(tmp_path / name, "npy", points=array)
        with pytest.raises(DataError):
            read(path)
        assert "--axes" in capsys.readouterr().err
        found = read(path, "--axes", answer)
        assert same(found[name], frames) if frames is not None else len(found) == 60


def test_labels_of_single_clouds_are_no_frames(tmp_path, capsys):
    path = write(tmp_path / "modelnet", "h5", data=untracked(8, 10, 50), label=np.arange(10)[:, None])
    with pytest.raises(DataError):
        read(path)
    assert "--axes BNC" in capsys.readouterr().err
    assert len(read(path, "--axes", "BNC")) == 10


def test_frames_of_unlike_sizes(tmp_path):
    rng = np.random.default_rng(9)
    frames = [rng.normal(size=(count, 3)) for count in rng.integers(3, 40, 12)]
    cell = np.empty((1, 12), object)
    cell[0, :] = frames
    scipy.io.savemat(tmp_path / "cell.mat", {"clouds": cell})
    np.save(tmp_path / "list.npy", cell[0], allow_pickle=True)
    np.savez(tmp_path / "savez.npz", *frames)
    with h5py.File(tmp_path / "groups.h5", "w") as file:
        for t, frame in enumerate(frames):
            file[f"walk/frame_{t}"] = frame
    for name in ("cell.mat", "list.npy", "savez.npz", "groups.h5"):
        (found,) = read(tmp_path / name).values()
        assert same(found, frames), name


@pytest.mark.parametrize("form", ["npz", "h5", "mat"])
@pytest.mark.parametrize("kind", ["i8", "u1", "i4"])
def test_triangles_and_colors_without_names_are_no_frames(tmp_path, capsys, form, kind):
    rng = np.random.default_rng(3)
    clouds, numbers = rng.normal(size=(2, 40, 3)), rng.integers(0, 40, (70, 3)).astype(kind)
    mesh = write(tmp_path / "mesh", form, arr_0=clouds[0], arr_1=numbers)
    with pytest.raises(DataError, match="refused"):
        read(mesh)
    assert "one cloud, or none, in arr_0 (40, 3), arr_1 (70, 3)" in capsys.readouterr().err
    clip = write(tmp_path / "clip", form, arr_0=clouds[0], arr_1=clouds[1][:30])
    assert [len(frame) for frame in read(clip)["clip"]] == [40, 30]
    clip = write(tmp_path / "whole", form, arr_0=numbers, arr_1=numbers[::2])
    assert [len(frame) for frame in read(clip)["whole"]] == [70, 35]


def test_one_frame_alone_is_told_apart_by_axes(tmp_path, capsys):
    np.save(tmp_path / "one.npy", np.random.default_rng(3).normal(size=(1, 40, 3)))
    with pytest.raises(DataError, match="refused"):
        read(tmp_path / "one.npy")
    assert "one cloud, or none, in an array (1, 40, 3)" in (said := capsys.readouterr().err) and "--axes" in said
    assert [len(frame) for frame in read(tmp_path / "one.npy", "--axes", "TNC")["one"]] == [40]


def test_colors_that_the_first_file_lacks_are_told(tmp_path, capsys):
    for name, more in (("a", {}), ("b", {"colors": np.zeros((5, 30, 3), np.uint8)})):
        write(tmp_path / "raw" / name, "npz", points=untracked(13, 5, 30), **more)
    assert len(read(tmp_path / "raw")) == 2
    assert "frames with colors, which are not read, as the first of all has none: 5" in capsys.readouterr().err


def test_numbers_of_points_that_are_not_read_are_counted(tmp_path, capsys):
    frames = [np.random.default_rng(count).normal(size=(count, 6)) for count in range(20, 30)]
    cell = np.empty(10, object)
    cell[:] = frames
    np.savez(tmp_path / "frames.npz", **{f"frame_{t}": frame for t, frame in enumerate(frames)})
    np.save(tmp_path / "list.npy", cell, allow_pickle=True)
    for name in ("frames.npz", "list.npy"):
        (found,) = read(tmp_path / name).values()
        assert same(found, [frame[:, :3] for frame in frames])
        assert "of each point the first 3 of 6 numbers are read" in capsys.readouterr().err


def test_a_pickle_of_code_is_not_loaded(tmp_path):
    bad = np.empty(1, object)
    bad[0] = print
    np.save(tmp_path / "bad.npy", bad, allow_pickle=True)
    with pytest.raises(DataError):
        read(tmp_path / "bad.npy")


@pytest.mark.parametrize("beside", [b"pictures", {"fps": 30}, "names", np.datetime64("2024-03-05"), print])
def test_objects_beside_the_clouds_are_named_and_not_loaded(tmp_path, capsys, beside):
    """TAPVid-3D keeps its pictures so; where there are no other numbers, or only a camera, the objects are said to be none."""
    clouds, objects = tracked(7, 5, 30), np.empty(5, object)
    objects[:] = beside
    np.savez(tmp_path / "a.npz", xyz=clouds, about=objects)
    assert same(read(tmp_path / "a.npz")["a"], clouds)
    assert "not read: about" in capsys.readouterr().err
    np.savez(tmp_path / "b.npz", about=objects, K=np.eye(3))
    with pytest.raises(DataError):
        read(tmp_path / "b.npz")
    assert "b.npz: a pickle" in capsys.readouterr().err


def test_a_folder_of_arrays_passes_over_what_dpc_made(tmp_path):
    clouds = {name: tracked(k, 5, 30) for k, name in enumerate(("walk", "run"))}
    for name, frames in clouds.items():
        write(tmp_path / "raw" / name, "npy", points=frames)
    assert exit_code("prepare", "clouds", tmp_path / "raw", "-o", tmp_path / "raw/own.h5", "--jobs", 1) == 0
    found = read(tmp_path / "raw")
    assert sorted(found) == ["run", "walk"]
    assert all(same(found[name], frames) for name, frames in clouds.items())
    assert list(read(tmp_path / "raw", "--pattern", "w*")) == ["walk"]
    with pytest.raises(DataError):
        read(tmp_path / "raw/own.h5")


def test_poses_and_pictures_are_no_clouds(tmp_path):
    turns = np.linalg.qr(np.random.default_rng(1).normal(size=(20, 3, 3)))[0]
    ramp = np.add.outer(np.add.outer(np.arange(40), np.arange(50)), np.arange(3)).astype(np.uint8)
    for name, array in (("turns", turns), ("poses", np.stack([np.eye(4)] * 20)), ("picture", ramp)):
        with pytest.raises(DataError):
            read(write(tmp_path / name, "npz", values=array))


def test_axes_are_checked_before_anything_is_read():
    assert check_axes("btnc") == "BTNC"
    for wrong in ("xyz", "TTC", "TN", "NNNC", "TNCC"):
        with pytest.raises(UsageError):
            check_axes(wrong)
    assert axes_of(tracked(2, 20, 60)) == "TNC"
    assert axes_of(tracked(2, 20, 60).transpose(1, 0, 2)) == "NTC"


def clouds_of_depth(path: Path) -> CloudSequence:
    output = path.with_suffix(".out")
    assert exit_code("prepare", "depth", path, "-o", output, "--jobs", 1, "--item-seconds", 0) == 0
    with CloudsReader(output) as reader:
        return reader.read(0)


@pytest.fixture(scope="module")
def kinect(tmp_path_factory) -> tuple[np.ndarray, CloudSequence]:
    """Depth u16 (T,H,W), and the clouds that it becomes from a .npy."""
    v, u = np.mgrid[:120, :160]
    depth = np.stack([(1500 + 300 * np.sin((u + 9 * t) / 20) + v).astype(np.uint16) for t in range(3)])
    path = tmp_path_factory.mktemp("kinect") / "truth.npy"
    np.save(path, depth)
    return depth, clouds_of_depth(path)


@pytest.mark.parametrize("form", ("mat", "mat packed", "mat 7.3", "h5"))
@pytest.mark.parametrize("kind", (np.uint16, np.float64))
def test_depth_of_kinect_data_sets(tmp_path, kinect, form, kind):
    depth, truth = kinect
    stored = depth.transpose(1, 2, 0).astype(kind) if form.startswith("mat") else depth
    found = clouds_of_depth(write(tmp_path / "video", form, d_depth=stored, d_time=np.arange(3.0)))
    assert np.array_equal(found.points, truth.points)
    assert np.array_equal(found.frame_offsets, truth.frame_offsets)


def walkers(rng: np.random.Generator, frames: int, points: int) -> np.ndarray:
    """Points of something that swings and walks, f64 (T,N,3), without an order of the points."""
    start, phase = rng.normal(size=(points, 3)) * 0.4, rng.uniform(0, 6, (points, 3))
    return np.stack([start + 0.1 * np.sin(t * 0.1 + phase) + (t * 0.02, 0, 0) for t in range(frames)])


def curves(rng: np.random.Generator, frames: int, points: int) -> np.ndarray:
    """Points along a curve, as near to the next as to themselves a frame ago, that are measured anew, f64 (T,N,3)."""
    along = np.sort(rng.uniform(0, 6, (frames, points)), axis=1)
    return np.stack([np.cos(along), np.sin(along), along / 6], -1)


def returns(rng: np.random.Generator, frames: int, points: int) -> np.ndarray:
    """Points of a sparse sensor, measured anew, f64 (T,N,3)."""
    return rng.normal(size=(frames, points, 3))


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("make", [walkers, curves, returns])
def test_an_order_is_right_or_asked_for(seed, make):
    rng = np.random.default_rng([seed, 43])
    clouds = make(rng, int(rng.integers(4, 150)), int(2 ** rng.uniform(5, 10)))
    for order in permutations(range(3)):
        found = axes_of(clouds.transpose(order))
        if make is not walkers and order == (1, 0, 2):
            continue  # points first though no point is the same in two frames: nobody stores that, nothing tells it
        assert found in ("", "".join("TNC"[k] for k in order))
    if make is walkers and clouds.shape[0] < clouds.shape[1]:
        assert axes_of(clouds) == "TNC" and axes_of(clouds.transpose(1, 0, 2)) == "NTC"


@pytest.mark.parametrize("form", (*FORMS, "npy of objects"))
def test_damage_is_told_with_the_file(tmp_path, form):
    rng = np.random.default_rng(11)
    if form == "npy of objects":
        parts = np.empty(3, object)
        parts[:] = [rng.normal(size=(count, 3)) for count in (3, 4, 5)]
        np.save(tmp_path / "whole.npy", parts, allow_pickle=True)
    path = (
        tmp_path / "whole.npy"
        if form == "npy of objects"
        else write(tmp_path / "whole", form, points=tracked(1, 5, 20))
    )
    whole = path.read_bytes()
    for _ in range(60):
        damaged = bytearray(whole)
        for place in rng.integers(0, min(len(whole), 600), 3):
            damaged[place] = rng.integers(256)
        (tmp_path / f"damaged{path.suffix}").write_bytes(damaged[: rng.integers(1, 2 * len(damaged))])
        reader = ArraySequences(tmp_path / f"damaged{path.suffix}")
        for item in reader.items():
            try:
                assert item.problem or reader.read(item, rng)
            except DataError:
                pass


def test_recordings_beside_arrays_are_told_as_left_out(tmp_path):
    np.save(tmp_path / "a.npy", np.random.default_rng(0).normal(size=(4, 20, 3)))
    for name in ("b.mcap", "c.db3", "times.txt"):
        (tmp_path / name).write_bytes(b"")
    reader = ArraySequences(tmp_path)
    told = "left out: 1 .db3 file, 1 .mcap file (name the recordings themselves)"
    assert reader.summary(reader.items())[-1] == told


BATCH = np.random.default_rng(8).normal(size=(3, 1, 40, 3)) + np.arange(10)[:, None, None] / 50  # (B,T,N,3)


@pytest.mark.parametrize("name", ["num_frames", "seq_lengths", "sequence_len", "frame_count"])
def test_frames_behind_their_count_are_padding(tmp_path, name):
    """Also where they repeat the last one, and the times there are 0."""
    lengths = np.array([10, 4, 7])
    times = np.where(np.arange(10) < lengths[:, None], np.arange(10) / 5, 0)
    np.savez(tmp_path / "a.npz", points=BATCH, times=times, **{name: lengths})
    reader = ArraySequences(tmp_path / "a.npz")
    for item, own, length in zip(reader.items(), BATCH, lengths):
        sample = reader.read(item, np.random.default_rng(0))
        assert np.allclose(sample.sequence.points, own[:length].reshape(-1, 3), atol=1e-6)
        assert np.allclose(sample.sequence.time, np.arange(length) / 5)
        assert sample.notes.get(MORE_FRAMES, 0) == 10 - length
    np.savez(tmp_path / "a.npz", points=BATCH, **{name: lengths + 1})
    with pytest.raises(DataError, match="11 frames of a sequence that has 10"):
        reader.read(ArraySequences(tmp_path / "a.npz").items()[0], np.random.default_rng(0))


@pytest.mark.parametrize(
    ("name", "used"),
    [
        ("mask", 1),
        ("point_mask", 1),
        ("valid", 1),
        ("valids", 1),
        ("padding_mask", 0),
        ("ground_mask", 0),
        ("fg_mask", 0),
    ],
)
def test_only_masks_of_valid_points_leave_points_out(tmp_path, name, used):
    """Others are named; a mask may have an axis for the coordinates."""
    mask = np.random.default_rng(9).random(BATCH.shape[:3]) < 0.7
    for shape in (mask.shape, (*mask.shape, 1)):
        np.savez(tmp_path / "a.npz", points=BATCH, **{name: mask.reshape(shape)})
        reader = ArraySequences(tmp_path / "a.npz")
        items = reader.items()
        found = reader.read(items[1], np.random.default_rng(0)).sequence.points
        expected = BATCH[1][mask[1]] if used else BATCH[1].reshape(-1, 3)
        assert np.allclose(found, expected, atol=1e-6) and (f"not read: {name}" in reader.summary(items)[0]) != used


def test_a_mask_of_many_values_is_none(tmp_path):
    np.savez(tmp_path / "a.npz", points=BATCH, mask=np.arange(BATCH[..., 0].size).reshape(BATCH.shape[:3]) % 5)
    reader = ArraySequences(tmp_path / "a.npz")
    with pytest.raises(DataError, match="'mask' holds 5 different numbers, expected two"):
        reader.read(reader.items()[0], np.random.default_rng(0))


def test_labels_that_are_not_used_are_named_and_minus_one_is_unknown(tmp_path):
    np.savez(tmp_path / "a.npz", points=BATCH, y=np.array([-1, 2, 0]))
    assert [item.label for item in ArraySequences(tmp_path / "a.npz").items()] == [-1, 2, 0]
    for bad in ([0.5, 1, 2], [-2, 1, 0], [10**6, 1, 2]):
        np.savez(tmp_path / "a.npz", points=BATCH, y=np.array(bad))
        reader = ArraySequences(tmp_path / "a.npz")
        items = reader.items()
        assert {item.label for item in items} == {-1} and "not read: y" in reader.summary(items)[0]


@pytest.mark.parametrize("form", ["npz", "number", "attribute", "groups", "attributes of groups", "numbered frames"])
def test_one_label_beside_each_sequence_is_its_own(tmp_path, form):
    """In the file of each, or in the group of each, as a number or as an attribute."""
    labels = [2, 0, -1]
    (tmp_path / "in").mkdir()
    for place, (own, label) in enumerate(zip(BATCH, labels)):
        path, group = tmp_path / "in" / f"walk_{place}.h5", ""
        if form == "npz":
            np.savez(path.with_suffix(".npz"), points=own, label=label)
            continue
        if form not in ("number", "attribute"):
            path, group = path.with_name("all.h5"), f"walk_{place}/"
        with h5py.File(path, "a") as file:
            if form == "numbered frames":
                file.update({f"{group}{t}/points": cloud for t, cloud in enumerate(own)})
            else:
                file[f"{group}points"] = own
            if form in ("number", "groups"):
                file[f"{group}y"] = label
            else:
                file[group or "/"].attrs["label"] = label
    reader = ArraySequences(tmp_path / "in")
    items = reader.items()
    assert [item.label for item in items] == labels and "not read" not in reader.summary(items)[0]
    samples = [reader.read(item, np.random.default_rng(0)).sequence for item in items]
    assert [one.label for one in samples] == labels and np.allclose(
        samples[1].points, BATCH[1].reshape(-1, 3), atol=1e-6
    )


def test_labels_that_some_sequences_lack_are_not_used_but_named(tmp_path):
    np.savez(tmp_path / "a.npz", points=BATCH[0], label=1)
    np.savez(tmp_path / "b.npz", points=BATCH[1])
    reader = ArraySequences(tmp_path)
    items = reader.items()
    assert {item.label for item in items} == {-1} and "not read: label" in reader.summary(items)[0]
