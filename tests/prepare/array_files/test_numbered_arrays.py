"""Arrays whose names a number counts: the frames of a sequence, or the parts of one cloud."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

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
