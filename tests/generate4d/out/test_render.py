"""Pictures of a scene: camera paths, times, colors, trails, and the files they end in."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import typer
from PIL import Image

from dpcli.cli.generate4d.render import render
from dpcli.draw.palette import PALETTE, part_colors
from dpcli.errors import UsageError
from dpcli.generate4d.out.camera_paths import Lens, clip_rate, default_rate, instants, pivot, plan_shots
from dpcli.generate4d.out.picture_colors import WEIGHTS, parse_background, weight_colors
from dpcli.generate4d.out.preview import write_preview
from dpcli.generate4d.out.render import Look, Renderer, render_views
from dpcli.generate4d.render_settings import CATALOG
from dpcli.generate4d.targets import Targets
from dpcli.ops.cameras import orbit_of, orbit_pose
from dpcli.store import ViewsHeader, ViewsReader
from dpcli.store.gaussians import GaussianScene, write_scene
from tests.support.commands import told
from tests.support.scenes import in_unit, shifted, toy_scene


@pytest.fixture(scope="module")
def scene() -> GaussianScene:
    return toy_scene(per_part=120, size=48)


@pytest.fixture(scope="module")
def renderer(scene) -> Renderer:
    return Renderer(scene)


# --- where the camera is, what time it is


def test_the_reference_path_is_the_input_frame_by_frame(scene):
    shots = plan_shots(scene, "reference")
    assert [shot.time for shot in shots] == pytest.approx(scene.time[:5].tolist(), abs=1e-6)
    assert all((shot.world_to_camera == scene.camera_world_to_camera[0]).all() for shot in shots)
    assert (shots[0].intrinsics == scene.camera_intrinsics[0]).all() and shots[0].size == (48, 48)


def test_a_turntable_loops_in_space_and_time(scene):
    shots = plan_shots(scene, "turntable", Lens(elevation=0.2))
    azimuths = np.unwrap([orbit_of(shot.world_to_camera)[0] for shot in shots])
    steps = np.diff(azimuths)
    np.testing.assert_allclose(steps, 2 * np.pi / len(shots), atol=1e-9)
    assert orbit_of(shots[7].world_to_camera)[1:] == pytest.approx((0.2, 2.0))
    assert default_rate(scene, "turntable") == 24 and clip_rate(scene) == 4
    loop = scene.num_frames / clip_rate(scene)  # 1.25 s: three times in about four seconds
    assert len(shots) == round(3 * loop * 24)
    np.testing.assert_allclose(instants(scene, 31, 24)[-1], scene.time[0], atol=1e-6)  # begins again after 1.25 s


@pytest.mark.parametrize(("rate", "shown"), [(1, 1), (60, 60), (25, 25), (240, 60), (1e5, 60), (0.25, 1), (1e-4, 1)])
def test_a_slow_or_fast_clip_shows_every_frame(rate, shown):
    """Once around, at the rate `shown`; only below 1 and above 60 that is not real time."""
    clip = toy_scene(per_part=5, frames=8)
    clip = replace(clip, time=3 + np.arange(8) / rate)
    assert clip_rate(clip) == pytest.approx(shown)
    assert [clip.time.searchsorted(shot.time, "right") - 1 for shot in plan_shots(clip, "reference")] == list(range(8))
    np.testing.assert_allclose([shot.time for shot in plan_shots(clip, "fixed")], clip.time, atol=1e-6 / rate)
    step = round(default_rate(clip, "turntable") / shown)  # pictures a frame
    times = np.array([shot.time for shot in plan_shots(clip, "turntable")])
    assert len(times) % (8 * step) == 0  # whole loops
    np.testing.assert_allclose(times[: 7 * step], 3 + np.arange(7 * step) / step / rate, atol=1e-6 / rate)
    assert len(plan_shots(clip, "fixed", fps=120)) == round(8 * 120 / shown)


@pytest.mark.parametrize(("path", "azimuth", "elevation"), [("swing", 70, 0), ("orbit", 360, 40), ("fixed", 0, 0)])
def test_paths_reach_as_far_as_they_should(scene, path, azimuth, elevation):
    places = np.rad2deg(
        [orbit_of(shot.world_to_camera)[:2] for shot in plan_shots(scene, path, Lens(radius=3.0), frames=72)]
    )
    reach = np.ptp(np.unwrap(places[:, 0], period=360)), np.ptp(places[:, 1])
    assert reach == pytest.approx((azimuth * (71 / 72 if path == "orbit" else 1), elevation), abs=0.5)


def test_size_and_field_of_view(scene):
    wide = replace(scene, size=(96, 48))
    for lens, size in ((Lens(), (96, 48)), (Lens(size=192), (192, 96)), (Lens(size=192, fovy=1.0), (192, 96))):
        shot = plan_shots(wide, "fixed", lens, frames=1)[0]
        assert shot.size == size
        focal = 48 / math.tan(0.5) if lens.fovy else scene.camera_intrinsics[0, 1, 1] * size[1] / 48
        assert shot.intrinsics[1, 1] == pytest.approx(focal)


@pytest.mark.parametrize("path", ["turntable", "orbit", "swing", "fixed"])
def test_an_orbit_keeps_the_object_in_the_middle_whatever_the_reference_camera_sees_there(scene, path):
    """The reference has an oblong sensor, of which a corner was cut out, and doesn't look at the origin."""
    lens = np.array([[40.0, 0, 5], [0, 50, 33], [0, 0, 1]])
    pose = scene.camera_world_to_camera[0].copy()
    pose[:2, 3] = [0.8, 0.2]
    cameras = {"camera_intrinsics": lens[None], "camera_world_to_camera": pose[None]}
    other = replace(scene, size=(48, 40), reference=0, **cameras)
    for shot in plan_shots(other, path, Lens(size=96), frames=6):
        origin = shot.intrinsics @ shot.world_to_camera[:3, 3]
        np.testing.assert_allclose(origin[:2] / origin[2], [48, 40], atol=1e-9)
        assert shot.intrinsics[[0, 1], [0, 1]] == pytest.approx([80, 100])
    own = plan_shots(other, "reference", Lens(size=96), frames=1)[0]
    np.testing.assert_allclose(own.intrinsics, np.diag([2, 2, 1]) @ lens)


def test_a_still_instant_and_a_scene_of_one_frame(scene):
    assert [shot.time for shot in plan_shots(scene, "fixed", time=0.3)] == [0.3]
    assert {shot.time for shot in plan_shots(scene, "turntable", time=0.3)} == {0.3}
    one = toy_scene(per_part=5, frames=1)
    assert len(plan_shots(one, "reference")) == 1 and len(plan_shots(one, "turntable")) == 120


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("radius=0", "radius = 0: expected a number above 0"),
        ("fovy=180", "fovy = 180: expected a number above 0 and below 180"),
        ("elevation=114", "elevation = 114: expected at least -90 and at most 90"),
        ("size=4", "size = 4: expected at least 8"),
        ("fps=0.5", "fps = 0.5: expected at least 1"),
        ("path=spiral", "path = spiral: expected one of turntable"),
        ("color=shape", "color = shape: expected one of appearance"),
    ],
)
def test_wrong_cameras_are_refused(word, says):
    with pytest.raises(UsageError, match=says):
        CATALOG.parse_set([word])


# --- what is drawn


def _blue(picture: np.ndarray) -> np.ndarray:
    """Center (x, y) of the blue part."""
    rows, columns = np.nonzero(picture[..., 2].astype(int) - picture[..., 0] > 120)
    return np.array([columns.mean(), rows.mean()]) + 0.5


def test_things_are_where_the_camera_sees_them_at_every_time(scene, renderer):
    for time in (0.0, 0.6, 1.0):
        shot = plan_shots(scene, "fixed", time=time)[0]
        camera = scene.at(time)[0][scene.part == 1] @ shot.world_to_camera[:3, :3].T + shot.world_to_camera[:3, 3]
        expected = (camera @ shot.intrinsics.T)[:, :2] / camera[:, 2:]
        assert np.linalg.norm(_blue(renderer.picture(shot)) - expected.mean(0)) < 1.0


def test_backgrounds_and_transparency_agree(scene, renderer):
    shot = plan_shots(scene, "fixed", time=0.5)[0]
    clear = renderer.picture(shot, Look(background=None)).astype(float)
    alpha = clear[..., 3:] / 255
    for ground in ((255, 255, 255), (0, 0, 0), (10, 200, 30)):
        solid = renderer.picture(shot, Look(background=ground))
        assert (solid[0, 0] == ground).all()
        np.testing.assert_allclose(solid, clear[..., :3] * alpha + np.array(ground) * (1 - alpha), atol=1.6)
    assert clear[0, 0].tolist() == [0, 0, 0, 0] and clear[..., 3].max() > 250


def test_part_rigid_and_depth_colors(scene, renderer):
    shot = plan_shots(scene, "fixed", time=0.0)[0]
    middles = [tuple(np.array([24, 24]) + [0, side]) for side in (-8, 8)]
    for part, place in enumerate(middles):
        by_part = renderer.picture(shot, Look("part"))[place]
        assert np.abs(by_part.astype(int) - PALETTE[part]).max() < 12
    weightless = Renderer(replace(scene, rigid_weight=np.zeros_like(scene.rigid_weight)))
    assert np.abs(weightless.picture(shot, Look("rigid"))[middles[0]].astype(int) - WEIGHTS[0]).max() < 12
    aside = plan_shots(scene, "fixed", Lens(azimuth=1.2), time=0.0)[0]  # from the blue box's side: blue is nearer
    depth, color = renderer.picture(aside, Look("depth")).astype(int), renderer.picture(aside)
    near = color[..., 2].astype(int) - color[..., 0] > 150
    far = color[..., 0].astype(int) - color[..., 2] > 150
    assert depth[near].sum(1).mean() > depth[far].sum(1).mean() + 60


def test_trails_follow_control_points_and_start_where_they_were(scene, renderer):
    shot = plan_shots(scene, "fixed", time=1.0)[0]
    plain, drawn = (renderer.picture(shot, Look(trajectories=on)) for on in (False, True))
    changed = (plain != drawn).any(-1)
    assert 10 < changed.sum() < 0.3 * changed.size
    bare = Renderer(toy_scene(per_part=120, size=48, controls=0))  # then Gaussians draw them
    assert (bare.picture(shot, Look(trajectories=True)) != plain).any()
    assert renderer.picture(shot, Look(trajectories=True, background=None)).shape == (48, 48, 4)


@pytest.mark.parametrize("away", [(1.6, 0, 0), (0, 0, -3), (-30, 5, 9)])
def test_cameras_turn_around_an_object_that_is_not_at_the_origin(away, scene, renderer):
    """As in a world that a stranger's program made: its own camera stands as before, seen from the object."""
    other, moved = Renderer(shifted(scene, np.array(away))), np.float64(away)
    for path in ("fixed", "orbit"):
        here, there = (plan_shots(drawn.scene, path, frames=5) for drawn in (renderer, other))
        for one, two in zip(here, there, strict=True):
            middle = (
                other.scene.frame_mean.reshape(-1, 3).astype(float) @ two.world_to_camera[:3, :3].T
                + two.world_to_camera[:3, 3]
            )
            pixels = (middle @ two.intrinsics.T)[:, :2] / middle[:, 2:]
            assert (middle[:, 2] > 0).all() and (0 < pixels).all() and (pixels < 48).all()
            assert one.time == two.time
    np.testing.assert_array_equal(pivot(shifted(scene, moved / np.linalg.norm(moved) * 0.5)), 0)  # as ever


@pytest.mark.parametrize("away", [(0, 0, 0), (1.6, 0, 0), (-30, 5, 9)])
def test_a_preview_shows_the_sides_of_an_object_that_is_not_at_the_origin(away, scene, tmp_path):
    moved, size = shifted(scene, np.array(away)), 48
    pictures = torch.zeros(2, scene.num_frames, size, size, 4, dtype=torch.float16)
    cameras = moved.camera_intrinsics, moved.camera_world_to_camera
    write_preview(moved, Targets("toy", pictures, *cameras, moved.time, 0), tmp_path / "p.png")
    sheet = np.asarray(Image.open(tmp_path / "p.png")).astype(int).min(-1).reshape(9, size, -1, size)
    for picture in sheet[4:].swapaxes(1, 2).reshape(-1, size, size):
        rows, columns = np.nonzero(picture < 250)
        assert len(rows) > 30 and abs(np.median(rows) - 24) < 10 and abs(np.median(columns) - 24) < 10
        assert 0 < min(rows.min(), columns.min()) and max(rows.max(), columns.max()) < size - 1


def test_a_camera_in_the_middle_of_what_it_sees_turns_around_all_of_it(scene):
    """As one that filmed a room: there is no direction from which it looks at the middle, and no distance."""
    count = scene.num_gaussians // 2
    mirrored = np.concatenate([scene.frame_mean[:, :count], -scene.frame_mean[:, :count]], 1)
    inside = replace(scene, frame_mean=mirrored, camera_world_to_camera=np.stack([np.eye(4)] * 2))
    shot = plan_shots(inside, "turntable", frames=2)[0]
    assert np.isfinite(shot.world_to_camera).all() and orbit_of(shot.world_to_camera)[2] == pytest.approx(inside.reach)


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1e3])
@pytest.mark.parametrize("color", ["appearance", "depth"])
def test_a_scene_looks_the_same_in_any_unit(unit, color, scene, renderer):
    """A world in meters of something as small as a grain has its camera nearer than a hundredth."""
    look, other = Look(color, trajectories=True), in_unit(scene, unit)
    here, there = (
        drawn.picture(plan_shots(drawn.scene, "fixed", time=0.6)[0], look).astype(int)
        for drawn in (renderer, Renderer(other))
    )
    assert (here != 255).any(-1).mean() > 0.1 and np.abs(here - there).max() <= 1


def test_color_tables():
    assert part_colors(np.array([-1, 0, 14])).tolist() == [[128] * 3, PALETTE[0].tolist(), PALETTE[0].tolist()]
    np.testing.assert_array_equal(weight_colors(np.linspace(0, 1, 9)), WEIGHTS)
    assert weight_colors(np.array([-1.0, 2.0])).tolist() == [WEIGHTS[0].tolist(), WEIGHTS[-1].tolist()]
    assert [parse_background(text) for text in ("white", "1,2,3", "none")] == [(255, 255, 255), (1, 2, 3), None]
    for text in ("gray", "1,2", "1,2,256"):
        with pytest.raises(UsageError, match="--background"):
            parse_background(text)


# --- where it ends


def test_a_views_file_has_the_pictures_of_its_cameras(scene, renderer, tmp_path):
    poses = np.stack([orbit_pose(0.0, 0.0), orbit_pose(1.0, 0.3)])
    header = ViewsHeader(
        "toy", scene.camera_intrinsics, poses, np.array([0.0, 0.4]), ["reference", "test"], 0, (48, 48)
    )
    render_views(renderer, header, tmp_path / "v.h5")
    with ViewsReader(tmp_path / "v.h5") as reader:
        assert (reader.num_views, reader.num_frames, reader.header.role) == (2, 2, ["reference", "test"])
        shot = replace(
            plan_shots(scene, "fixed", time=0.4)[0], world_to_camera=poses[1], intrinsics=scene.camera_intrinsics[1]
        )
        np.testing.assert_array_equal(reader.rgba(1, 1), renderer.picture(shot, Look(background=None)))


def test_a_views_file_has_the_look_that_was_asked_for(scene, renderer, tmp_path):
    from typer.testing import CliRunner

    app = typer.Typer()
    app.command()(render)
    write_scene(tmp_path / "s.h5", scene)
    header = ViewsHeader(
        "toy",
        scene.camera_intrinsics,
        scene.camera_world_to_camera,
        np.array([1.0]),
        ["reference", "test"],
        0,
        (48, 48),
    )
    render_views(renderer, header, tmp_path / "v.h5")
    words = [str(tmp_path / "s.h5"), "--device", "cpu", "--cameras", str(tmp_path / "v.h5"), "-o"]
    done = CliRunner().invoke(app, [*words, str(tmp_path / "p.h5"), "--color", "part", "--trajectories"])
    assert done.exit_code == 0, done.exception
    shot = plan_shots(scene, "reference", time=1.0)[0]
    with ViewsReader(tmp_path / "p.h5") as reader:
        np.testing.assert_array_equal(reader.rgba(0, 0), renderer.picture(shot, Look("part", None, True)))
        assert reader.provenance[-1]["config"] == {"cameras": True, "color": "part", "trajectories": True}
    for more, says in (
        (["--background", "black"], "background: cannot be used with --cameras"),
        (["--path", "swing"], "path: cannot be used with"),
        (["--set", "frames=3", "--set", "fps=9"], "frames, fps: cannot be used with"),
        (["--azimuth", "0", "--time", "0"], "azimuth, time:"),
        (["--size", "32"], "size: cannot be used with"),
    ):
        refused = CliRunner().invoke(app, [*words, str(tmp_path / "q.h5"), *more])
        assert isinstance(refused.exception, UsageError) and says in str(refused.exception)
    late = [*words[:1], "--set", "frames=2", "--time", "99", "-o", str(tmp_path / "q.gif")]
    assert "but --time is 99" in str(CliRunner().invoke(app, late).exception)
    many = [*words[:1], "--set", "frames=2", "-o", str(tmp_path / "q.png")]
    assert "frames: -o" in str(CliRunner().invoke(app, many).exception)
    render_views(renderer, replace(header, time=np.array([0.0, 9.0])), tmp_path / "late.h5")
    late = [*words[:3], "--cameras", str(tmp_path / "late.h5"), "-o", str(tmp_path / "q.h5")]
    assert "late.h5 has frames from 0 to 9 s; was it" in str(CliRunner().invoke(app, late).exception)
    assert not (tmp_path / "q.h5").exists()
    sheet_words = [
        "--picture",
        str(tmp_path / "sheet.png"),
        "--set",
        "columns=1",
        "--size",
        "16",
        "--time",
        "0",
        "--background",
        "black",
    ]
    # what a sheet has use for is its own
    done = CliRunner().invoke(app, [*words, str(tmp_path / "q.h5"), *sheet_words])
    assert done.exit_code == 0 and (tmp_path / "q.h5").exists(), done.exception


def test_the_command_draws_and_refuses(scene, tmp_path):
    import cv2
    from typer.testing import CliRunner

    app = typer.Typer()
    app.command()(render)
    write_scene(tmp_path / "s.h5", scene)
    words = [str(tmp_path / "s.h5"), "--device", "cpu", "-o"]
    done = CliRunner().invoke(
        app,
        [
            *words,
            str(tmp_path / "a.mp4"),
            "--path",
            "swing",
            "--size",
            "32",
            "--set",
            "frames=7",
            "--color",
            "part",
            "--trajectories",
            "--picture",
            str(tmp_path / "sheet.png"),
            "--set",
            "columns=3",
        ],
    )
    assert done.exit_code == 0, done.exception
    assert cv2.VideoCapture(str(tmp_path / "a.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 7
    assert cv2.imread(str(tmp_path / "sheet.png")).shape[:2] == (4 + 4 * (32 + 22), 4 + 3 * (32 + 4))
    for more, says in (
        ([str(tmp_path / "b.mp4"), "--background", "none"], "has no transparency"),
        (
            [str(tmp_path / "b.mp4"), "--path", "reference", "--azimuth", "30"],
            "azimuth: --path reference is the input's own",
        ),
        ([str(tmp_path / "b.mp4"), "--cameras", str(tmp_path / "s.h5")], "-o FILE.h5"),
        ([str(tmp_path / "a.mp4")], "--force"),
    ):
        refused = CliRunner().invoke(app, [*words, *more])
        assert isinstance(refused.exception, UsageError) and says in str(refused.exception)
    assert not (tmp_path / "b.mp4").exists()


def test_one_picture_is_counted_as_drawn(scene, tmp_path):
    write_scene(tmp_path / "s.h5", scene)
    done = told("generate4d", "render", tmp_path / "s.h5", "-o", tmp_path / "a.png", "--size", 16)
    assert done.returncode == 0 and "render 1/1 100%" in done.stderr
