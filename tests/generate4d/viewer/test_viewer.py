"""The page: self-contained, faithful to the scene, and drawn by a real browser as the cameras say."""

from __future__ import annotations

import base64
import json
import re
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import typer

from dpcli.cli.generate4d.view import view
from dpcli.errors import UsageError
from dpcli.generate4d.out.camera_paths import Shot
from dpcli.generate4d.out.render import Look, Renderer
from dpcli.generate4d.viewer import packed, write_page
from dpcli.ops.cameras import DEFAULT_FOVY, orbit_pose, pinhole
from dpcli.store.gaussians import write_scene
from tests.support.browser import PRESSED, needs_browser, open_page
from tests.support.scenes import in_unit, shifted, toy_scene

WIDTH, HEIGHT = 420, 320
_FLAGS = (
    "--use-angle=swiftshader --enable-unsafe-swiftshader --virtual-time-budget=4000"
    " --run-all-compositor-stages-before-draw"  # or the picture may be taken before the canvas is in it
).split()


@dataclass
class Shown:
    """What a browser made of a page: pixels u8 (H,W,3), whether it got ready, its error text."""

    pixels: np.ndarray
    state: str
    error: str
    page: str


def show(page: Path, state: str, tmp_path: Path) -> Shown:
    """The page in a new browser; again, at most twice, while its canvas had not reached the picture."""
    for _ in range(3):
        shown = _shown(page, state, tmp_path)
        if shown.state == "error" or (shown.pixels != shown.pixels[0, 0]).any():
            break
    return shown


def _shown(page: Path, state: str, tmp_path: Path) -> Shown:
    from PIL import Image

    picture = tmp_path / "shown.png"
    html, said = open_page(
        f"{page.as_uri()}#{state}", tmp_path, *_FLAGS, f"--window-size={WIDTH},{HEIGHT}", f"--screenshot={picture}"
    )
    found = re.search(r'<html[^>]*data-state="(\w+)"', html)
    error = re.search(r'id="error"[^>]*>([^<]*)<', html)
    assert found and error, said[-2000:]
    return Shown(np.asarray(Image.open(picture).convert("RGB")), found[1], error[1], html)


@pytest.fixture(scope="module")
def scene():
    return toy_scene(per_part=400, frames=5)


@pytest.fixture(scope="module")
def page(scene, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("page") / "toy.html"
    write_page(scene, path, title="A <toy> & more", history=[{"command": "dpc generate4d fit </script>", "seed": 0}])
    return path


def _ours(scene, time: float, azimuth: float, elevation: float, **look) -> np.ndarray:
    pose, lens = orbit_pose(np.deg2rad(azimuth), np.deg2rad(elevation)), pinhole(DEFAULT_FOVY, WIDTH, HEIGHT)
    return Renderer(scene).picture(Shot(time, pose, lens, (WIDTH, HEIGHT)), Look(**look)).astype(int)


@needs_browser
def test_a_browser_draws_what_our_rasterizer_draws(scene, page, tmp_path):
    """Another implementation (GLSL), the same splatting: pixels differ by rounding of the data and of blending only."""
    pictures = []
    for state, look in (
        ("time=0.4&azimuth=25&elevation=20", {}),
        ("time=1&azimuth=25&elevation=20&color=part&background=black", {"color": "part", "background": (12, 14, 18)}),
    ):
        shown = show(page, f"{state}&controls=0", tmp_path)
        assert (shown.state, shown.error) == ("ready", "")
        ours = _ours(scene, 0.4 if not look else 1.0, 25, 20, **look)
        difference = np.abs(ours - shown.pixels)
        assert (ours != ours[0, 0]).any(-1).mean() > 0.1 and difference.mean() < 0.5
        assert np.quantile(difference, 0.999) <= 12
        pictures.append(shown)
    start, end = pictures
    assert np.abs(start.pixels.astype(int) - end.pixels).mean() > 20  # time, color and background do something
    assert "part 0" in end.page and "&lt;/script&gt;" in end.page and "31.5" in end.page


@needs_browser
@pytest.mark.parametrize(
    ("unit", "radius", "size"),
    [(1000.0, 2000.0, (64, 64)), (0.01, 0.02, (64, 24)), (1e-5, 2e-5, (64, 64)), (1.0, 150.0, (36, 64))],
)
def test_a_page_opens_where_the_camera_stands(unit, radius, size, scene, tmp_path):
    """Of scenes in another unit, of one seen from afar through a long lens, and of clips of all shapes, which it shows whole."""
    pose, fovy = orbit_pose(0.4, 0.2, radius), 2 * np.arctan(np.tan(DEFAULT_FOVY / 2) * 2 * unit / radius)
    other = replace(
        in_unit(scene, unit),
        camera_world_to_camera=np.stack([pose] * 2),
        camera_intrinsics=np.stack([pinhole(fovy, *size)] * 2),
        size=size,
    )
    lens = pinhole(fovy, *size) * min(WIDTH / size[0], HEIGHT / size[1])
    lens[:, 2] = WIDTH / 2, HEIGHT / 2, 1
    write_page(other, tmp_path / "other.html", title="other")
    shown = show(tmp_path / "other.html", "time=0.5&controls=0", tmp_path)
    ours = Renderer(other).picture(Shot(0.5, pose, lens, (WIDTH, HEIGHT)), Look())
    difference = np.abs(ours.astype(int) - shown.pixels)
    assert (ours != ours[0, 0]).any(-1).mean() > 0.03 and difference.mean() < 0.5
    assert np.quantile(difference, 0.999) <= 12


@needs_browser
def test_a_page_opens_on_an_object_that_is_not_at_the_origin(scene, tmp_path):
    away = np.array([7.0, -2, 3])
    write_page(shifted(scene, away), tmp_path / "away.html", title="away")
    shown = show(tmp_path / "away.html", "time=0.5&controls=0", tmp_path)
    apart = shown.pixels.astype(int).min(-1) < 128
    row, column = np.nonzero(apart)
    assert apart.mean() > 0.05 and abs(column.mean() - WIDTH / 2) < 20 and abs(row.mean() - HEIGHT / 2) < 40
    assert min(row.min(), column.min()) > 5 and row.max() < HEIGHT - 5 and column.max() < WIDTH - 5


@needs_browser
def test_without_webgl_a_canvas_shows_the_same(scene, page, tmp_path):
    shown = show(page, "time=0.5&azimuth=-20&elevation=10&color=rigid&controls=0&renderer=2d", tmp_path)
    assert shown.state == "ready" and 'data-renderer="2d"' in shown.page
    difference = np.abs(_ours(scene, 0.5, -20, 10, color="rigid") - shown.pixels)
    assert difference.mean() < 2 and np.quantile(difference, 0.99) < 24  # colors of 5 bits, blobs of 32 pixels


@needs_browser
def test_a_damaged_page_says_so(page, tmp_path):
    text = page.read_text(encoding="utf-8")
    broken = tmp_path / "broken.html"
    broken.write_text(text.replace('"bytes": ', '"bytes": 1'), encoding="utf-8")
    shown = show(broken, "", tmp_path)
    assert shown.state == "error" and "the page is damaged" in shown.error


def test_the_page_needs_nothing_from_outside(page):
    text = page.read_text(encoding="utf-8")
    assert "default-src 'none'" in text and "<title>A &lt;toy&gt; &amp; more</title>" in text
    assert not re.search(r"https?://|src=|@import|<link", text)
    assert "<noscript>" in text  # as in a preview of a mail's attachment
    assert text.count("</script>") == 3  # what a command says can't end a script
    header = json.loads(re.search(r'id="header">(.*?)</script>', text, re.S)[1])
    assert header["history"][0]["command"].endswith("</script>") and header["metrics"] == {"psnr": 31.5}


def test_equal_scenes_give_equal_pages(scene, page, tmp_path):
    write_page(
        scene,
        tmp_path / "b.html",
        title="A <toy> & more",
        history=[{"command": "dpc generate4d fit </script>", "seed": 0}],
    )
    assert (tmp_path / "b.html").read_bytes() == page.read_bytes()


@pytest.mark.parametrize(("rate", "speed"), [(25, 1), (240, 0.25), (0.25, 4)])
def test_the_last_frame_is_shown_as_long_as_the_others(rate, speed, tmp_path):
    """`rate` of the header: seconds of the clip per second, as videos play it; `tail`: seconds of the clip after its last frame."""
    clip = replace(toy_scene(per_part=5, frames=8), time=np.arange(8) / rate)
    for fps, expected in ((None, speed), (50, 50 / rate)):
        write_page(clip, tmp_path / "a.html", title="toy", fps=fps)
        header = json.loads(
            re.search(r'id="header">(.*?)</script>', (tmp_path / "a.html").read_text(encoding="utf-8"), re.S)[1]
        )
        assert (header["rate"], header["tail"]) == pytest.approx((expected, 1 / rate))


def test_what_is_packed_is_the_scene_up_to_rounding(scene, page):
    """Unpacked as the page does: sums over frames, modulo the types."""
    flipped = replace(scene, frame_quaternion=scene.frame_quaternion * np.float32([1, -1, 1, -1, 1])[:, None, None])
    arrays = packed(flipped)
    low, extent = scene.frame_mean.min((0, 1)), np.ptp(scene.frame_mean, axis=(0, 1))
    change = arrays["position"].astype(np.uint16)
    steps = np.cumsum(change[0] + (change[1] << 8), axis=0, dtype=np.uint16).transpose(0, 2, 1)
    np.testing.assert_allclose(low + steps / 65535 * extent, scene.frame_mean, atol=float(extent.max()) / 65535)
    turns = np.cumsum(arrays["turn"], axis=0, dtype=np.uint8).view(np.int8).transpose(0, 2, 1) / 127
    np.testing.assert_allclose(turns, scene.frame_quaternion, atol=0.5 / 127 + 1e-6)
    weight = np.cumsum(arrays["weight"], axis=0, dtype=np.uint8) / 255
    np.testing.assert_allclose(weight, scene.rigid_weight, atol=0.5 / 255 + 1e-6)
    text = page.read_text(encoding="utf-8")
    data = zlib.decompress(base64.b64decode(re.search(r'id="data">(.*?)</script>', text, re.S)[1]))
    header = json.loads(re.search(r'id="header">(.*?)</script>', text, re.S)[1])
    assert len(data) == header["bytes"] == sum(values.nbytes for values in arrays.values())
    np.testing.assert_array_equal(_parts(np.frombuffer(data, np.uint8)[header["starts"]["part"] :]), scene.part)


def _parts(data: np.ndarray) -> np.ndarray:
    low, high = data.reshape(2, -1).astype(int)
    return low + 256 * high - 1


def test_hundreds_of_parts_are_told_apart():
    scene = toy_scene(per_part=400)
    many = replace(scene, part=np.arange(-1, scene.num_gaussians - 1, dtype=np.int16))
    np.testing.assert_array_equal(_parts(packed(many)["part"]), many.part)


@pytest.mark.parametrize("frames", [1, 2])
def test_a_still_scene_keeps_how_its_gaussians_are_turned(frames):
    arrays = packed(scene := toy_scene(per_part=20, frames=frames))
    turns = np.cumsum(arrays["turn"], axis=0, dtype=np.uint8).view(np.int8).transpose(0, 2, 1) / 127
    np.testing.assert_allclose(turns, scene.frame_quaternion, atol=0.5 / 127 + 1e-6)


def test_the_page_stays_small():
    """Noise, which nothing compresses: 16 bits a coordinate, a byte a quaternion's number, of 4 for 3 in base64."""
    rng = np.random.default_rng(0)
    scene = toy_scene(per_part=500, frames=8)
    turns = rng.normal(size=scene.frame_quaternion.shape)
    noise = replace(
        scene,
        frame_mean=rng.normal(size=scene.frame_mean.shape).astype(np.float32),
        frame_quaternion=(turns / np.linalg.norm(turns, axis=-1, keepdims=True)).astype(np.float32),
    )
    moving = sum(packed(noise)[key].nbytes for key in ("position", "turn", "weight"))
    assert moving == 8 * 1000 * 11  # 20,000 Gaussians over 32 frames: 9.4 MB in base64, at worst


def test_the_command(tmp_path):
    from typer.testing import CliRunner

    app = typer.Typer()
    app.command()(view)
    write_scene(tmp_path / "s.h5", toy_scene(per_part=20, frames=1), source="toy")
    words = [str(tmp_path / "s.h5"), "-o", str(tmp_path / "s.html"), "--min-opacity", "0.1"]
    assert CliRunner().invoke(app, words).exit_code == 0
    assert "<title>toy</title>" in (tmp_path / "s.html").read_text(encoding="utf-8")
    for name, says in (("s.html", "--force"), ("s.htmx", "ends in .html")):
        refused = CliRunner().invoke(app, [words[0], "-o", str(tmp_path / name)])
        assert isinstance(refused.exception, UsageError) and says in str(refused.exception)


@needs_browser
def test_keys_work_whatever_has_the_focus(page, tmp_path):
    """Space plays once and presses no button; sliders and menus keep their arrows, and Enter presses buttons."""
    script = """
    new MutationObserver((_, watch) => {
      if (root.dataset.state !== "ready" || root.dataset.told) return;
      watch.disconnect();
      const told = [];
      for (const where of ["#slider", "#speed", "#home", "#play", "#canvas"]) {
        app.change({ play: false, color: "appearance" });
        told.push(where, pressed(where, " "), app.state.play, pressed(where, "2"), app.state.color);
        const ground = app.state.background;
        told.push(pressed(where, "b"), app.state.background !== ground);
        told.push(pressed(where, "r"), pressed(where, "ArrowRight"), pressed(where, "Enter"));
      }
      root.dataset.told = told.join(" ");
    }).observe(root, { attributes: true });
    """
    opened = tmp_path / "opened.html"
    text = page.read_text(encoding="utf-8")
    opened.write_text(text.replace("</body>", f"<script>{PRESSED}{script}</script></body>"), encoding="utf-8")
    shown = show(opened, "play=0&controls=1&time=0", tmp_path)
    told = re.search(r'<html[^>]*data-told="([^"]*)"', shown.page)
    arrows = {"#slider": "false", "#speed": "false", "#home": "true", "#play": "true", "#canvas": "true"}
    right = [f"{where} true true true part true true true {own} false" for where, own in arrows.items()]
    assert told and told[1] == " ".join(right)
