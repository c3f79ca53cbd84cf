"""`dpc generate4d fit` as people run it: it learns, stops and continues, says what is wrong."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from dpcli.errors import DataError, UsageError
from dpcli.generate4d.commands import fit
from dpcli.generate4d.config import FitConfig, Supervision
from dpcli.generate4d.shape.config import ShapeConfig
from dpcli.generate4d.shape.model_file import save_shape_model
from dpcli.generate4d.shape.network import ShapeNetwork
from dpcli.ops.cameras import DEFAULT_FOVY, orbit_pose, pinhole
from dpcli.ops.splatting.rasterization import rasterization
from dpcli.store.gaussians import read_scene, scene_origin
from dpcli.store.views import ViewsHeader, ViewsWriter
from tests.support.scenes import toy_scene

SIZE, FRAMES = 48, 6


def steps(dense: int, sparse: int) -> tuple[str, ...]:
    return "--set", f"dense_steps={dense}", "--set", f"sparse_steps={sparse}"


def toy_views(path: Path, train: int = 0, test: int = 0, empty: bool = False) -> Path:
    """A red blob that stands and a blue one that swings around it, seen by a reference and further cameras."""
    rng = np.random.default_rng(0)
    cloud = rng.standard_normal((2, 60, 3)) * [[[0.12, 0.25, 0.12]], [[0.2, 0.08, 0.08]]]
    azimuths = np.deg2rad([0, *(90 * (1 + i) for i in range(train)), *(45 + 90 * i for i in range(test))])
    roles = ["reference", *["train"] * train, *["test"] * test]
    poses = np.stack([orbit_pose(a, 0.0) for a in azimuths])
    intrinsics = np.stack([pinhole(DEFAULT_FOVY, SIZE, SIZE)] * len(poses))
    header = ViewsHeader("toy", intrinsics, poses, np.arange(FRAMES) / 8, roles, 0, (SIZE, SIZE))
    color = torch.tensor([[0.9, 0.2, 0.1]] * 60 + [[0.1, 0.3, 0.9]] * 60)
    with ViewsWriter(path, header) as writer:
        for frame in range(FRAMES):
            turn = np.pi / 2 * frame / FRAMES
            rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
            blue = (cloud[1] + [0.4, 0, 0]) @ rotation.T
            points = torch.from_numpy(np.concatenate([cloud[0], blue])).float()
            with torch.no_grad():
                rgb, alpha, _ = rasterization(
                    points,
                    torch.tensor([[1.0, 0, 0, 0]]).repeat(120, 1),
                    torch.full((120, 3), 0.05),
                    torch.full((120,), 0.9),
                    color,
                    torch.from_numpy(poses).float(),
                    torch.from_numpy(intrinsics).float(),
                    SIZE,
                    SIZE,
                )
            rgba = torch.cat([rgb / alpha.clamp(min=1e-3), alpha], -1).clamp(0, 1) * (0 if empty else 255)
            for view in range(len(poses)):
                writer.add(view, frame, rgba[view].round().byte().numpy())
    return path


def test_a_fit_learns_the_pictures_and_writes_a_scene(tmp_path, dpc_here, one_thread):
    views, scene = toy_views(tmp_path / "views.h5"), tmp_path / "scene.h5"
    done = dpc_here(
        "generate4d",
        "fit",
        views,
        "-o",
        scene,
        "--preset",
        "tiny",
        *steps(100, 60),
        "--picture",
        tmp_path / "sheet.png",
    )
    assert done.returncode == 0, done.stderr
    result = read_scene(scene)
    assert result.num_frames == FRAMES and 1 <= result.num_parts <= 3 and len(result.control_point) == 24
    rows = json.loads((tmp_path / "scene.fit" / "log.json").read_text())
    assert result.metrics["psnr_reference"] > 22 and result.metrics["psnr_reference"] > rows[0]["psnr"] + 2
    assert {row["stage"] for row in rows} == {"dense", "sparse"}
    seconds = [row["seconds"] for row in rows]
    assert seconds == sorted(seconds) and 0 < seconds[3] < seconds[-1] <= result.metrics["seconds"]
    assert (tmp_path / "scene.fit" / "curves.png").stat().st_size > 5000
    assert (tmp_path / "sheet.png").stat().st_size > 1000
    assert result.part_probability.sum(1) == pytest.approx(1, abs=1e-4)
    same = dpc_here("generate4d", "fit", views, "-o", scene, "--preset", "tiny", *steps(100, 60))
    assert same.returncode == 0 and "already complete" in same.stderr.decode()
    again = dpc_here("generate4d", "fit", views, "-o", scene, "--preset", "tiny")
    assert again.returncode == 2 and "--force" in again.stderr.decode()


def test_given_views_make_the_side_right(tmp_path, dpc_here, one_thread):
    """The same steps with and without two more views: the picture from a camera that neither has seen is better with them."""
    views = toy_views(tmp_path / "views.h5", train=3, test=2)
    values = {}
    for prior in ("none", "views"):
        scene = tmp_path / f"with_{prior}.h5"
        done = dpc_here("generate4d", "fit", views, "-o", scene, "--preset", "tiny", "--prior", prior, *steps(50, 30))
        assert done.returncode == 0, done.stderr
        scored = dpc_here("evaluate", "video", scene, "--truth", views, "--metrics", "psnr", "--json")
        assert scored.returncode == 0, scored.stderr
        values[prior] = json.loads(scored.stdout)["metrics"]["per_role"]["test"]["psnr"]
    assert values["views"] > values["none"] + 1.0, values


@pytest.mark.parametrize("train, prior, told", [(2, "auto", True), (2, "views", False), (0, "auto", False)])
def test_given_views_that_are_not_used_are_told(train, prior, told, tmp_path, capsys):
    views = toy_views(tmp_path / "views.h5", train)
    fit._load(views, FitConfig(size=16), Supervision(prior=prior))
    assert ("2 of its views may be fitted to, too, but only --prior views" in capsys.readouterr().err) == told


@pytest.mark.parametrize("logit, told", [(-4.0, True), (1.0, False)])
def test_an_object_that_faded_away_is_told(logit, told, capsys):
    scene = toy_scene()
    fit._tell_faint(replace(scene, opacity_logit=np.full_like(scene.opacity_logit, logit)))
    assert ("the most opaque has 0.018" in capsys.readouterr().err) == told


@pytest.mark.parametrize(
    "scale, shift, told",
    [(1, 0, ""), (0.1, 0, ""), (3, 0, "reach "), (1e3, 0, "reach "), (1e-3, 0, "be tiny"), (1, 9, "reach ")],
)
def test_a_world_of_another_unit_or_origin_is_told(scale, shift, told, tmp_path, capsys):
    """The same pictures, in a world that another program measured otherwise: what is seen of it scales along."""
    targets = fit._load(toy_views(tmp_path / "views.h5"), FitConfig(size=32), Supervision())
    reach, half = targets.object_reach()
    assert 0.5 < reach < 1.1 and half == pytest.approx(2 * np.tan(DEFAULT_FOVY / 2))
    targets.world_to_camera[:, :3, 3] *= scale
    assert targets.object_reach() == pytest.approx((scale * reach, scale * half))
    targets.world_to_camera[:, 1, 3] += shift
    targets.check_world("views.h5")
    said = capsys.readouterr().err
    assert (told in said and "views.h5" in said) if told else not said
    targets.world_to_camera[:, 2, 3] *= -1
    with pytest.raises(DataError, match=r"views.h5: the world's origin is not in front of the reference camera"):
        targets.check_world("views.h5")


def test_pictures_that_nobody_cut_out_are_told(tmp_path, capsys):
    targets = fit._load(toy_views(tmp_path / "views.h5"), FitConfig(size=32), Supervision())
    targets.pictures[0, 1:, ..., 3] = 1
    targets.check_cut_out("views.h5")
    assert not capsys.readouterr().err
    targets.pictures[0, 0, ..., 3] = 1
    targets.check_cut_out("views.h5")
    assert "views.h5: alpha is full all over every picture of the reference view" in capsys.readouterr().err


def test_a_fit_of_one_view_stays_where_the_object_is(tmp_path, dpc_here):
    """A ball seen once, which is a ball from the side as well, neither a cloud behind it nor a splinter."""
    path = tmp_path / "ball.h5"
    axis = (np.arange(SIZE) + 0.5 - SIZE / 2) / SIZE
    mask = axis[:, None] ** 2 + axis**2 < 0.3**2
    rgba = np.where(mask[..., None], np.uint8([200, 60, 20, 255]), np.uint8(0))
    pose, lens = orbit_pose(0.5, 0.1), pinhole(DEFAULT_FOVY, SIZE, SIZE)
    with ViewsWriter(
        path, ViewsHeader("ball", lens[None], pose[None], np.zeros(1), ["reference"], 0, (SIZE, SIZE))
    ) as w:
        w.add(0, 0, rgba)
    radius = 0.3 * SIZE / lens[0, 0] * 2
    for prior in ("inflated", "none"):
        scene = tmp_path / f"{prior}.h5"
        done = dpc_here("generate4d", "fit", path, "-o", scene, "--preset", "tiny", "--prior", prior, *steps(60, 20))
        assert done.returncode == 0, done.stderr
        fitted = read_scene(scene)
        solid = fitted.frame_mean[0][fitted.opacity > 0.3]
        depth = solid @ pose[2, :3]
        assert abs(depth.mean()) < 0.1 * radius and np.ptp(depth) == pytest.approx(2 * radius, rel=0.25), prior
        longest = fitted.log_scale.max(1) - fitted.log_scale.mean(1)
        assert longest.max() <= np.log(2) + 1e-4


def test_a_stopped_fit_continues_to_the_same_scene(tmp_path, dpc_here, one_thread):
    """Stopped from outside in a process of its own, and gone on with in this one."""
    views = toy_views(tmp_path / "views.h5")
    words = ("generate4d", "fit", views, "--preset", "tiny", *steps(30, 50), "--size", 16, "--device", "cpu")
    whole = dpc_here(*words, "-o", tmp_path / "whole.h5")
    assert whole.returncode == 0, whole.stderr
    command = [sys.executable, "-m", "dpcli", *map(str, words), "-o", str(tmp_path / "cut.h5")]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
    log = tmp_path / "cut.fit" / "log.json"
    deadline = time.monotonic() + 120
    while not log.exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 75 and "run the same command again" in process.stderr.read()
    assert not (tmp_path / "cut.h5").exists() and (tmp_path / "cut.fit" / "state.pt").exists()
    rest = dpc_here(*words, "-o", tmp_path / "cut.h5")
    assert rest.returncode == 0, rest.stderr
    one, two = read_scene(tmp_path / "whole.h5"), read_scene(tmp_path / "cut.h5")
    np.testing.assert_array_equal(one.frame_mean, two.frame_mean)
    np.testing.assert_array_equal(one.part_probability, two.part_probability)


def test_the_switches_of_table_5_2_do_what_they_say(tmp_path, dpc_here):
    views = toy_views(tmp_path / "views.h5")
    options, scenes = ("--preset", "tiny", *steps(8, 8)), {}
    for name, off in {"a": ("rigid", "sparse"), "c": ("fusion", "sparse"), "e": ()}.items():
        switches = [word for switch in off for word in ("--set", f"{switch}=false")]
        done = dpc_here("generate4d", "fit", views, "-o", tmp_path / f"{name}.h5", *options, *switches)
        assert done.returncode == 0, done.stderr
        scenes[name] = read_scene(tmp_path / f"{name}.h5")
    assert len(scenes["a"].control_point) == 0 and len(scenes["e"].control_point) == 24
    assert (scenes["a"].rigid_weight == 0).all() and (scenes["c"].rigid_weight == 1).all()
    assert 0 < scenes["e"].rigid_weight.mean() < 1


def test_what_is_wrong_is_said(tmp_path, dpc_here):
    views, blank = toy_views(tmp_path / "views.h5"), toy_views(tmp_path / "blank.h5", empty=True)
    with h5py.File(sided := toy_views(tmp_path / "sided.h5", train=2), "r+") as file:
        file["rgba"][2] = 0
    for code, words, arguments in (
        (3, "role 'train'", (views, "-o", tmp_path / "a.h5", "--prior", "views")),
        (3, "shows nothing", (blank, "-o", tmp_path / "a.h5")),
        (3, "view 2 (train) shows nothing", (sided, "-o", tmp_path / "a.h5", "--prior", "views")),
        (
            3,
            "--prior-model nosuch: no such file",
            (views, "-o", tmp_path / "a.h5", "--prior", "network", "--prior-model", "nosuch"),
        ),
        (2, "prior = magic: expected one of", (views, "-o", tmp_path / "a.h5", "--prior", "magic")),
        (2, "preset = slow: expected one of", (views, "-o", tmp_path / "a.h5", "--preset", "slow")),
        (2, "--run FOLDER", (views, "-o", "-", "--preset", "tiny")),
        (3, "not an HDF5 file", (__file__, "-o", tmp_path / "a.h5")),
    ):
        done = dpc_here("generate4d", "fit", *arguments)
        assert done.returncode == code and words in done.stderr.decode(), done.stderr
        assert b"Traceback" not in done.stderr and not (tmp_path / "a.h5").exists()


@pytest.mark.parametrize("setting", ["rate_mean=1e12,1e-4"])
def test_a_fit_that_runs_away_is_told(setting, tmp_path, dpc_here):
    """Before a picture is drawn, or a scene written, of Gaussians that are nowhere."""
    views, out = toy_views(tmp_path / "toy.h5"), tmp_path / "s.h5"
    small = ("--preset", "tiny", "--size", 16, *steps(2, 2), "--set", setting)
    done = dpc_here("generate4d", "fit", views, "-o", out, *small)
    said = done.stderr.decode()
    assert done.returncode in (0, 1), said
    if done.returncode:
        assert (
            "became NaN or infinite; the last checkpoint is kept; try smaller rates" in said
            or "the loss became" in said
        )
    else:
        assert np.isfinite(read_scene(out).frame_mean).all()


def test_coarse_steps_shrink_a_picture_to_two_pixels_at_most(tmp_path, dpc_here):
    views, small = toy_views(tmp_path / "toy.h5"), ("--preset", "tiny", "--prior", "none", "--size", 16, *steps(2, 1))
    done = dpc_here("generate4d", "fit", views, "-o", tmp_path / "s.h5", *small, "--set", "coarse=0.5,100")
    assert done.returncode == 0, done.stderr


def narrow_views(path: Path, width: int, height: int) -> Path:
    header = ViewsHeader(
        "n",
        pinhole(0.85, width, height)[None],
        orbit_pose(0.0, 0.0)[None],
        np.arange(2.0),
        ["reference"],
        0,
        (width, height),
    )
    with ViewsWriter(path, header) as writer:
        for frame in range(2):
            writer.add(0, frame, np.full((height, width, 4), 255, np.uint8))
    return path


def test_narrow_pictures_are_fitted_and_those_of_one_row_refused(tmp_path, dpc_here):
    words = ("--preset", "tiny", "--prior", "inflated", "--size", 300, *steps(1, 1))
    done = dpc_here("generate4d", "fit", narrow_views(tmp_path / "a.h5", 300, 3), "-o", tmp_path / "s.h5", *words)
    assert done.returncode == 0, done.stderr
    done = dpc_here("generate4d", "fit", narrow_views(tmp_path / "b.h5", 1000, 3), "-o", tmp_path / "t.h5", *words)
    assert done.returncode == 3 and b"1000 x 3 pixels, 300 x 1 at --size 300, are too narrow" in done.stderr


def test_another_configuration_in_the_same_place_is_refused(tmp_path, dpc_here):
    from dpcli.generate4d.fit import COLUMNS
    from dpcli.runtime.run_folder import RunFolder

    with RunFolder(tmp_path / "scene.fit", {"config": 1}, columns=COLUMNS):
        pass
    with pytest.raises(UsageError, match="another configuration"):
        RunFolder(tmp_path / "scene.fit", {"config": 2}, columns=COLUMNS)
    with pytest.raises(
        UsageError, match=r"\(config 1, now absent; config.a absent, now 1; .*d absent, now 2, and 1 more\)"
    ):
        RunFolder(tmp_path / "scene.fit", {"config": {"a": 1, "b": {"c": None, "d": 2, "e": 3}}}, columns=COLUMNS)
    RunFolder(tmp_path / "scene.fit", {"config": 1, "newer": None}, columns=COLUMNS)  # a setting that nobody sets
    done = dpc_here(
        "generate4d", "fit", toy_views(tmp_path / "views.h5"), "-o", tmp_path / "scene.h5", "--preset", "tiny"
    )
    assert done.returncode == 2 and b"another configuration" in done.stderr


def test_the_settings_of_a_run_make_the_same_run_again(tmp_path, dpc_here):
    views = toy_views(tmp_path / "views.h5", train=1)
    words = ("--preset", "tiny", "--prior", "views", "--size", "16", *steps(2, 1), "--set", "regularize=false")
    assert dpc_here("generate4d", "fit", views, "-o", tmp_path / "a.h5", *words).returncode == 0
    settings = tmp_path / "a.fit" / "settings.toml"
    done = dpc_here("generate4d", "fit", views, "-o", tmp_path / "b.h5", "--config", settings)
    assert done.returncode == 0, done.stderr
    one, two = (scene_origin(tmp_path / name)[1][-1]["config"] for name in ("a.h5", "b.h5"))
    assert one == two and (one["regularize"], one["prior"], one["config"]["dense_steps"]) == (False, "views", 2)
    assert settings.read_text() == (tmp_path / "b.fit" / "settings.toml").read_text()
    other = dpc_here(
        "generate4d", "fit", views, "-o", tmp_path / "c.h5", "--run", tmp_path / "a.fit", *words, "--parts", 2
    )
    assert other.returncode == 2 and b"config.parts 3, now 2" in other.stderr


def test_a_prior_that_was_trained_again_makes_another_fit(tmp_path, dpc_here):
    """The scene of the weights before doesn't count as that of the weights that are there now, under the same name."""
    weights = tmp_path / "weights.safetensors"
    words = ("generate4d", "fit", toy_views(tmp_path / "views.h5"), "-o", tmp_path / "scene.h5", "--preset", "tiny")
    words = (*words, "--size", 16, *steps(1, 1), "--prior", "network", "--prior-model", weights)
    model = ShapeNetwork(ShapeConfig(widths=(4, 8), hidden=8, bins=5))
    made = b"made with other prior weights; write to"  # and nothing else: seed, version and clip are the same
    for offset, code, said in ((1.0, 0, b"fitting"), (1.0, 0, b"already complete"), (2.0, 2, made)):
        save_shape_model(weights, model, {"size": 16, "confidence": [0.0] * 8 + [offset]})
        done = dpc_here(*words)
        assert done.returncode == code and said in b" ".join(done.stderr.split()), done.stderr
    assert b"is not read with --prior inflated" in dpc_here(*words, "--prior", "inflated", "--force").stderr


def test_a_finished_fit_still_draws_its_picture(tmp_path, dpc_here):
    import imageio.v3 as imageio

    views, scene = toy_views(tmp_path / "views.h5", train=1), tmp_path / "scene.h5"
    words = ("generate4d", "fit", views, "-o", scene, "--preset", "tiny", "--prior", "views", *steps(3, 3))
    done = dpc_here(*words, "--picture", tmp_path / "first.png")
    assert done.returncode == 0 and done.stderr.count(b"preview.png: a preview from all sides") == 1
    before = scene.read_bytes()
    done = dpc_here(*words, "--picture", tmp_path / "later.png")
    assert done.returncode == 0 and b"already complete" in done.stderr and scene.read_bytes() == before
    first, later = (imageio.imread(tmp_path / name).astype(int) for name in ("first.png", "later.png"))
    assert first.shape == (9 * SIZE, 5 * SIZE, 3) and np.abs(first - later).max() <= 1


def test_a_picture_that_cannot_be_written_costs_no_fit(tmp_path, dpc_here, monkeypatch):
    views, scene = toy_views(tmp_path / "views.h5"), tmp_path / "scene.h5"
    words = ("generate4d", "fit", views, "-o", scene, "--preset", "tiny", "--size", 16, *steps(1, 1))
    for name, said in (("no/x.png", b"the folder"), ("x.foo", b"unknown kind '.foo'"), ("", b"unknown kind ''")):
        done = dpc_here(*words, "--picture", tmp_path / name if name else "")
        assert done.returncode in (2, 3) and said in done.stderr and not (tmp_path / "scene.fit").exists()

    def full(model, targets, path: Path) -> None:
        if path.name == "sheet.png":  # not the previews while it learns
            raise DataError(f"{path}: no space left")

    monkeypatch.setattr("dpcli.generate4d.commands.fit.write_preview", full)
    done = dpc_here(*words, "--picture", tmp_path / "sheet.png")
    assert done.returncode == 3 and read_scene(scene).num_frames == FRAMES


@pytest.mark.parametrize(
    ("asked", "prior", "card", "gsplat", "taken"),
    [
        ("auto", "network", True, False, "cpu"),
        ("auto", "network", True, True, "auto"),
        ("auto", "zero123", True, False, "auto"),
        ("auto", "network", False, False, "auto"),
        ("cuda", "network", True, False, "cuda"),
    ],
)
def test_a_fit_takes_the_card_where_that_is_faster_or_asked_for(asked, prior, card, gsplat, taken, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: card)
    monkeypatch.setattr(fit, "gsplat_available", lambda: gsplat)
    assert fit._device(asked, prior) == taken
