"""Tables whose rows are frames: every point of every row arrives with its identity, whoever wrote the table."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dpcli.prepare.scans.tables import TableSequences
from dpcli.prepare.wide_tables import MISSING
from dpcli.store import CloudsReader
from tests.support.commands import told

_FRAMES, _MARKERS = 7, 9  # more columns than the first line of Motive has cells
_NAMES = [f"LK{chr(65 + k)}" for k in range(_MARKERS)]


def _moving() -> np.ndarray:
    return np.random.default_rng(2).normal(size=(1, _MARKERS, 3)) + 0.1 * np.arange(_FRAMES)[:, None, None]


def _rows(points: np.ndarray, sign: str, before: Callable[[int], list[object]] = lambda t: [t]) -> list[str]:
    numbers = [["" if np.isnan(value) else f"{value:.6f}" for value in frame.ravel()] for frame in points]
    return [sign.join([*map(str, before(t)), *own]) for t, own in enumerate(numbers)]


def _trc(points: np.ndarray) -> str:
    axes = "\t".join(f"X{k}\tY{k}\tZ{k}" for k in range(1, _MARKERS + 1))
    return "\n".join(
        [
            "PathFileType\t4\t(X/Y/Z)\twalk.trc",
            "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
            f"100.00\t100.00\t{_FRAMES}\t{_MARKERS}\tmm\t100.00\t1\t{_FRAMES}",
            "Frame#\tTime\t" + "\t\t\t".join(_NAMES) + "\t\t",
            f"\t\t{axes}",
            "",
            *_rows(1000 * points, "\t", lambda t: [t + 1, f"{t / 100:.2f}"]),
        ]
    )


def _motive(points: np.ndarray) -> str:
    """A rigid body by quaternions and one by angles stand before the markers, its place and error behind them."""
    turns, places = 7, 3 * _MARKERS
    first = (
        "Format Version,1.23,Take Name,Take 1,Capture Frame Rate,100.0,Export Frame Rate,100.0,Capture Start Time,noon,"
        "Total Frames in Take,7,Total Exported Frames,7,Rotation Type,Quaternion,Length Units,Centimeters,Coordinate Space,Global"
    )
    rows = [
        ["", "", *["Rigid Body"] * turns, *["Marker"] * places, "Marker Quality"],
        ["", "", *["Box"] * turns, *(name for name in _NAMES for _ in "xyz"), "Box"],
        ["", "", *["Rotation"] * turns, *["Position"] * places, "Mean Marker Error"],
        ["Frame", "Time (Seconds)", *"XYZW", *"XYZ", *"XYZ" * _MARKERS, ""],
    ]
    numbers = _rows(100 * points, ",", lambda t: [t, f"{t / 100:.6f}", *[0.1] * turns])
    return "\n".join([first, "", *(",".join(row) for row in rows), *(f"{row},0.001" for row in numbers)])


def _vicon(points: np.ndarray) -> str:
    head = ["Trajectories", "100", ",," + ",,,".join(f"Ben:{name}" for name in _NAMES) + ",,"]
    names = ["Frame,Sub Frame," + ",".join(["X,Y,Z"] * _MARKERS), ",," + ",".join(["mm"] * 3 * _MARKERS)]
    return "\n".join([*head, *names, *_rows(1000 * points, ",", lambda t: [t + 1, 0])])


def _deep_lab_cut(points: np.ndarray) -> str:
    names = [word for name in _NAMES for word in (name,) * 3]
    head = ["scorer", *["net"] * 3 * _MARKERS], ["bodyparts", *names], ["coords", *"xyz" * _MARKERS]
    return "\n".join([*map(",".join, head), *_rows(points, ",")])


def _plain(points: np.ndarray) -> str:
    names = ["frame", *(f"{name}_{axis}" for name in _NAMES for axis in "xyz"), "snr"]
    rows = [f"{row},7" for row in _rows(points, ",")]
    return "\n".join([",".join(names), *rows[::-1]])  # the last frame first


def _by_axes(points: np.ndarray) -> str:
    """Numbers for names and all x before all y, decimal commas, velocities behind."""
    names = ["frame", *(f"{axis}{k}" for axis in "xyz" for k in range(_MARKERS)), "vel_x", "vel_y", "vel_z"]
    rows = [f"{row};1;2;3" for row in _rows(points.transpose(0, 2, 1), ";")]
    return "\n".join([";".join(names), *rows]).replace(".", ",")


@pytest.mark.parametrize(
    ("name", "write", "timed"),
    [
        ("walk.trc", _trc, True),
        ("take.csv", _motive, True),
        ("vicon.csv", _vicon, False),
        ("net.csv", _deep_lab_cut, False),
        ("plain.csv", _plain, False),
        ("axes.csv", _by_axes, False),
    ],
)
def test_every_point_of_every_row_is_read(
    tmp_path: Path, name: str, write: Callable[[np.ndarray], str], timed: bool
) -> None:
    points = _moving()
    points[2, 4] = np.nan  # a marker that is hidden
    points[5, -1] = np.nan
    (tmp_path / name).write_text(write(points) + "\n")
    command = ("prepare", "clouds", tmp_path / name, "-o", tmp_path / "out.h5", "--jobs", "1", "--item-seconds", "0")
    plain = told(*command)
    assert "give --track columns" in " ".join(plain.stderr.split())
    said = told(*command, "--track", "columns", "--force")
    assert said.returncode == 0, said.stderr
    with CloudsReader(tmp_path / "out.h5") as clouds:
        sequence = clouds.read(0)
        assert clouds.length_unit == "m"
    frame = np.repeat(np.arange(_FRAMES), np.diff(sequence.frame_offsets))
    assert len(frame) == _FRAMES * _MARKERS - 2
    np.testing.assert_allclose(sequence.points, points[frame, sequence.track], atol=1e-5)
    if name == "take.csv":
        assert "not read: Rigid Body Box Rotation X, Rigid Body Box Rotation Y," in " ".join(said.stderr.split())
    if timed:
        np.testing.assert_allclose(sequence.time, np.arange(_FRAMES) / 100, atol=1e-9)
    else:
        assert sequence.time is None


@pytest.mark.parametrize(("name", "write"), [("walk.trc", _trc), ("take.csv", _motive)])
def test_frames_that_the_head_counts_and_that_are_missing_are_told(
    tmp_path: Path, name: str, write: Callable[[np.ndarray], str]
) -> None:
    text = write(_moving())
    for lost in (0, 2):
        (tmp_path / name).write_text("\n".join(text.split("\n")[: -lost or None]))
        reader = TableSequences(tmp_path / name, track="columns")
        assert reader.read(reader.items()[0], np.random.default_rng()).notes.get(MISSING, 0) == lost


def test_sequences_of_a_wide_table_are_told_apart(tmp_path: Path) -> None:
    points = _moving()
    names = ["take,frame", *(f"{name}_{axis}" for name in _NAMES for axis in "xyz")]
    rows = [row for take in "ab" for row in _rows(points, ",", lambda t, take=take: [take, t])]  # type: ignore[misc]
    path = tmp_path / "log.csv"
    path.write_text("\n".join([",".join(names), *rows]))
    reader = TableSequences(path, sequence_column="take", track="columns")
    for item in reader.items():
        sequence = reader.read(item, np.random.default_rng()).sequence
        np.testing.assert_allclose(sequence.points.reshape(points.shape), points, atol=1e-5)
    (bad,) = TableSequences(path, track="columns").items()
    assert "14 rows for 7 frames; expected one row for each frame" in bad.problem
    (kept,) = TableSequences(path, sequence_column="take", track="columns", keep=("take",)).items()
    assert "--keep-fields take: columns of rows, not of points" in kept.problem


@pytest.mark.parametrize(
    "names", ["acc_x,acc_y,acc_z,gyro_x,gyro_y,gyro_z", "x,y,z,vx,vy,vz", "hip_x,hip_y,knee_x,knee_y"]
)
def test_columns_in_threes_that_are_no_places_are_refused(tmp_path: Path, names: str) -> None:
    (tmp_path / "log.csv").write_text(f"frame,{names}\n" + "".join(f"{t},1,2,3,4,5,6\n" for t in range(4)))
    (item,) = TableSequences(tmp_path / "log.csv", track="columns").items()
    assert "no columns of several points, such as hip_x, hip_y, hip_z" in item.problem


def test_formats_of_motion_capture_are_told_what_to_do(tmp_path: Path) -> None:
    for name, advice in {
        "walk.c3d": "export them as .trc or .csv, and give --track columns",
        "walk.bvh": "they hold angles of joints: compute where these are",
        "000_keypoints.json": "if they hold joints, write a table with a row for each frame",
        "scans.jsonl": "write a table with a row for each point and columns frame, x, y and z",
        "walk.sto": "call them .txt, and give --track columns",
        "walk.avro": "write them as .parquet",
        "walk.zarr": "save their arrays as .npy",
        "walk.trc": "give --track columns",
    }.items():
        folder = tmp_path / name.replace(".", "_")
        folder.mkdir()
        if name == "walk.zarr":
            (folder / name).mkdir()
            (folder / name / "zarr.json").write_text("{}\n")
        else:
            (folder / name).write_text("x\n")
        for raw in (folder, folder / name)[: 1 if name == "walk.trc" else 2]:
            said = told("prepare", "clouds", raw, "-o", tmp_path / "out.h5")
            assert said.returncode == 3 and advice in " ".join(said.stderr.split())


def test_the_place_of_a_rigid_body_stands_behind_its_quaternion(tmp_path: Path) -> None:
    """As Motive writes both; of columns of errors, too, none is a point."""
    points = np.concatenate([_moving().mean(1, keepdims=True), _moving()[:, :2]], axis=1)
    rows = [
        ["", "", *["Rigid Body"] * 8, *["Marker"] * 6],
        ["", "", *["Box"] * 8, *["A"] * 3, *["B"] * 3],
        ["", "", *["Rotation"] * 4, *["Position"] * 3, "Mean Marker Error", *["Position"] * 6],
        ["Frame", "Time (Seconds)", *"XYZW", *"XYZ", "", *"XYZ" * 2],
    ]
    numbers = [[t, t / 100, 0, 0, 0, 1, *own[0], 0.1, *own[1:].ravel()] for t, own in enumerate(points)]
    (tmp_path / "take.csv").write_text("\n".join(",".join(map(str, row)) for row in [*rows, *numbers]) + "\n")
    names = [f"{name}_{axis}{kind}" for name in "abc" for axis in "xyz" for kind in ("", "_err")]
    table = np.repeat(points.reshape(len(points), -1), 2, axis=1)
    table[:, 1::2] = 0.01
    np.savetxt(tmp_path / "errors.csv", table, delimiter=",", header=",".join(names), comments="", fmt="%.9g")
    for name in ("take.csv", "errors.csv"):
        (item,) = (reader := TableSequences(tmp_path / name, track="columns")).items()
        found = reader.read(item, np.random.default_rng(0)).sequence.points.reshape(points.shape)
        np.testing.assert_allclose(found, points, atol=1e-5)


@pytest.mark.parametrize(("unit", "seconds"), [("ms", 1e-3), ("(s)", 1.0), ("", 1.0)])
def test_a_row_of_units_tells_that_of_the_times(tmp_path, unit, seconds):
    points, written = _moving(), [0.0, 33.3, 66.7, 100.1, 133.4, 166.7, 200.2]
    rows = _rows(1000 * points, ",", lambda t: [t, written[t]])
    names = ",".join(f"{name}_{axis}" for name in _NAMES for axis in "xyz")
    (tmp_path / "w.csv").write_text("\n".join([f"Frame,Time,{names}", f",{unit}" + ",mm" * 3 * _MARKERS, *rows]) + "\n")
    reader = TableSequences(tmp_path / "w.csv", track="columns")
    (item,) = reader.items()
    sequence = reader.read(item, np.random.default_rng(0)).sequence
    np.testing.assert_allclose(sequence.time, np.array(written) * seconds)
    np.testing.assert_allclose(sequence.points.reshape(points.shape), points, atol=1e-6)
