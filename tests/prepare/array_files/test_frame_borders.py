"""Points of many frames in one array: refused with what to do, so that no cloud mixes frames; done, it reads as frames."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from dpcli.errors import DataError
from dpcli.prepare.decode.cloud_files import read_cloud
from dpcli.prepare.scans.array_sequences import ArraySequences
from dpcli.prepare.scans.tables import TableSequences

COUNTS, TIME = np.array([4, 5, 3, 6, 2]), np.arange(5) * 0.25
POINTS = np.random.default_rng(0).normal(size=(20, 3))
GRID = dict(zip("xyz", POINTS.reshape(5, 4, 3).transpose(2, 0, 1)))
DIVIDED = [
    ({"points": POINTS, "counts": COUNTS}, "numpy.repeat(numpy.arange(5), counts)"),
    ({"pos": POINTS, "ptr": np.cumsum([0, *COUNTS])}, "numpy.diff(ptr)"),
    ({"points": POINTS, "frame_starts": np.cumsum([0, *COUNTS[:-1]])}, "numpy.diff(numpy.append(frame_starts, 20))"),
    ({**dict(zip("xyz", POINTS.T)), "row_size": COUNTS, "time": TIME}, "numpy.repeat(numpy.arange(5), row_size)"),
    ({**GRID, "t": TIME}, "numpy.stack([x, y, z], -1)"),
]


def write(path, arrays):
    if path.suffix == ".npz":
        np.savez(path, **arrays)
    elif path.suffix == ".mat":
        savemat(path, arrays)
    else:
        with h5py.File(path, "w") as file:
            for name, values in arrays.items():
                file[name] = values


@pytest.mark.parametrize("suffix", [".npz", ".mat", ".h5"])
@pytest.mark.parametrize("arrays, advice", DIVIDED)
def test_points_of_many_frames_are_refused_and_what_is_advised_works(tmp_path, suffix, arrays, advice):
    path = tmp_path / f"a{suffix}"
    write(path, arrays)
    with pytest.raises(DataError) as told:
        read_cloud(path)  # as a frame of a folder
    assert advice in str(told.value)
    assert advice in ArraySequences(path).items()[0].problem  # as a file of its own
    stacked, frame = np.stack(list(GRID.values()), -1), np.repeat(np.arange(5), COUNTS)
    followed = {"points": stacked} if "stack" in advice else {**arrays, "frame": frame}
    write(path, {**followed, "time": TIME})
    reader = ArraySequences(path, axes="TNC") if "stack" in advice else TableSequences(path)
    sequence = reader.read(reader.items()[0], np.random.default_rng(0)).sequence
    np.testing.assert_allclose(sequence.points, POINTS, atol=1e-6)
    np.testing.assert_allclose(sequence.time, TIME)


@pytest.mark.parametrize(
    "beside",
    [
        {"class_counts": COUNTS},  # of something else
        {"counts": COUNTS[:-1]},  # of other points
        {"sizes": np.array([20])},
        {"time": np.array([0, 5, 20])},
        {"scale": np.array([0.5, 19.5])},
    ],
)
def test_arrays_that_divide_nothing_leave_a_cloud(tmp_path, beside):
    np.savez(tmp_path / "a.npz", points=POINTS, **beside)
    assert read_cloud(tmp_path / "a.npz").unread == tuple(beside)
    np.savez(tmp_path / "a.npz", **GRID, **beside)  # a grid
    assert len(read_cloud(tmp_path / "a.npz").points) == 20


def test_arrays_beside_a_table_are_times_of_its_frames_or_named(tmp_path):
    frame = np.repeat([3, 4, 7], [5, 5, 10])
    for frames, times, unread in ((frame, [0, 0.1, 0.5], ""), (frame[::-1], None, ", stamp")):
        np.savez(tmp_path / "a.npz", points=POINTS, frame=frames, stamp=np.array([2, 2.1, 2.5]), gain=np.ones(2))
        reader = TableSequences(tmp_path / "a.npz")
        items = reader.items()
        time = reader.read(items[0], np.random.default_rng(0)).sequence.time
        assert (time is None) == (times is None) and (times is None or np.allclose(time, times))
        assert f"not read: {unread[2:] + ', ' if unread else ''}gain" in reader.summary(items)[0]
