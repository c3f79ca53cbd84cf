"""Tests of units that attributes and texts beside arrays tell."""

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from dpcli.store import CloudsReader
from tests.support.commands import told

POINTS = np.random.default_rng(0).normal(size=(1, 40, 3)) + np.arange(5)[:, None, None] * 0.1


def write(path, form: str) -> None:
    """The points in millimeters, which the file says in one of the ways in which people do."""
    data = {"points": POINTS * 1000, "units": "mm", "note": "a walk"}
    if form == "npz":
        np.savez(path, **data)
    elif form == "mat":
        savemat(path, data)
    elif form == "struct":
        savemat(path, {"rec": data}, do_compression=True)
    elif form == "structs":
        frames = [(cloud[t:] * 1000, "mm") for t, cloud in enumerate(POINTS)]
        savemat(path, {"rec": np.array(frames, [("points", object), ("units", object)])})
    elif form == "mat 7.3":
        with h5py.File(path, "w", userblock_size=512) as file:
            file["points"], file["units"] = data["points"].T, np.array([[ord(letter)] for letter in "mm"], np.uint16)
            file["units"].attrs["MATLAB_class"] = np.bytes_("char")
    else:
        with h5py.File(path, "w") as file:
            holder = {"group": "a", "above": "a/b"}.get(form, "")
            if form in ("columns", "columns of a group"):
                holder = "a" if form != "columns" else ""
                for k, name in enumerate("xyz"):
                    file[f"{holder}/{name}"] = data["points"][:, :, k].ravel()
                file[f"{holder}/frame"] = np.repeat(np.arange(5), 40)
                file[f"{holder}/time"] = np.repeat(np.arange(5) * 40, 40)
                file[f"{holder}/time"].attrs["units"] = "ms"
            else:
                file[f"{holder}/points"] = data["points"]
            if form == "text":
                file["units"] = "mm"
            elif form == "array":
                file["points"].attrs["length_unit"] = "mm"
            else:
                file["a" if form == "columns of a group" else holder.partition("/")[0] or "/"].attrs["unit"] = "mm"


@pytest.mark.parametrize(
    ("form", "suffix"),
    [
        *(("npz", ".npz"), ("mat", ".mat"), ("struct", ".mat"), ("structs", ".mat"), ("mat 7.3", ".mat")),
        *(("text", ".h5"), ("root", ".h5")),
        *(("group", ".h5"), ("above", ".h5"), ("array", ".h5"), ("columns", ".h5"), ("columns of a group", ".h5")),
    ],
)
def test_a_unit_beside_the_points_counts(tmp_path, form, suffix):
    write(tmp_path / f"a{suffix}", form)
    words = ("-o", tmp_path / "out.h5", "--jobs", 1, "--item-seconds", 0)
    run = told("prepare", "clouds", tmp_path / f"a{suffix}", *words)
    assert not run.returncode and "converted from mm to m" in run.stderr, run.stderr
    assert "units" not in run.stderr
    with CloudsReader(tmp_path / "out.h5") as reader:
        frames = [cloud[t if form == "structs" else 0 :] for t, cloud in enumerate(POINTS)]
        assert np.allclose(reader.read(0).points, np.concatenate(frames), atol=1e-5)


@pytest.mark.parametrize("suffix", [".npz", ".mat", ".h5"])
def test_a_unit_in_each_frame_of_a_folder_counts(tmp_path, suffix):
    (tmp_path / "in").mkdir()
    for t, cloud in enumerate(POINTS):
        path, data = tmp_path / f"in/{t}{suffix}", {"points": cloud * 1000, "units": "mm"}
        if suffix == ".h5":
            with h5py.File(path, "w") as file:
                file.update(data)
        else:
            (np.savez(path, **data) if suffix == ".npz" else savemat(path, data))
    run = told("prepare", "clouds", tmp_path / "in", "-o", tmp_path / "out.h5", "--jobs", 1, "--item-seconds", 0)
    assert not run.returncode and "converted from mm to m" in run.stderr, run.stderr
    with CloudsReader(tmp_path / "out.h5") as reader:
        assert np.allclose(reader.read(0).points, POINTS.reshape(-1, 3), atol=1e-5)


def test_what_is_no_length_beside_points_is_none_of_theirs(tmp_path):
    """It may tell of anything in the file, and is named."""
    np.savez(tmp_path / "a.npz", points=POINTS, units="seconds")
    words = ("-o", tmp_path / "out.h5", "--jobs", 1, "--item-seconds", 0)
    run = told("prepare", "clouds", tmp_path / "a.npz", *words)
    assert not run.returncode and "converted" not in run.stderr and "not read: units" in run.stderr
