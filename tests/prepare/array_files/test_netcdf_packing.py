"""Numbers that netCDF packed or declares missing, against those that were packed."""

import h5py
import numpy as np
import pytest

from dpcli.prepare.array_files.containers import open_arrays
from dpcli.prepare.array_files.depth_arrays import archived_depth
from dpcli.prepare.array_files.netcdf_packing import with_gaps
from dpcli.store import CloudsReader
from tests.support.commands import told

T, N = 6, 40


def clouds() -> np.ndarray:
    """Returns whole numbers (T,N,3) of a cloud that moves a little in each frame."""
    rng = np.random.default_rng(0)
    return rng.integers(0, 4000, (1, N, 3)) + 10 * np.arange(T)[:, None, None]


def frames_of(path):
    """Converts a file and returns the points of its frames, in the file's own millimeters."""
    out = path.with_suffix(".out.h5")
    run = told("prepare", "clouds", path, "-o", out, "--jobs", 1, "--item-seconds", 0, "--scale", 1)
    assert run.returncode == 0, run.stderr
    with CloudsReader(out) as file:
        sequence = file.read(0)
    return np.split(sequence.points, sequence.frame_offsets[1:-1])


@pytest.mark.parametrize("kind", ["i2", "u2", "i4", "f4"])
@pytest.mark.parametrize("declared", ["_FillValue", "missing_value", "valid_range", "valid_max"])
@pytest.mark.parametrize("form", ["array", "table", "frames"])
def test_a_value_that_is_declared_missing_on_one_axis_is_no_place(tmp_path, form, declared, kind):
    """Though it lies among the others' places, or near them."""
    stored = clouds().astype(kind)
    stored[2, 9, 1] = mark = 4321 if declared.endswith("e") and "valid" not in declared else 5000
    told_by = {"valid_range": [0, 4500], "valid_max": 4500}.get(declared, mark)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        if form == "array":
            own = [file.create_dataset("points", data=stored)]
        elif form == "frames":
            own = [file.create_dataset(f"{t}/points", data=stored[t]) for t in range(T)]
        else:
            own = [file.create_dataset(name, data=stored[:, :, k].ravel()) for k, name in enumerate("xyz")]
            file["frame"] = np.repeat(np.arange(T), N)
        for one in own:
            one.attrs[declared] = np.array(told_by, kind)
    expected = [np.delete(cloud, 9, axis=0) if t == 2 else cloud for t, cloud in enumerate(clouds())]
    for found, true in zip(frames_of(tmp_path / "a.h5"), expected, strict=True):
        assert np.array_equal(found, true)


@pytest.mark.parametrize("scale", [None, 0.5])
def test_unsigned_numbers_in_a_type_with_sign(tmp_path, scale):
    """As netCDF 3 has them; marks and ranges are told in the stored type."""
    numbers = (clouds() + 40_000).astype("u2")
    numbers[1, 3, 0], numbers[1, 4, 2] = 65535, 10
    with h5py.File(tmp_path / "a.h5", "w") as file:
        own = file.create_dataset("points", data=numbers.view("i2"))
        own.attrs["_Unsigned"], own.attrs["_FillValue"] = "true", np.int16(-1)
        own.attrs["valid_range"] = np.array([1000, 65000], "u2").view("i2")
        if scale:
            own.attrs["scale_factor"] = scale
    expected = [(cloud + 40_000) * (scale or 1) for cloud in clouds()]
    expected[1] = np.delete(expected[1], [3, 4], axis=0)
    found = frames_of(tmp_path / "a.h5")
    with CloudsReader(tmp_path / "a.out.h5") as file:
        shift = file.read(0).shift
    for one, true in zip(found, expected, strict=True):
        assert np.allclose(one + (0 if shift is None else shift), true)


def test_a_range_in_the_numbers_that_are_meant(tmp_path):
    """By its type: floats beside whole numbers that are scaled."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        own = file.create_dataset("x", data=np.arange(6, dtype="i2"))
        own.attrs["scale_factor"], own.attrs["valid_max"] = 0.1, 0.35
        with_type = file.create_dataset("y", data=np.arange(6, dtype="i2"))
        with_type.attrs["scale_factor"], with_type.attrs["valid_max"] = 0.1, np.int16(3)
    with open_arrays(tmp_path / "a.h5") as arrays:
        for name in "xy":
            assert np.allclose(arrays[name][()], [0, 0.1, 0.2, 0.3, np.nan, np.nan], equal_nan=True)


def test_whole_numbers_keep_their_type(tmp_path):
    """Labels, colors and depth stay what they are; depth that is declared missing is dropped as a sensor's marks are."""
    depth = np.full((4, 40, 50), 900, np.uint16)
    depth[:, :5], depth[:, 5] = 1234, 0
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["depth"], file["label"] = depth, np.array([3, -1, 2])
        file["depth"].attrs["_FillValue"], file["label"].attrs["_FillValue"] = np.uint16(1234), -1
    with open_arrays(tmp_path / "a.h5") as arrays:
        assert arrays["label"].dtype.kind == "i" and arrays["label"][()].tolist() == [3, -1, 2]
        assert np.isnan(with_gaps(arrays["label"])[1])
        assert np.array_equal(arrays["depth"][()], depth)
    found = archived_depth(tmp_path / "a.h5").depth
    assert found.dtype == np.uint16 and np.array_equal(found, np.where(depth == 1234, 65535, depth))
