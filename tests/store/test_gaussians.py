"""The gaussians file: what goes in comes out, nothing malformed passes, times between frames are interpolated."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError, UsageError
from dpcli.store.gaussians import LAYOUT, read_scene, scene_origin, write_scene
from dpcli.store.summary import summary
from tests.support.scenes import SWING, toy_scene


def test_round_trip_keeps_every_bit(tmp_path):
    scene = toy_scene(degree=2)
    write_scene(tmp_path / "scene.h5", scene, provenance={"command": "dpc generate4d fit"}, seed=3, source="toy")
    back = read_scene(tmp_path / "scene.h5")
    for key, (dtype, _) in LAYOUT.items():
        assert getattr(back, key).dtype == dtype
        np.testing.assert_array_equal(getattr(back, key), getattr(scene, key))
    assert (back.size, back.reference, back.metrics) == (scene.size, scene.reference, scene.metrics)
    assert (back.sh_degree, back.num_parts, back.num_frames) == (2, 2, 5)
    root, history = scene_origin(tmp_path / "scene.h5")
    assert (root["source"], root["seed"], history) == ("toy", 3, [{"command": "dpc generate4d fit"}])


def test_equal_scenes_give_equal_bytes_and_no_part_file_stays(tmp_path):
    for name in ("a.h5", "b.h5"):
        write_scene(tmp_path / name, toy_scene())
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.h5", "b.h5"]


def test_no_control_points_and_no_parts_are_allowed(tmp_path):
    scene = toy_scene(controls=0)
    bare = replace(
        scene,
        part=np.full_like(scene.part, -1),
        part_probability=scene.part_probability[:, :0],
        part_motion=scene.part_motion[:, :0],
    )
    write_scene(tmp_path / "bare.h5", bare)
    assert (read_scene(tmp_path / "bare.h5").num_parts, len(read_scene(tmp_path / "bare.h5").control_point)) == (0, 0)


def test_an_existing_file_is_kept_without_force(tmp_path):
    write_scene(tmp_path / "a.h5", toy_scene())
    with pytest.raises(UsageError, match="--force"):
        write_scene(tmp_path / "a.h5", toy_scene())
    write_scene(tmp_path / "a.h5", toy_scene(frames=3), force=True)
    assert read_scene(tmp_path / "a.h5").num_frames == 3


@pytest.mark.parametrize("key", sorted(LAYOUT))
def test_each_array_is_checked_for_shape_type_and_finite_values(key):
    scene = toy_scene()
    value = getattr(scene, key)
    with pytest.raises(DataError, match=rf"^it: .*\b{key} is .*expected"):
        replace(scene, **{key: value[..., None]}).validate("it")
    with pytest.raises(DataError, match=key):
        replace(scene, **{key: value.astype(np.complex64)}).validate("it")
    if value.dtype.kind == "f":
        bad = value.copy()
        bad.flat[-1] = np.nan
        with pytest.raises(DataError, match=f"{key} are NaN"):
            replace(scene, **{key: bad}).validate("it")


def _changed(key, change):
    scene = toy_scene()
    value = getattr(scene, key).copy()
    change(value)
    return replace(scene, **{key: value})


@pytest.mark.parametrize(
    ("key", "change", "says"),
    [
        ("quaternion", lambda v: v.__imul__(1.1), "300 rows of quaternion are not of length 1"),
        ("frame_quaternion", lambda v: v[2, 5].fill(0), "1 rows of frame_quaternion"),
        ("control_quaternion", lambda v: v[0, 0].fill(2), "control_quaternion"),
        ("time", lambda v: v.__setitem__(2, 0.0), "time must rise"),
        ("part", lambda v: v.__setitem__(0, 2), r"part holds 0..2, expected -1..1"),
        ("part", lambda v: v.__setitem__(0, -2), "part holds -2"),
        ("part_probability", lambda v: v.__setitem__((0, 0), 1.2), "part_probability holds"),
        ("rigid_weight", lambda v: v.__setitem__((0, 0), -0.2), "rigid_weight holds"),
        ("control_radius", lambda v: v.__setitem__(1, 0), "control_radius holds 0"),
        ("part_motion", lambda v: v[3, 1, :3, :3].__imul__(1.05), r"part_motion\[3, 1\] is not rigid"),
        ("part_motion", lambda v: v[3, 1, 0, :3].__imul__(-1), r"part_motion\[3, 1\]"),  # a mirror
        ("camera_intrinsics", lambda v: v.__setitem__((1, 0, 1), 5.0), "camera_intrinsics holds a camera with a skew"),
        ("camera_intrinsics", lambda v: v.__setitem__((1, 1, 0), 5.0), "camera_intrinsics holds a camera with a skew"),
        ("camera_world_to_camera", lambda v: v[1, 3].fill(1), r"camera_world_to_camera\[1\]"),
    ],
)
def test_bad_values_are_named(key, change, says):
    with pytest.raises(DataError, match=says):
        _changed(key, change).validate()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"reference": 2}, "reference is camera 2, expected 0..1"),
        ({"size": (64, 0)}, "size is"),
        ({"metrics": {"psnr": float("nan")}}, "metrics can't be JSON"),
        ({"sh": np.zeros((300, 2, 3), np.float32)}, "sh has 2 terms"),
    ],
)
def test_bad_headers_are_named(changes, says):
    with pytest.raises(DataError, match=says):
        replace(toy_scene(), **changes).validate()


@pytest.mark.parametrize("name", ["seed", "source", "length_unit"])
def test_a_scene_without_an_origin_is_bad_data(name, tmp_path):
    write_scene(tmp_path / "scene.h5", toy_scene())
    with h5py.File(tmp_path / "scene.h5", "a") as file:
        del file.attrs[name]
    with pytest.raises(DataError, match=f"no attribute '{name}'"):
        scene_origin(tmp_path / "scene.h5")


def test_a_damaged_file_is_refused(tmp_path):
    path = tmp_path / "scene.h5"
    write_scene(path, toy_scene())
    with h5py.File(path, "r+") as file:
        del file["sh"]
    with pytest.raises(DataError, match="sh missing; the file is incomplete"):
        read_scene(path)
    write_scene(path, toy_scene(), force=True)
    with h5py.File(path, "r+") as file:
        file.attrs["metrics"] = "{"
    with pytest.raises(DataError, match="metrics is damaged"):
        read_scene(path)
    write_scene(path, toy_scene(), force=True)
    with h5py.File(path, "r+") as file:
        file["frame_mean"][1, 2] = np.inf
    with pytest.raises(DataError, match="frame_mean are NaN or infinite"):
        read_scene(path)


@pytest.mark.parametrize("fine", [False, True])
def test_half_a_frame_beyond_the_ends_is_of_the_clip(fine):
    scene = toy_scene()
    step = float(np.diff(scene.time).min()) / (5 if fine else 1)  # the finer of both counts

    def asked(late: float) -> np.ndarray:
        last = scene.time[-1] + late * step
        return np.array([last - step, last]) if fine else np.array([last])

    scene.require_times(asked(0.49), "s.h5", "more")
    scene.require_times(scene.time[0] + (scene.time[-1] - asked(0.49))[::-1], "s.h5", "more")
    for times in (asked(0.51), scene.time[0] + (scene.time[-1] - asked(0.51))[::-1]):
        with pytest.raises(DataError, match="s.h5: holds .* s, but more"):
            scene.require_times(times, "s.h5", "more")


def test_at_a_frame_is_that_frame_and_the_ends_hold():
    scene = toy_scene()
    for t, time in enumerate(scene.time):
        means, quaternions = scene.at(time)
        np.testing.assert_array_equal(means, scene.frame_mean[t])
        np.testing.assert_array_equal(quaternions, scene.frame_quaternion[t])
    np.testing.assert_array_equal(scene.at(-5)[0], scene.frame_mean[0])
    np.testing.assert_array_equal(scene.at(5)[1], scene.frame_quaternion[-1])
    with pytest.raises(DataError, match="seconds"):
        scene.at(float("nan"))


@settings(deadline=None, max_examples=40)
@given(time=st.floats(0, 1), flip=st.booleans())
def test_between_frames_the_hinge_turns_as_it_should(time, flip):
    """The chord between two close rotations about one axis halves the angle; the sign of a quaternion is no matter."""
    scene = toy_scene(frames=9)
    if flip:
        scene.frame_quaternion[1::2] *= -1
    means, quaternions = scene.at(time)
    angle = SWING * time
    expected = np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)])
    moving = quaternions[scene.part == 1]
    assert np.abs(np.abs(moving @ expected) - 1).max() < 1e-5
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1, atol=1e-6)
    a, b, weight = scene.between(time)
    np.testing.assert_allclose(means, (1 - weight) * scene.frame_mean[a] + weight * scene.frame_mean[b], atol=1e-6)


def test_derived_values():
    scene = toy_scene()
    np.testing.assert_allclose(scene.opacity, 1 / (1 + np.exp(-2.2)), rtol=1e-6)
    assert replace(scene, opacity_logit=np.full(300, -200, np.float32)).opacity.max() == 0
    np.testing.assert_allclose(scene.color[[0, -1]], [[217, 38, 26], [26, 64, 230]], atol=1)
    np.testing.assert_allclose(
        replace(scene, sh=np.ones_like(scene.sh)).color, 255 * (0.5 + 0.5 / np.sqrt(np.pi)), atol=1
    )
    np.testing.assert_allclose(scene.scale[0], [0.05, 0.03, 0.03], rtol=1e-6)


def test_info_tells_what_a_scene_holds(tmp_path):
    write_scene(tmp_path / "s.h5", toy_scene(), source="toy")
    found = summary(tmp_path / "s.h5")
    assert found["counts"] == {"gaussians": 300, "frames": 5, "parts": 2, "control_points": 6, "cameras": 2}
    assert found["gaussians_per_part"] == {"0": 150, "1": 150} and found["metrics"] == {"psnr": 31.5}
    assert found["range"]["y"][1] == pytest.approx(toy_scene().frame_mean[..., 1].max())
