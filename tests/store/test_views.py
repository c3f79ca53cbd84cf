"""The `views` file: what goes in comes out, incomplete or broken files never pass."""

from __future__ import annotations

import pickle
from contextlib import nullcontext
from dataclasses import replace

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError, UsageError
from dpcli.ops.cameras import DEFAULT_FOVY, orbit_pose, pinhole
from dpcli.store import ViewsHeader, ViewsReader, ViewsWriter
from dpcli.store.summary import summary
from tests.support.hdf5_edits import edit, replacing


def make_header(views: int = 3, frames: int = 4, size: tuple[int, int] = (6, 5)) -> ViewsHeader:
    return ViewsHeader(
        "toy",
        np.stack([pinhole(DEFAULT_FOVY, *size)] * views),
        np.stack([orbit_pose(0.5 * view, 0.1 * view) for view in range(views)]),
        np.arange(frames) / 16.0,
        ["train"] * (views - 2) + ["reference", "test"][: min(views, 2)],
        max(views - 2, 0),
        size,
        "m",
    )


def picture(view: int, frame: int, size: tuple[int, int] = (6, 5)) -> np.ndarray:
    return np.random.default_rng([view, frame]).integers(0, 256, (size[1], size[0], 4), np.uint8)


def write(path, header: ViewsHeader, **options):
    with ViewsWriter(path, header, **options) as writer:
        for frame in range(header.num_frames):
            for view in reversed(range(header.num_views)):  # any order
                writer.add(view, frame, picture(view, frame, header.size))
    return path


@settings(max_examples=10, deadline=None)
@given(st.integers(1, 4), st.integers(1, 4), st.tuples(st.integers(1, 9), st.integers(1, 9)), st.integers(0, 3))
def test_everything_comes_back(tmp_path_factory, views, frames, size, points):
    header = make_header(views, frames, size)
    rng = np.random.default_rng(0)
    track = rng.normal(size=(frames, points, 3)).astype(np.float32) if points else None
    part = np.arange(-1, points - 1).astype(np.int16) if points else None
    path = write(
        tmp_path_factory.mktemp("views") / "a.h5",
        header,
        track=track,
        part=part,
        seed=3,
        source="toy",
        provenance={"command": "dpc x"},
    )
    with ViewsReader(path) as reader:
        assert (reader.num_views, reader.num_frames) == (views, frames)
        for key in ("name", "role", "reference", "size", "length_unit"):
            assert getattr(reader.header, key) == getattr(header, key)
        for key in ("intrinsics", "world_to_camera", "time"):
            np.testing.assert_array_equal(getattr(reader.header, key), getattr(header, key))
        for view in range(views):
            for frame in range(frames):
                np.testing.assert_array_equal(reader.rgba(view, frame), picture(view, frame, size))
        if points:
            np.testing.assert_array_equal(reader.track, track)
            np.testing.assert_array_equal(reader.part, part)
            assert (reader.track.dtype, reader.part.dtype) == (np.float32, np.int16)
        else:
            assert reader.track is None and reader.part is None
        assert reader.provenance == [{"command": "dpc x"}] and reader.attributes["seed"] == 3


def test_equal_work_gives_equal_bytes_and_one_picture_is_one_chunk(tmp_path):
    first, second = (write(tmp_path / name, make_header()).read_bytes() for name in ("a.h5", "b.h5"))
    assert first == second
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["rgba"].chunks == (1, 1, 5, 6, 4) and file.attrs["dpc_kind"] == "views"


def test_a_missing_picture_leaves_no_file(tmp_path):
    with pytest.raises(DataError, match="11 of 12 pictures are missing, the first is view 0, frame 1"):
        with ViewsWriter(tmp_path / "a.h5", make_header()) as writer:
            writer.add(0, 0, picture(0, 0))
    assert list(tmp_path.iterdir()) == []


def test_an_exception_leaves_no_file_and_an_existing_one_needs_force(tmp_path):
    with pytest.raises(RuntimeError):
        with ViewsWriter(tmp_path / "a.h5", make_header()):
            raise RuntimeError
    assert list(tmp_path.iterdir()) == []
    path = write(tmp_path / "a.h5", make_header())
    with pytest.raises(UsageError, match="--force"):
        ViewsWriter(path, make_header())
    write(path, make_header(views=2), force=True)
    with ViewsReader(path) as reader:
        assert reader.num_views == 2


@pytest.mark.parametrize(
    ("view", "frame", "rgba", "message"),
    [
        (3, 0, picture(0, 0), "3 views and 4 frames"),
        (0, 4, picture(0, 0), "3 views and 4 frames"),
        (-1, 0, picture(0, 0), "3 views"),
        (0, 0, picture(0, 0).astype(np.float32), "float32"),
        (0, 0, picture(0, 0)[..., :3], "expected uint8"),
        (1, 1, picture(0, 0), "given twice"),
    ],
)
def test_add_refuses_what_does_not_fit(tmp_path, view, frame, rgba, message):
    with pytest.raises(DataError, match=message):
        with ViewsWriter(tmp_path / "a.h5", make_header()) as writer:
            writer.add(1, 1, picture(1, 1))
            writer.add(view, frame, rgba)
    assert list(tmp_path.iterdir()) == []


def _mirrored(header: ViewsHeader) -> np.ndarray:
    poses = header.world_to_camera.copy()
    poses[1, 0, :3] *= -1
    return poses


BROKEN = {
    "time": (lambda h: np.array([0, 1, 1, 2.0]), "frame 2 is not later"),
    "world_to_camera": (_mirrored, "view 1 is not a rotation"),
    "intrinsics": (lambda h: h.intrinsics * np.nan, "NaN"),
    "role": (lambda h: ["train", "reference", "validation"], "'validation'"),
    "reference": (lambda h: 0, "reference = 0"),
    "size": (lambda h: (0, 5), "none may be 0"),
}


@pytest.mark.parametrize("field", BROKEN)
def test_a_broken_header_is_refused_before_writing(tmp_path, field):
    header = make_header()
    header.validate()
    change, message = BROKEN[field]
    with pytest.raises(DataError, match=message):
        ViewsWriter(tmp_path / "a.h5", replace(header, **{field: change(header)}))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("skew", "refused"), [(0.0, False), (0.5, False), (2.0, True), (-2.0, True)])
def test_a_skew_that_no_picture_would_show_is_refused(skew, refused):
    header = make_header()
    header.intrinsics[1, 0, 1] = skew
    with pytest.raises(DataError, match="view 1 have a skew of -?2; expected pixels") if refused else nullcontext():
        header.validate()


@pytest.mark.parametrize(
    ("truth", "message"),
    [
        ({"track": np.zeros((3, 2, 3))}, "frames = 4"),
        ({"track": np.full((4, 2, 3), np.nan)}, "finite"),
        ({"track": np.zeros((4, 2, 3)), "part": np.zeros(3)}, "2 ids"),
        ({"track": np.zeros((4, 2, 3)), "part": [-2, 0]}, "below -1"),
        ({"part": np.zeros(3)}, "without track"),
    ],
)
def test_broken_ground_truth_is_refused(tmp_path, truth, message):
    with pytest.raises(DataError, match=message):
        ViewsWriter(tmp_path / "a.h5", make_header(), **truth)
    assert list(tmp_path.iterdir()) == []


TAMPER = {
    "no rgba": (lambda f: f.__delitem__("rgba"), "'rgba' is missing"),
    "no role": (lambda f: f.__delitem__("role"), "'role' is missing"),
    "no reference": (lambda f: f.attrs.__delitem__("reference"), "'reference' is missing"),
    "three channels": (replacing("rgba", np.zeros((3, 4, 5, 6, 3), np.uint8)), "expected u8"),
    "fewer frames": (replacing("time", np.arange(3.0)), "frames = 3"),
    "text times": (replacing("time", np.array([b"a"] * 4)), "time"),
    "NaN pose": (lambda f: f["world_to_camera"].__setitem__((0, 0, 0), np.nan), "NaN"),
    "stretched pose": (lambda f: f["world_to_camera"].__setitem__((0, 0, 0), 2.0), "not a rotation"),
    "another kind": (lambda f: f.attrs.__setitem__("dpc_kind", "clouds"), "expected 'views'"),
}


@pytest.mark.parametrize("name", TAMPER)
def test_a_tampered_file_is_refused(tmp_path, name):
    path = write(tmp_path / "a.h5", make_header())
    ViewsReader(path)
    change, message = TAMPER[name]
    edit(path, change)
    with pytest.raises(DataError, match=message):
        ViewsReader(path)


def test_damaged_truth_and_pixels_are_found_when_read(tmp_path):
    path = write(tmp_path / "a.h5", make_header(), track=np.zeros((4, 2, 3)), part=np.zeros(2))
    with h5py.File(path, "r+") as file:
        file["track"][0, 0, 0] = np.inf
    with ViewsReader(path) as reader, pytest.raises(DataError, match="track"):
        _ = reader.track
    raw = bytearray(path.read_bytes())
    with h5py.File(path) as file:
        where = file["rgba"].id.get_chunk_info_by_coord((0, 0, 0, 0, 0)).byte_offset
    raw[where : where + 8] = b"\0" * 8
    path.write_bytes(raw)
    with ViewsReader(path) as reader:
        with pytest.raises(DataError, match="view 0, frame 0: damaged"):
            reader.rgba(0, 0)
        with pytest.raises(DataError, match="3 views and 4 frames"):
            reader.rgba(3, 0)


def test_a_reader_travels_to_workers_without_its_handle(tmp_path):
    path = write(tmp_path / "a.h5", make_header())
    with ViewsReader(path) as reader:
        reader.rgba(0, 0)
        with pickle.loads(pickle.dumps(reader)) as copy:
            assert copy._file is None
            np.testing.assert_array_equal(copy.rgba(2, 3), picture(2, 3))


def test_info_tells_cameras_and_draws_every_view(tmp_path, dpc_here):
    from PIL import Image

    header = make_header(size=(40, 30))
    path = tmp_path / "a.h5"
    with ViewsWriter(path, header, track=np.zeros((4, 7, 3)), part=np.array([0, 0, 1, 1, 4, 4, -1])) as writer:
        for view in range(3):
            for frame in range(4):
                rgba = np.zeros((30, 40, 4), np.uint8)
                rgba[10:20, 10:30] = (255, 0, 0, 255) if view == 2 else (0, 0, 255, 128)
                writer.add(view, frame, rgba)
    found = summary(path)
    assert found["counts"] == {"views": 3, "frames": 4, "tracks": 7, "parts": 3}
    for view, camera in enumerate(found["orbit"]):
        assert camera["azimuth"] == pytest.approx(np.rad2deg(0.5 * view), abs=1e-9)
        assert camera["elevation"] == pytest.approx(np.rad2deg(0.1 * view), abs=1e-9)
        assert (camera["radius"], camera["fovy"]) == (pytest.approx(2), pytest.approx(49.1))
    result = dpc_here("info", path, "--picture", tmp_path / "sheet.png")
    assert result.returncode == 0 and b"view 2" in result.stdout and b"40x30" in result.stdout
    colors = {tuple(c) for c in np.array(Image.open(tmp_path / "sheet.png").convert("RGB")).reshape(-1, 3).tolist()}
    assert {(255, 0, 0), (127, 127, 255), (255, 255, 255)} <= colors  # half-transparent blue lies on white
    assert dpc_here("info", path, "--picture", tmp_path / "s.png", "--view", "xyz").returncode == 2
