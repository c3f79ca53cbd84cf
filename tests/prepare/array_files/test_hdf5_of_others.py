"""HDF5 files as PyTables, pandas and netCDF write them, with bytes written here: what they hold beside plain arrays."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.prepare.array_files import containers
from dpcli.prepare.array_files.containers import open_arrays
from dpcli.prepare.array_files.depth_arrays import archived_depth
from dpcli.prepare.scans.array_sequences import ArraySequences
from tests.support.commands import told


def clouds(frames: int = 6, points: int = 40) -> np.ndarray:
    """Points that move a little, f32 (T,N,3)."""
    rng = np.random.default_rng(1)
    return np.float32(rng.normal(size=(points, 3)) + np.arange(frames)[:, None, None] * 0.02 + 3)


def frames_of(path) -> list[np.ndarray]:
    """The points of the frames of a file's only sequence."""
    reader = ArraySequences(path)
    (item,) = reader.items()
    sample = reader.read(item, np.random.default_rng(0))
    return np.split(sample.sequence.points, sample.sequence.frame_offsets[1:-1])


def test_data_sets_that_were_never_written_refuse_no_others(tmp_path):
    """Dimensions without values (netCDF), and the indices that pandas adds to its tables."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["points"] = clouds()
        file.create_dataset("time", (6,), "f4").attrs["NAME"] = np.bytes_(
            "This is a netCDF dimension but not a netCDF variable         6"
        )
        file.create_dataset("index/indicesLR", (131072,), "i4", chunks=(1024,), compression="gzip")
    assert np.array_equal(frames_of(tmp_path / "a.h5"), clouds())
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file["depth"] = np.full((5, 40, 50), 900, np.uint16)
        file.create_dataset("labels", (5,), "i4")
    found = archived_depth(tmp_path / "c.h5")
    assert found.depth.shape == (5, 40, 50) and not found.small
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file.create_dataset("points", (6, 40, 3), "f4")
    run = told("prepare", "clouds", tmp_path / "b.h5", "-o", tmp_path / "b.out.h5", "--jobs", 1, "--item-seconds", 0)
    assert run.returncode == 3 and "/points claims 720 values" in run.stderr


@pytest.mark.parametrize("name", ["_FillValue", "missing_value"])
@pytest.mark.parametrize("mark", [-1.0, 2.5, -999.0, 1e20])
def test_values_that_attributes_declare_missing_are_no_places(tmp_path, name, mark):
    """On one axis, too, and whatever number stands for them; whole numbers of depth and color keep theirs."""
    stored = clouds()
    stored[:, 7], stored[2, 9, 1] = mark, mark
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["points"], file["depth"] = stored, np.full((6, 4, 4), 65535, np.uint16)
        file["points"].attrs[name] = np.float32(mark)
        file["depth"].attrs[name] = np.uint16(65535)
    expected = [np.delete(cloud, [7, 9] if t == 2 else [7], axis=0) for t, cloud in enumerate(clouds())]
    found = frames_of(tmp_path / "a.h5")
    assert all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))
    with open_arrays(tmp_path / "a.h5") as arrays:
        assert arrays["depth"].dtype == np.uint16 and (arrays["depth"][()] == 65535).all()


def test_a_filter_that_is_missing_is_named(tmp_path):
    """As PyTables packs with Blosc; what isn't packed so is read."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((6, 40, 3))
        plist.set_filter(32001, h5py.h5z.FLAG_OPTIONAL)
        space = h5py.h5s.create_simple((6, 40, 3))
        packed = h5py.h5d.create(file.id, b"points", h5py.h5t.IEEE_F32LE, space, dcpl=plist)
        packed.write_direct_chunk((0, 0, 0), clouds().tobytes())
        file["plain"] = clouds()
    with open_arrays(tmp_path / "a.h5") as arrays:
        assert np.array_equal(arrays["plain"][()], clouds())
        with pytest.raises(DataError, match=r"/points was packed by .*\(HDF5 filter 32001\), which is missing here"):
            arrays["points"][()]


def test_masks_of_truth_values_leave_points_out(tmp_path):
    """As h5py writes NumPy's bool."""
    mask = np.random.default_rng(6).random((6, 40)) < 0.6
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["points"], file["mask"] = clouds(), mask
    expected = [cloud[own] for cloud, own in zip(clouds(), mask)]
    assert all(np.array_equal(a, b) for a, b in zip(frames_of(tmp_path / "a.h5"), expected, strict=True))


@pytest.mark.parametrize("form", ["h5", "npz"])
def test_what_is_no_array_of_numbers_is_named(tmp_path, form):
    """Times as texts, and single numbers, which nobody reads."""
    stamps = np.array([f"2024-03-05T10:00:0{t}" for t in range(6)])
    path = tmp_path / f"a.{form}"
    if form == "npz":
        np.savez(path, points=clouds(), stamps=stamps, who=np.array("anna"))
    else:
        with h5py.File(path, "w") as file:
            file["points"], file["stamps"], file["who"] = clouds(), stamps.astype("S"), "anna"
    reader = ArraySequences(path)
    assert "not read: stamps, who" in reader.summary(reader.items())[0]


def test_what_every_sequence_of_a_file_reads_is_not_named(tmp_path):
    """Groups of one file: each has its own times beside its clouds, or its own numbered frames."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in ("walk_1", "walk_2"):
            file[f"{name}/points"], file[f"{name}/time"], file[f"{name}/weight"] = (
                clouds(),
                np.arange(6) / 10,
                np.ones(9),
            )
    with h5py.File(tmp_path / "b.h5", "w") as file:
        for place in range(4):
            file[f"walk_{place % 2}/frame_{place}"] = clouds()[place]
    for name, said in (
        ("a.h5", "; not read: walk_1/weight, walk_2/weight"),
        ("b.h5", "walk_0/frame_2 taken as its frames"),
    ):
        reader = ArraySequences(tmp_path / name)
        items = reader.items()
        assert len(items) == 2 and reader.summary(items)[0].endswith(said)


@pytest.mark.parametrize("suffix", ["h5", "mat"])
def test_variables_of_octave_have_their_own_names(tmp_path, suffix):
    """Those that `save -hdf5` writes lie in groups beside their types, fields and cells in groups below: times are found."""

    def save(place, values):
        group = place.create_group("time" if values.ndim < 3 else "points")
        group.attrs["OCTAVE_NEW_FORMAT"] = np.uint8(1)
        group["type"], group["value"] = np.bytes_("matrix"), values

    path = tmp_path / f"a.{suffix}"
    for field in (False, True):
        with h5py.File(path, "w") as file:
            place = file
            if field:
                outer = file.create_group("s")
                outer.attrs["OCTAVE_NEW_FORMAT"] = np.uint8(1)
                outer["type"] = np.bytes_("scalar struct")
                place = outer.create_group("value")
            save(place, clouds().transpose(0, 2, 1).astype(np.float64))  # points, axes, frames as Octave has them
            save(place, np.arange(6.0)[None] / 10)
        with open_arrays(path) as arrays:
            assert sorted(arrays) == (["s/points", "s/time"] if field else ["points", "time"])
        reader = ArraySequences(path)
        items = reader.items()
        assert "not read" not in reader.summary(items)[0]
        sequence = reader.read(items[0], np.random.default_rng(0)).sequence
        assert np.array_equal(sequence.points.reshape(6, -1, 3), clouds())
        np.testing.assert_allclose(sequence.time, np.arange(6) / 10)


def test_texts_of_matlab_are_no_numbers(tmp_path):
    """Those of version 7.3 are stored as the numbers of their letters, in cells, too."""
    with h5py.File(tmp_path / "a.mat", "w") as file:

        def save(name, values, kind):
            file[name] = values
            file[name].attrs["MATLAB_class"] = np.bytes_(kind)
            return file[name].ref

        def letters(text):
            return np.array([[ord(letter)] for letter in text], np.uint16)

        frames = [save(f"#refs#/f{t}", cloud.T[:, : 40 - t], "single") for t, cloud in enumerate(clouds())]
        words = [save(f"#refs#/w{t}", letters("walk" + "." * t), "char") for t in range(6)]
        save("data", np.array([frames], h5py.ref_dtype), "cell")
        save("names", np.array([words], h5py.ref_dtype), "cell")
        save("label", letters("a"), "char")
    reader = ArraySequences(tmp_path / "a.mat")
    (item,) = reader.items()
    assert item.label == -1 and "not read: label, names" in reader.summary([item])[0]
    expected = [cloud[: 40 - t] for t, cloud in enumerate(clouds())]
    assert all(np.array_equal(a, b) for a, b in zip(frames_of(tmp_path / "a.mat"), expected, strict=True))


def test_structs_of_matlab_are_frames_with_their_times(tmp_path):
    """As version 7.3 has several: each field holds references. What MATLAB keeps as an object is named, and is no array."""
    with h5py.File(tmp_path / "a.mat", "w") as file:
        columns = {
            "points": [cloud.T[:, : 40 - t] for t, cloud in enumerate(clouds())],
            "time": np.arange(6) * 0.25 + 3,
        }
        for name, values in columns.items():
            for t, value in enumerate(values):
                file[f"#refs#/{name}{t}"] = np.atleast_2d(value)
            file[f"rec/{name}"] = np.array([[file[f"#refs#/{name}{t}"].ref] for t in range(6)], h5py.ref_dtype)
        file["rec"].attrs["MATLAB_class"] = np.bytes_("struct")
        file["T"] = np.zeros((6, 1), np.uint32)
        file["T"].attrs["MATLAB_class"], file["T"].attrs["MATLAB_object_decode"] = np.bytes_("table"), 3
    reader = ArraySequences(tmp_path / "a.mat")
    (item,) = reader.items()
    assert "not read: T (a table of MATLAB" in reader.summary([item])[0]
    assert np.allclose(reader.read(item, np.random.default_rng(0)).sequence.time, np.arange(6) * 0.25)
    expected = [cloud[: 40 - t] for t, cloud in enumerate(clouds())]
    assert all(np.array_equal(a, b) for a, b in zip(frames_of(tmp_path / "a.mat"), expected, strict=True))


def test_what_lies_in_another_file_is_named_and_not_followed(tmp_path):
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["points"] = clouds()
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["points"] = h5py.ExternalLink("b.h5", "/points")
    assert "no arrays of numbers, but points (in b.h5)" in ArraySequences(tmp_path / "a.h5").items()[0].problem
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["xyz"] = clouds() + 1
    reader = ArraySequences(tmp_path / "a.h5")
    assert "not read: points (in b.h5)" in reader.summary(reader.items())[0]


def test_what_a_cell_holds_is_not_read_from_another_file(tmp_path):
    clouds().tofile(tmp_path / "b.raw")
    with h5py.File(tmp_path / "a.mat", "w") as file:
        size = clouds()[0].nbytes
        for t in range(5):
            place = [(str(tmp_path / "b.raw"), t * size, size)]
            file.create_dataset(f"#refs#/{t}", clouds()[0].shape, clouds().dtype, external=place)
        file["walk"] = np.array([[file[f"#refs#/{t}"].ref for t in range(5)]], h5py.ref_dtype)
        file["walk"].attrs["MATLAB_class"] = np.bytes_("cell")
    (item,) = ArraySequences(tmp_path / "a.mat").items()
    assert "/#refs#/0 keeps its data in another file" in item.problem


def test_a_unit_may_be_called_unit(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["points"] = clouds() * 1000
        file["points"].attrs["unit"] = "mm"
    assert np.allclose(np.stack(frames_of(tmp_path / "a.h5")), clouds(), atol=1e-6)


def test_sequences_of_a_file_of_many_arrays_are_opened_by_name(tmp_path, monkeypatch):
    """Each of hundreds would else look at thousands of arrays."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for walk in range(20):
            for frame in range(5):
                file[f"walk_{walk}/{frame}/points"] = clouds()[frame] + walk
    reader = ArraySequences(tmp_path / "a.h5")
    items = reader.items()
    looked, shown = [], containers._shown
    monkeypatch.setattr(
        containers, "_shown", lambda file, item, path: looked.append(item.name) or shown(file, item, path)
    )
    sample = reader.read(items[7], np.random.default_rng(0)).sequence
    assert np.allclose(sample.points, (clouds()[:5] + 7).reshape(-1, 3)) and len(set(looked)) == 5


def test_a_cell_of_many_sequences_is_read_once(tmp_path, monkeypatch):
    """Each of its sequences would else read those of all others."""
    with h5py.File(tmp_path / "a.mat", "w") as file:
        places = []
        for walk in range(20):
            file[f"#refs#/{walk}"] = (clouds() + walk).T
            places.append(file[f"#refs#/{walk}"].ref)
        file["walks"] = np.array([places], h5py.ref_dtype)
        file["walks"].attrs["MATLAB_class"] = np.bytes_("cell")
    looked, read = [], containers._cells
    monkeypatch.setattr(
        containers, "_cells", lambda file, item, path: looked.append(item.name) or read(file, item, path)
    )
    reader = ArraySequences(tmp_path / "a.mat")
    for walk, item in enumerate(reader.items()):
        sample = reader.read(item, np.random.default_rng(0)).sequence
        assert np.allclose(sample.points, (clouds() + walk).reshape(-1, 3))
    assert walk == 19 and looked == ["/walks"]
