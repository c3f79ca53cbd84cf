"""What lies beside depth in one file of named arrays: times, the camera, the depth's unit, and what is named because nobody reads it."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from dpcli.errors import DataError
from dpcli.prepare.actions.depth import DepthVideos
from dpcli.prepare.decode.depth_files import ZOOMS
from dpcli.prepare.decode.pinhole_camera import Intrinsics

FRAMES = 8
DEPTH = np.random.default_rng(2).integers(900, 1100, (FRAMES, 36, 48)).astype(np.uint16)
SECONDS = np.arange(FRAMES) * 0.1


def read(path, **options):
    """The sequence of a file, and its notes."""
    reader = DepthVideos(inputs=(path,), **options)
    (item,) = reader.items()
    sample = reader.read(item, np.random.default_rng(0))
    return sample.sequence, " ".join(sample.notes)


def write(path, data, **attributes):
    """A file of arrays with attributes of its depth."""
    if path.suffix == ".npz":
        np.savez(path, **data)
    else:
        with h5py.File(path, "w") as file:
            for name, values in data.items():
                file[name] = values
            file["depth"].attrs.update(attributes)
    return path


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("timestamps", 5 + SECONDS),
        ("t", SECONDS),
        ("time_ms", np.arange(FRAMES) * 100),
        ("stamps", 1_700_000_000_000_000_000 + np.arange(FRAMES) * 100_000_000),
        ("times", (np.arange(FRAMES) * 1e5 + 1.7e15)[:, None].astype(np.int64)),
    ],
)
@pytest.mark.parametrize("form", ["npz", "h5"])
def test_times_beside_depth_are_those_of_its_frames(tmp_path, form, name, values):
    path = write(tmp_path / f"a.{form}", {"depth": DEPTH, name: values})
    sequence, notes = read(path)
    assert np.allclose(sequence.time, SECONDS, atol=1e-6) and "not read" not in notes
    assert np.allclose(read(path, stride=3)[0].time, SECONDS[::3], atol=1e-6)
    assert np.allclose(read(path, fps=5)[0].time, 2 * SECONDS)


@pytest.mark.parametrize(
    "values",
    [
        np.zeros(FRAMES),
        np.arange(FRAMES - 1) * 0.1,
        np.arange(FRAMES),
        SECONDS[::-1],
        np.where(SECONDS == 0, np.nan, SECONDS),
        np.where(SECONDS == 0, -np.inf, SECONDS),
    ],
)
def test_times_that_do_not_fit_are_named(tmp_path, values):
    sequence, notes = read(write(tmp_path / "a.h5", {"depth": DEPTH, "time": values}))
    assert sequence.time is None and "arrays that are not read (time)" in notes


@pytest.mark.parametrize("place", ["numbers", "attributes"])
def test_a_camera_and_a_unit_in_single_numbers_of_hdf5_are_used(tmp_path, place):
    """As `file["fx"] = 50.0` and `depth.attrs["fx"] = 50.0` write them."""
    told = {"fx": 50.0, "fy": 51.0, "cx": 20.0, "cy": 17.0, "depth_scale": 0.0005}
    data = {"depth": DEPTH, **(told if place == "numbers" else {})}
    found, notes = read(write(tmp_path / "a.h5", data, **({} if place == "numbers" else told)))
    wanted, _ = read(
        write(tmp_path / "b.h5", {"depth": DEPTH}), intrinsics=Intrinsics(50.0, 51.0, 20.0, 17.0), depth_scale=2000
    )
    assert np.array_equal(found.points, wanted.points) and "not read" not in notes


@pytest.mark.parametrize(("unit", "scale"), [("mm", 1000), ("cm", 100), ("raw", 1000)])
def test_the_unit_of_depth_counts(tmp_path, unit, scale):
    """Of whole numbers and others, and beside attributes that tell no camera, which are named."""
    found, _ = read(write(tmp_path / "a.h5", {"depth": DEPTH}, units=unit))
    assert np.allclose(found.points[0, 2], DEPTH[0, 0, 0] / scale)
    found, _ = read(write(tmp_path / "c.npz", {"depth": DEPTH, "units": unit}))
    assert np.allclose(found.points[0, 2], DEPTH[0, 0, 0] / scale)
    for place in ("e.npz", "e.h5"):  # which may be that of what a scale makes of the numbers
        data = {"depth": DEPTH, "depth_scale": 0.0005, "units": unit}
        found, _ = read(write(tmp_path / place, data))
        assert np.allclose(found.points[0, 2], DEPTH[0, 0, 0] / 2000)
    found, _ = read(write(tmp_path / "f.h5", {"depth": DEPTH}, depth_scale=0.0005, units=unit))
    assert np.allclose(found.points[0, 2], DEPTH[0, 0, 0] / 2000)
    found, _ = read(write(tmp_path / "d.h5", {"depth": np.float32(DEPTH / 500)}, units=unit if unit == "cm" else "m"))
    assert np.allclose(found.points[0, 2], np.float32(DEPTH[0, 0, 0] / 500) / (100 if unit == "cm" else 1))
    found, notes = read(write(tmp_path / "b.h5", {"depth": DEPTH}, units=unit, fx=500.0))
    assert np.allclose(found.points[0, 2], DEPTH[0, 0, 0] / scale)
    assert "not read (attribute fx)" in notes


def test_doubles_of_matlab_that_mark_what_is_unseen_are_millimeters_too(tmp_path):
    depth = DEPTH.astype(float)
    depth[0, 0, :3] = np.nan, np.inf, -np.inf
    reader = DepthVideos(inputs=(write(tmp_path / "a.mat", {"depth": depth.transpose(0, 2, 1)}),))
    sample = reader.read(reader.items()[0], np.random.default_rng(0))
    assert np.allclose(sample.sequence.points[:, 2], DEPTH.ravel()[3:] / 1000)
    assert sample.notes["pixels without a depth (NaN, 65535 and the like) dropped"] == 3


def test_depth_in_meters_needs_no_scale_of_attributes(tmp_path):
    found, _ = read(write(tmp_path / "a.h5", {"depth": np.float32(DEPTH / 1000)}, units="m", depth_scale=1000.0))
    assert np.allclose(found.points[0, 2], DEPTH[0, 0, 0] / 1000)


def test_large_arrays_beside_depth_are_named(tmp_path):
    """A mask of the depth's shape may leave out what is seen, or say where a person is: nobody knows."""
    for form in ("h5", "npz"):
        _, notes = read(write(tmp_path / f"a.{form}", {"depth": DEPTH, "mask": DEPTH > 1000}))
        assert "arrays that are not read (mask)" in notes


MATRIX = np.array([[40, 0, 23.5], [0, 40, 17.5], [0, 0, 1.0]])
EACH = np.tile(MATRIX, (FRAMES, 1, 1))


@pytest.mark.parametrize("form", ["v.npz", "v.h5"])
@pytest.mark.parametrize(
    "camera",
    [
        {"K": EACH},
        {"intrinsics": np.tile([40, 40, 23.5, 17.5], (FRAMES, 1))},
        {"K": EACH.reshape(FRAMES, 9)},
        {axis: np.full(FRAMES, value) for axis, value in (("fx", 40.0), ("fy", 40.0), ("cx", 23.5), ("cy", 17.5))},
    ],
)
def test_a_camera_told_for_every_frame_is_used_where_all_are_equal(tmp_path, form, camera):
    path = write(tmp_path / form, {"depth": DEPTH, **camera})
    sequence, notes = read(path)
    z = DEPTH[0, 0, 0] / 1000
    np.testing.assert_allclose(sequence.points[0], [-23.5 / 40 * z, -17.5 / 40 * z, z], rtol=1e-6)
    assert not notes
    changing = {
        name: values + np.arange(FRAMES).reshape(-1, *[1] * (values.ndim - 1)) for name, values in camera.items()
    }
    assert "which differs from frame to frame" in read(write(tmp_path / f"c{form}", {"depth": DEPTH, **changing}))[1]


@pytest.mark.parametrize(("step", "told"), [(0.0, False), (0.01, False), (5.0, True)])
def test_cameras_that_files_of_single_frames_tell_are_compared(tmp_path, step, told):
    for frame in range(3):
        np.savez(tmp_path / f"{frame}.npz", depth=DEPTH[frame], K=MATRIX + np.diag([step * frame, step * frame, 0]))
    sequence, notes = read(tmp_path)
    assert (ZOOMS in notes) is told
    assert sequence.points[0, 0] == pytest.approx(-23.5 / 40 * DEPTH[0, 0, 0] / 1000)


@pytest.mark.parametrize("form", ["v.npz", "v.h5", "v.mat"])
@pytest.mark.parametrize("lens", [{"distortion_model": "equidistant", "D": np.full(4, 0.01)}, {"xi": np.array([1.2])}])
def test_a_fisheye_beside_depth_is_refused_unless_a_camera_is_given(tmp_path, form, lens):
    data = {"depth": DEPTH, "K": MATRIX, **lens}
    if form == "v.mat":
        savemat(tmp_path / form, data | {"depth": np.moveaxis(DEPTH, 0, -1)})
    path = tmp_path / form if form == "v.mat" else write(tmp_path / form, data)
    with pytest.raises(DataError, match=r"its lens is of (model equidistant|xi .*1.2).*, of a fisheye or the like"):
        read(path)
    assert read(path, fov=60)[0].points.shape[1] == 3
