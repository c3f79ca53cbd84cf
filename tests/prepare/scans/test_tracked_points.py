"""Identities of points: they reach the file from columns, rows and views, or a sentence says why not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.prepare.decode.cloud_files import read_cloud
from dpcli.store import CloudsReader
from dpcli.store.views import ViewsReader
from tests.support.commands import exit_code as in_this_process

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")
_FRAMES, _POINTS = 5, 12


def exit_code(*words: object) -> int:
    """Runs a command; conversions of clouds without a worker process."""
    alone = ("--jobs", 1, "--item-seconds", 0) if "clouds" in words[:2] else ()
    return in_this_process(*words, *alone)


@pytest.fixture
def refused(capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Returns what a command says that must end with an error."""

    def run_refused(*words: object) -> str:
        assert exit_code(*words)
        return " ".join(capfd.readouterr().err.split())

    return run_refused


def _moving(rng: np.random.Generator) -> np.ndarray:
    return (rng.normal(size=(1, _POINTS, 3)) + 0.1 * np.arange(_FRAMES)[:, None, None]).astype(np.float32)


def _table(path: Path, names: list[str], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Writes a table whose rows are shuffled within each frame and lack some points; returns the places of each name."""
    points, lines = _moving(rng), ["frame,marker,x,y,z"]
    for t in range(_FRAMES):
        for k in rng.permutation(_POINTS)[: _POINTS - t % 3]:
            lines.append(f"{t},{names[k]},{','.join(f'{value:.6f}' for value in points[t, k])}")
    path.write_text("\n".join(lines) + "\n")
    return {name: points[:, k] for k, name in enumerate(names)}


@pytest.mark.parametrize("words", [False, True])
def test_column_of_table_names_points(tmp_path: Path, words: bool, capfd: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(3)
    names = [f"marker_{k:02d}" if words else str(7 * k + 20_000_001) for k in range(_POINTS)]
    truth = _table(tmp_path / "walk.csv", names, rng)
    assert 0 == exit_code("prepare", "clouds", tmp_path / "walk.csv", "--track", "marker", "-o", tmp_path / "out.h5")
    assert "tracks of 5 frames (median)" in capfd.readouterr().err
    with CloudsReader(tmp_path / "out.h5") as clouds:
        sequence = clouds.read(0)
    for t in range(_FRAMES):
        rows = slice(*sequence.frame_offsets[t : t + 2])
        for identity, point in zip(sequence.track[rows], sequence.points[rows], strict=True):
            name = names[identity] if words else str(identity)
            np.testing.assert_allclose(point, truth[name][t], atol=1e-5)


def _with_identities(form: str, place: Path, frames: list[tuple[np.ndarray, np.ndarray]]) -> Path:
    """Writes frames of points and their identities, and returns where they lie."""
    points, names = (np.concatenate([one[k] for one in frames]) for k in (0, 1))
    if form == "array":
        np.savez(place / "all.npz", points=points.reshape(len(frames), -1, 3), id=names.reshape(len(frames), -1))
        return place / "all.npz"
    if form == "table":
        rows = [(t, *row) for t, frame in enumerate(frames) for row in zip(frame[1].tolist(), *frame[0].T.tolist())]
        (place / "all.csv").write_text("frame,id,x,y,z\n" + "\n".join(",".join(map(str, row)) for row in rows) + "\n")
        return place / "all.csv"
    if form == "parquet":
        arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
        columns = {"frame": np.repeat(np.arange(len(frames)), len(names) // len(frames)), "id": names}
        table = arrow.table({**columns, **dict(zip("xyz", points.T))})
        parquet.write_table(table, place / "all.parquet")
        return place / "all.parquet"
    (place / "scan").mkdir()
    for t, (cloud, own) in enumerate(frames):
        np.savez(place / "scan" / f"{t}.npz", points=cloud, id=own)
    return place / "scan"


@pytest.mark.parametrize("form", ["array", "table", "parquet", "folder"])
@pytest.mark.parametrize("first", [-5, 2**24, 2**53, 2**62])
def test_identities_that_floats_would_round_stay_apart(tmp_path: Path, form: str, first: int) -> None:
    points = _moving(np.random.default_rng(7))
    names = [first + 4 * np.arange(_POINTS) + t % 2 for t in range(_FRAMES)]  # others in every second frame
    raw = _with_identities(form, tmp_path, list(zip(points, names)))
    assert 0 == exit_code("prepare", "clouds", raw, "--track", "id", "-o", tmp_path / "out.h5")
    with CloudsReader(tmp_path / "out.h5") as clouds:
        assert clouds.read(0).track.tolist() == np.concatenate(names).tolist()


def test_rounded_identities_and_missing_names_are_refused(tmp_path: Path, refused: Callable[..., str]) -> None:
    points = _moving(np.random.default_rng(8))
    names = [np.float32(2**24 + 2 * np.arange(_POINTS))] * _FRAMES
    command = ("prepare", "clouds", "-o", tmp_path / "out.h5", "--track", "id")
    raw = _with_identities("folder", tmp_path, list(zip(points, names)))
    assert "doesn't tell whole numbers beyond 16777216 apart" in refused(*command, raw)
    for missing in ("", "nan", "-0.5"):
        words = np.array([f"{k}_left" for k in range(_POINTS - 1)] + [missing])
        raw = _with_identities("table", tmp_path, [(cloud, words) for cloud in points])
        assert f"one for every point; found {missing!r} beside '0_left'" in refused(*command, raw)


@pytest.mark.parametrize("sampling", ["random", "fps", "voxel"])
def test_thinned_frames_keep_the_same_points(tmp_path: Path, sampling: str) -> None:
    points = _moving(np.random.default_rng(9))
    hidden = np.random.default_rng(10).random((_FRAMES, _POINTS)) < 0.2
    points[hidden] = np.nan
    np.save(tmp_path / "all.npy", points)
    words = ("--track", "rows", "--points", "5", "--sampling", sampling)
    assert 0 == exit_code("prepare", "clouds", tmp_path / "all.npy", *words, "-o", tmp_path / "out.h5")
    with CloudsReader(tmp_path / "out.h5") as clouds:
        sequence = clouds.read(0)
    assert np.diff(sequence.frame_offsets).tolist() == [5] * _FRAMES
    known: set[int] = set()
    for t, own in enumerate(sequence.track.reshape(_FRAMES, 5)):
        np.testing.assert_array_equal(sequence.frame(t), points[t, own])
        seen = known - set(np.flatnonzero(hidden[t]).tolist())
        assert seen <= set(own.tolist()) if len(seen) <= 5 else set(own.tolist()) <= seen
        known |= set(own.tolist())


def test_rows_name_points_though_some_are_no_measurement(tmp_path: Path) -> None:
    points = _moving(np.random.default_rng(4))
    points[2, 5] = np.nan
    folder = tmp_path / "scan"
    folder.mkdir()
    for t in range(_FRAMES):
        np.save(folder / f"{t:03d}.npy", points[t])
    np.save(tmp_path / "all.npy", points)
    for raw in (folder, tmp_path / "all.npy"):
        assert 0 == exit_code("prepare", "clouds", raw, "--track", "rows", "-o", tmp_path / "out.h5", "--force")
        with CloudsReader(tmp_path / "out.h5") as clouds:
            sequence = clouds.read(0)
        assert np.diff(sequence.frame_offsets).tolist() == [12, 12, 11, 12, 12]
        frame = np.repeat(np.arange(_FRAMES), np.diff(sequence.frame_offsets))
        np.testing.assert_array_equal(sequence.points, points[frame, sequence.track])


def test_rows_of_tables_that_hold_nothing_are_counted(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    points = _moving(np.random.default_rng(11))
    rows = [f"{s},{t},{x},{y},{z}" for s in "ab" for t in range(_FRAMES) for x, y, z in points[t].tolist()]
    for t in range(_FRAMES):  # each frame of the first sequence lacks another point
        rows[t * _POINTS + t] = ",,,,"
    (tmp_path / "all.csv").write_text("recording,frame,x,y,z\n" + "\n".join(rows) + "\n")
    command = ("prepare", "clouds", tmp_path / "all.csv", "--sequence-column", "recording", "-o", tmp_path / "out.h5")
    assert 0 == exit_code(*command)
    assert "rows with nothing between their delimiters dropped: 5" in capfd.readouterr().err
    assert exit_code(*command, "--track", "rows", "--force")
    assert "reading left some out (rows with nothing" in capfd.readouterr().err


def test_rows_with_few_digits_are_the_same_points(tmp_path: Path) -> None:
    points = 1e6 * _moving(np.random.default_rng(12)) + 5e6
    for t, frame in enumerate(points):
        (tmp_path / "scan").mkdir(exist_ok=True)
        np.savetxt(tmp_path / "scan" / f"{t}.xyz", frame, fmt="%.5e")
    assert 0 == exit_code("prepare", "clouds", tmp_path / "scan", "--track", "rows", "-o", tmp_path / "out.h5")


def test_what_cannot_be_an_identity_is_refused(tmp_path: Path, refused: Callable[..., str]) -> None:
    points = _moving(np.random.default_rng(5))
    folder = tmp_path / "scan"
    folder.mkdir()
    for t in range(_FRAMES):
        np.save(folder / f"{t:03d}.npy", points[t, : _POINTS - t])
    scan = ("prepare", "clouds", folder, "-o", tmp_path / "out.h5", "--track", "rows")
    assert "its frames have 8 to 12 points" in refused(*scan)
    _table(tmp_path / "walk.csv", ["1"] * _POINTS, np.random.default_rng(6))
    table = ("prepare", "clouds", tmp_path / "walk.csv", "-o", tmp_path / "out.h5", "--track")
    assert "12 points of frame 0 share the identity 1" in refused(*table, "marker")
    assert "expected a whole number for every point" in refused(*table, "x")
    assert "no such column; found frame, marker, x, y, z" in refused(*table, "joint")


def test_tracks_of_views_become_clouds(tmp_path: Path, refused: Callable[..., str]) -> None:
    assert 0 == exit_code(
        "prepare",
        "synthetic",
        "animal",
        "-o",
        tmp_path / "views.h5",
        "--size",
        "16",
        "--frames",
        "4",
        "--tracks",
        "200",
    )
    assert 0 == exit_code("prepare", "clouds", tmp_path / "views.h5", "-o", tmp_path / "out.h5")
    with ViewsReader(tmp_path / "views.h5") as views, CloudsReader(tmp_path / "out.h5") as clouds:
        sequence = clouds.read(0)
        np.testing.assert_array_equal(sequence.points.reshape(4, 200, 3), views.track)
        np.testing.assert_array_equal(sequence.part.reshape(4, 200), np.tile(views.part, (4, 1)))
        np.testing.assert_array_equal(sequence.track.reshape(4, 200), np.tile(np.arange(200), (4, 1)))
        np.testing.assert_array_equal(sequence.time, views.header.time)
        assert clouds.provenance[:-1] == views.provenance
    scaled = ("prepare", "clouds", tmp_path / "views.h5", "-o", tmp_path / "scaled.h5", "--scale", "1000")
    assert 0 == exit_code(*scaled)
    with CloudsReader(tmp_path / "scaled.h5") as clouds:  # as of other inputs: `--unit` names it, by default meters
        assert clouds.length_unit == "m"
        np.testing.assert_allclose(clouds.read(0).points, sequence.points / 1000, rtol=1e-6)
    assert 0 == exit_code(
        "prepare", "synthetic", "animal", "-o", tmp_path / "bare.h5", "--size", "16", "--frames", "2", "--tracks", "0"
    )
    other = ("prepare", "clouds", tmp_path / "views.h5", "-o", tmp_path / "none.h5")
    assert "leave out --axes" in refused(*other, "--axes", "TNC") and "leave out --axes" in refused(
        *other, "--gap", "2"
    )
    assert "views without true tracks" in refused("prepare", "clouds", tmp_path / "bare.h5", "-o", tmp_path / "none.h5")


def _meshes(folder: Path, suffix: str, points: np.ndarray) -> None:
    """Writes each frame's vertices between a face before them and normals, textures and a part behind, as exporters do."""
    folder.mkdir()
    for t, frame in enumerate(points.tolist()):
        rows = [" ".join(f"{value:.6f}" for value in point) for point in frame]
        texts = {
            ".obj": [
                "# v 9 9 9",
                "mtllib a.mtl",
                *(f"v  {row}" for row in rows[:5]),
                "vt 0 0",
                "vn 0 0 1",
                "f 1/1 2/1 3/1",
            ]
            + ["o part", *(f"v\t{row} # here" for row in rows[5:]), "f -1 -2 -3", ""],
            ".off": ["OFF", f"{len(rows)} 1 0", *rows, "3 0 1 2", ""],
        }
        (folder / f"{t:03d}{suffix}").write_text("\n".join(texts[suffix]))
    (folder / "a.mtl").write_text("newmtl a\n")


@pytest.mark.parametrize("suffix", [".obj", ".off"])
def test_rows_follow_the_vertices_of_meshes(tmp_path: Path, suffix: str, refused: Callable[..., str]) -> None:
    points = _moving(np.random.default_rng(7))
    _meshes(tmp_path / "body", suffix, points)
    command = ("prepare", "clouds", tmp_path / "body", "--track", "rows", "-o", tmp_path / "out.h5", "--force")
    assert 0 == exit_code(*command)
    with CloudsReader(tmp_path / "out.h5") as clouds:
        sequence = clouds.read(0)
    np.testing.assert_allclose(sequence.points.reshape(points.shape), points, atol=1e-5)
    np.testing.assert_array_equal(sequence.track, np.tile(np.arange(_POINTS), _FRAMES))
    last = tmp_path / "body" / f"{_FRAMES - 1:03d}{suffix}"
    whole = last.read_text()
    row = whole.split("\n")[3]
    last.write_text(whole.replace(row, row.rpartition(" ")[0]))
    assert "its vertices are no rows of as many numbers each" in refused(*command)


def test_meshes_beside_clouds_change_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    points = _moving(np.random.default_rng(8))
    _meshes(tmp_path / "scan", ".obj", points)
    for t in range(2):
        np.savetxt(tmp_path / "scan" / f"{t:03d}.xyz", points[t])
    assert 0 == exit_code("prepare", "clouds", tmp_path / "scan", "-o", tmp_path / "out.h5")
    assert "left out: 5 .obj files" in capfd.readouterr().err
    with CloudsReader(tmp_path / "out.h5") as clouds:
        assert np.diff(clouds.read(0).frame_offsets).tolist() == [_POINTS] * 2


def test_colors_of_vertices_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 1 2 3 1 0 0\nv 4 5 6 0 0.5 1\n")
    cloud = read_cloud(tmp_path / "a.obj")
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(cloud.color, [[1, 0, 0], [0, 0.5, 1]])


def test_colors_that_only_some_objects_of_a_file_have_are_left_out_and_counted(tmp_path: Path) -> None:
    file = tmp_path / "a.obj"
    file.write_text("o ball\nv 1 2 3 1 0 0\nv 4 5 6 0 0.5 1\nf 1 2 1\no cube\nv 7 8 9\nf 3 3 3\n")
    cloud = read_cloud(file)
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    assert cloud.color is None
    assert list(cloud.dropped.values()) == [2]
    file.write_text("v 1 2 3 1 0 0\nv 4 5 6 0 0.5 1\nv 7 8 9")
    with pytest.raises(DataError, match="no rows of as many numbers each; truncated"):
        read_cloud(file)


@pytest.mark.parametrize("mixed_up", [0.0, 0.4, 1.0])
@pytest.mark.parametrize(("count", "unit"), [(60, 0.01), (1500, 1.0)])
def test_rows_that_are_not_the_same_points_are_doubted(
    mixed_up: float, count: int, unit: float, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(count)
    shape = rng.normal(size=(count, 3)) * [3, 1, 0.3]
    (tmp_path / "body").mkdir()
    for t in range(_FRAMES):  # it bends, turns, travels and grows
        bent = shape + [0, 0, 1] * (0.1 * t * shape[:, :1] ** 2)
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        points = unit * (1.5**t * bent @ turn + [20 * t, 0, 0])
        some = rng.permutation(count)[: int(mixed_up * count)]
        points[np.sort(some)] = points[some]
        np.save(tmp_path / "body" / f"{t}.npy", points.astype(np.float32))
    command = ("prepare", "clouds", tmp_path / "body", "-o", tmp_path / "out.h5", "--item-seconds", "0", "--jobs", "1")
    assert 0 == exit_code(*command, "--track", "rows")
    assert ("lose their neighbors" in capfd.readouterr().err) == (mixed_up > 0)
    assert 0 == exit_code(*command, "--force")
    assert "lose their neighbors" not in capfd.readouterr().err
