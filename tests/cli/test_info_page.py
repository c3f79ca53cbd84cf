"""`dpc info FILE --page`: the page holds what the file holds, and a real browser shows it; nothing in a file can run."""

from __future__ import annotations

import base64
import io
import json
import re
import zlib
from dataclasses import dataclass
from html import unescape
from pathlib import Path

import numpy as np
import pytest

from dpcli.draw.page import points as points_module
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter, ScoresWriter, ViewsWriter
from dpcli.store.embedding import StreamEmbedding, write_embedding
from dpcli.store.gaussians import write_scene
from dpcli.store.views import ViewsHeader
from tests.support.browser import PRESSED, needs_browser, open_page
from tests.support.scenes import toy_scene

WIDTH, HEIGHT = 900, 640
FLAGS = (
    "--use-angle=swiftshader --enable-unsafe-swiftshader --virtual-time-budget=6000 --run-all-compositor-stages-before-draw"
).split()
HOSTILE = "</script><img src=x onerror=\"document.documentElement.dataset.ran='yes'\">"
BLUE, ORANGE, GREEN = np.array([0, 114, 178]), np.array([230, 159, 0]), np.array([0, 158, 115])  # parts 0, 1, 2


@dataclass
class Shown:
    """What a browser made of a page: its final HTML and a screenshot, u8 (H,W,3)."""

    html: str
    pixels: np.ndarray

    def attribute(self, name: str) -> str | None:
        found = re.search(rf'<html[^>]* data-{name}="([^"]*)"', self.html)
        return None if found is None else unescape(found[1])


WHEN_READY = """
const whenReady = (act) => new MutationObserver((_, watch) => {
  if (root.dataset.state === "ready" && !whenReady.done) { whenReady.done = true; watch.disconnect(); act(); }
}).observe(root, { attributes: true });
"""


def show(
    page: Path, tmp_path: Path, state: str = "", script: str = "", flags: tuple[str, ...] = (), wanted: str = "state"
) -> Shown:
    """The page in a browser, with a script of the test's added at its end, which may call `whenReady` with what it wants to do.

    Another browser is asked, at most twice, where the page was not drawn in time, or did not get the wanted attribute.
    """
    from PIL import Image

    opened, picture = tmp_path / "opened.html", tmp_path / "opened.png"
    text = page.read_text(encoding="utf-8")
    opened.write_text(text.replace("</body>", f"<script>{WHEN_READY}{script}</script></body>"), encoding="utf-8")
    size = f"--window-size={WIDTH},{HEIGHT}"
    for _ in range(3):
        html, said = open_page(f"{opened.as_uri()}#{state}", tmp_path, *FLAGS, size, f"--screenshot={picture}", *flags)
        assert picture.is_file(), said[-2000:]
        shown = Shown(html, np.asarray(Image.open(picture).convert("RGB")))
        if shown.attribute("state") == "error" or (shown.attribute("state") == "ready" and shown.attribute(wanted)):
            break
    assert shown.attribute("state") == "ready", (re.findall(r'id="error"[^>]*>([^<]*)', html), said[-2000:])
    return shown


def header_of(page: Path) -> dict:
    return json.loads(re.search(r'id="header">(.*?)</script>', page.read_text(encoding="utf-8"), re.S)[1])


def block_of(page: Path, at: int) -> bytes:
    found = re.search(rf'id="data{at}">(.*?)</script>', page.read_text(encoding="utf-8"), re.S)
    return zlib.decompress(base64.b64decode(found[1]))


def ball(center: tuple[float, float, float], count: int = 400) -> np.ndarray:
    """Points f32 (N,3) on a ball of radius 0.25, the same at every call."""
    ways = np.random.default_rng(3).normal(size=(count, 3))
    return (np.array(center) + 0.25 * ways / np.linalg.norm(ways, axis=1, keepdims=True)).astype(np.float32)


def write_balls(path: Path, name: str = "balls") -> Path:
    """Part 0 left and part 1 right, part 2 above them (camera axes: y down); in frame 1 left and right are exchanged."""
    left, right, top = ball((-1, 0, 0)), ball((1, 0, 0)), ball((0, -1, 0))
    frames = [np.concatenate([left, right, top]), np.concatenate([right, left, top])]
    part = [np.repeat(np.arange(3, dtype=np.int16), 400)] * 2
    color = [np.tile(np.array([[200, 30, 30]], np.uint8), (1200, 1))] * 2
    fields = {"part": part, "color": color, "time": np.array([0.0, 0.5])}
    with CloudsWriter(path, class_names=[name, "wave"], fields=tuple(fields), length_unit="m") as writer:
        writer.write(CloudSequence.from_frames(name, frames, label=0, **fields))
        writer.write(CloudSequence.from_frames("second", frames[::-1], label=1, **fields))
    return path


def near(pixels: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Where the pixels have a color's hue, bool (H,W): shading scales it, haze adds some white."""
    own = pixels.astype(float) - pixels.min(-1, keepdims=True)
    wanted = color - color.min()
    strong = np.linalg.norm(own, axis=-1) > 60
    return strong & ((own @ wanted) > 0.985 * np.linalg.norm(own, axis=-1) * np.linalg.norm(wanted))


def places(shown: Shown) -> list[tuple[float, float]]:
    """Mean (row, column) of the pixels of parts 0, 1, 2 on a page without controls."""
    found = []
    for color in (BLUE, ORANGE, GREEN):
        where = np.argwhere(near(shown.pixels, color))
        assert len(where) > 500, color
        found.append(tuple(where.mean(0)))
    return found


@pytest.fixture
def balls(tmp_path: Path, dpc_here) -> Path:
    made = dpc_here("info", write_balls(tmp_path / "balls.h5"), "--page", tmp_path / "balls.html")
    assert made.returncode == 0, made.stderr
    return tmp_path / "balls.html"


# What is in the page.


def test_the_page_holds_the_points_parts_and_colors_of_the_file(balls, tmp_path):
    header = header_of(balls)
    with CloudsReader(tmp_path / "balls.h5") as reader:
        for at, about in enumerate(header["sequences"]):
            sequence, block = reader.read(at), block_of(balls, at)
            count = len(sequence.points)
            planes = np.frombuffer(block, np.uint8).reshape(-1, count)
            steps = planes[0:6:2].astype(int) + (planes[1:6:2].astype(int) << 8)
            said = np.array(about["low"])[:, None] + np.array(about["step"])[:, None] * steps
            upright = sequence.points * [1, -1, -1]  # camera axes: y down, z away
            np.testing.assert_allclose(said.T, upright, atol=float(np.ptp(upright)) / 65535)
            np.testing.assert_array_equal([about["parts"][k]["id"] for k in planes[6]], sequence.part)
            np.testing.assert_array_equal(planes[7:10].reshape(-1, 3), sequence.color)
            assert about["counts"] == [1200, 1200] and about["time"] == [0.0, 0.5] and about["rate"] == 2.0
    assert header["looks"] == ["part", "color", "height", "time", "label"] and header["unit"] == "m"


def test_the_page_needs_nothing_from_outside_and_repeats_byte_for_byte(balls, tmp_path, dpc_here):
    text = balls.read_text(encoding="utf-8")
    assert "default-src 'none'" in text and not re.search(r"https?://|\bsrc=[\"'](?!data:)|@import|<link", text)
    assert dpc_here("info", tmp_path / "balls.h5", "--page", tmp_path / "again.html").returncode == 0
    assert (tmp_path / "again.html").read_bytes() == balls.read_bytes()


def test_only_the_shown_frames_are_read_one_at_a_time(tmp_path, dpc_here, monkeypatch):
    frames = [np.random.default_rng(t).normal(size=(50 + t, 3)).astype(np.float32) for t in range(40)]
    with CloudsWriter(tmp_path / "long.h5") as writer:
        for name in "abcd":
            writer.write(CloudSequence.from_frames(name, frames))
    monkeypatch.setattr(points_module, "MOST_FRAMES", 20)
    monkeypatch.setattr(points_module, "_FEWEST_FRAMES", 5)
    monkeypatch.setattr(points_module, "MOST_POINTS", 200)
    monkeypatch.setattr(points_module, "_FEWEST_POINTS", 8)
    asked, read = [], CloudsReader.read

    def noted(self: CloudsReader, row: int, frames: list[int], *more: object) -> CloudSequence:
        asked.append((row, frames))
        return read(self, row, frames, *more)

    monkeypatch.setattr(CloudsReader, "read", noted)
    result = dpc_here("info", tmp_path / "long.h5", "--page", tmp_path / "long.html", "--samples", 2)
    assert result.returncode == 0, result.stderr
    assert len(asked) == 20 and all(len(frames) == 1 for _, frames in asked)
    header = header_of(tmp_path / "long.html")
    assert header["sequences"][0]["frames"] == [0, 4, 9, 13, 17, 22, 26, 30, 35, 39]
    assert set(header["sequences"][0]["counts"]) == {10}  # 200 points on 20 frames
    said = result.stderr.decode()
    for sentence in (
        "Showing 2 of 4 sequences",
        "Showing 10 of up to 40 frames",
        "Showing 10 of up to 89 points a frame.",
    ):
        assert sentence in said and any(sentence in note for note in header["notes"])


def test_a_sequence_is_chosen_by_name_or_number(tmp_path, dpc_here):
    source = write_balls(tmp_path / "balls.h5")
    for word, name in (("second", "second"), ("1", "second"), ("0", "balls")):
        assert dpc_here("info", source, "--page", tmp_path / "one.html", "--sequence", word).returncode == 0
        assert [own["title"].split(" · ")[0] for own in header_of(tmp_path / "one.html")["sequences"]] == [name]
    for words, sentence in (
        (("--page", tmp_path / "x.html", "--sequence", "secnd"), b"such as 'second', or a number from 0 to 1"),
        (("--page", tmp_path / "x.html", "--sequence", "2"), b"no such sequence"),
        (("--sequence", "second"), b"give --page FILE.html, too"),
        (("--samples", "3"), b"--samples is of what --picture or --page shows"),
        (("--view", "xyz"), b"--view is of what --picture or --page shows"),
        (("--page", tmp_path / "x.html", "--frames", "3"), b"--frames chooses the columns of --picture"),
    ):
        refused = dpc_here("info", source, *words)
        assert refused.returncode == 2 and sentence in refused.stderr
    assert not (tmp_path / "x.html").exists()


def test_where_a_page_may_be_written(tmp_path, dpc_here, monkeypatch):
    source = write_balls(tmp_path / "balls.html")  # an input with a page's name
    before = source.read_bytes()
    for page, code, sentence in (
        (source, 2, b"is an input, too"),
        (tmp_path / "page.txt", 2, b"expected .html, .htm"),
        (tmp_path / "none" / "page.html", 3, b"does not exist; create it first"),
    ):
        refused = dpc_here("info", source, "--page", page)
        assert refused.returncode == code and sentence in refused.stderr
    assert source.read_bytes() == before and [one.name for one in tmp_path.iterdir()] == ["balls.html"]
    monkeypatch.setattr(
        Path, "write_bytes", lambda self, data: (_ for _ in ()).throw(OSError(28, "No space left on device"))
    )
    full = dpc_here("info", source, "--page", tmp_path / "page.html")
    assert full.returncode == 1 and b"no space left" in full.stderr
    assert [one.name for one in tmp_path.iterdir()] == ["balls.html"]


def test_a_model_has_no_page(tmp_path, dpc_here):
    refused = dpc_here("info", "msraction3d-16", "--page", tmp_path / "m.html")
    assert refused.returncode == 2 and b"--page shows data files" in refused.stderr


def test_many_parts_become_those_with_the_most_points(tmp_path, dpc_here):
    """A byte tells 254 parts; the points of the others are grey."""
    part = np.concatenate([np.arange(300), np.arange(20, 300)]).astype(np.int16)
    points = np.random.default_rng(0).normal(size=(len(part), 3)).astype(np.float32)
    with CloudsWriter(tmp_path / "p.h5", fields=("part",)) as writer:
        writer.write(CloudSequence.from_frames("p", [points], part=[part]))
    assert dpc_here("info", tmp_path / "p.h5", "--page", tmp_path / "p.html").returncode == 0
    (about,) = header_of(tmp_path / "p.html")["sequences"]
    listed = [one["id"] for one in about["parts"]]
    said = np.array(listed)[np.frombuffer(block_of(tmp_path / "p.html", 0), np.uint8)[6 * len(part) :]]
    assert len(listed) == 255 and set(range(20)).isdisjoint(listed)
    np.testing.assert_array_equal(said, np.where(np.isin(part, listed), part, -1))


# What a browser shows.


@needs_browser
@pytest.mark.parametrize("renderer", ["", "&renderer=2d"])
def test_the_browser_shows_parts_where_they_are(balls, tmp_path, renderer):
    """From the front, x is right and the camera's -y is up; one frame later the two parts below have changed places."""
    state = f"controls=0&play=0&theme=light&azimuth=0&elevation=0{renderer}"
    blue, orange, green = places(show(balls, tmp_path, f"{state}&frame=0"))
    assert blue[1] < green[1] < orange[1] and green[0] < min(blue[0], orange[0]) - 100
    blue, orange, green = places(show(balls, tmp_path, f"{state}&frame=1"))
    assert orange[1] < green[1] < blue[1]
    red = show(balls, tmp_path, f"{state}&color=color")
    assert near(red.pixels, np.array([200, 30, 30])).sum() > 2000 and near(red.pixels, GREEN).sum() < 50


@needs_browser
def test_a_lost_context_is_built_again(balls, tmp_path):
    lose = (
        "whenReady(() => { const lost = page.painter.gl.getExtension('WEBGL_lose_context'); lost.loseContext(); %s"
        " root.dataset.lost = 'yes'; });"
    )
    state = "controls=0&play=0&theme=light&azimuth=0&elevation=0&frame=0"
    blue, orange, _ = places(
        show(balls, tmp_path, state, lose % "setTimeout(() => lost.restoreContext(), 300);", (), "lost")
    )
    assert blue[1] < orange[1]
    gone = show(balls, tmp_path, state, lose % "", (), "lost")
    assert near(gone.pixels, BLUE).sum() < 50  # the loss is real: without the restoring nothing is left


@needs_browser
def test_keys(balls, tmp_path):
    """Space plays and stops, arrows step, digits color, brackets choose, ? explains, b changes the theme."""
    script = """
    const press = (key) => document.body.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
    const told = [], tell = () => {
      const { frameNumber, state, at } = page;
      told.push([frameNumber, state.play, state.color, at, !$("about").hidden, root.hasAttribute("data-dark")].join());
    };
    whenReady(async () => {
      press("ArrowRight"); tell(); press("ArrowLeft"); tell(); press(" "); tell(); press(" "); tell(); press("3"); tell();
      press("]"); await new Promise((done) => setTimeout(done, 300)); tell(); press("?"); tell(); press("Escape"); press("b"); tell();
      const before = page.state.radius; press("+"); root.dataset.zoom = page.state.radius < before; root.dataset.told = told.join(" ");
    });"""
    shown = show(balls, tmp_path, "play=0&frame=0&theme=light", script, wanted="told")
    assert shown.attribute("told").split() == [
        "1,false,part,0,false,false",
        "0,false,part,0,false,false",
        "0,true,part,0,false,false",
        "0,false,part,0,false,false",
        "0,false,height,0,false,false",
        "0,false,height,1,false,false",
        "0,false,height,1,true,false",
        "0,false,height,1,false,true",
    ]
    assert shown.attribute("zoom") == "true"


@needs_browser
def test_keys_work_whatever_has_the_focus(balls, tmp_path):
    """Space plays once and presses no button; sliders and menus keep their arrows, and Enter presses buttons."""
    script = """
    whenReady(() => {
      const told = [];
      for (const where of ["#slider", "#speed", "#home", "#play", "#look button"]) {
        page.change({ play: false, color: "part" });
        told.push(where, pressed(where, " "), page.state.play, pressed(where, "3"), page.state.color);
        told.push(pressed(where, "ArrowRight"), pressed(where, "Enter"));
      }
      root.dataset.told = told.join(" ");
    });"""
    shown = show(balls, tmp_path, "play=0&frame=0&theme=light", PRESSED + script, wanted="told")
    arrows = {"#slider": "false", "#speed": "false", "#home": "true", "#play": "true", "#look button": "true"}
    right = [f"{where} true true true height {own} false" for where, own in arrows.items()]
    assert shown.attribute("told") == " ".join(right)


@needs_browser
def test_dragging_turns_and_a_part_can_be_hidden(balls, tmp_path):
    script = """
    const at = (x) => ({ pointerId: 1, clientX: x, clientY: 300, bubbles: true });
    const point = (kind, x) => $("canvas").dispatchEvent(new PointerEvent(kind, at(x)));
    $("canvas").setPointerCapture = () => {};
    whenReady(() => {
      const before = page.state.azimuth; point("pointerdown", 300); point("pointermove", 400); point("pointerup", 400);
      root.dataset.turned = page.state.azimuth - before;
      document.querySelectorAll("#legend button")[1].click();
    });"""
    shown = show(
        balls, tmp_path, "play=0&frame=0&theme=light&controls=0&azimuth=0&elevation=0", script, wanted="turned"
    )
    assert float(shown.attribute("turned")) == pytest.approx(-0.8)
    blue, orange = (near(shown.pixels, color).sum() for color in (BLUE, ORANGE))
    assert blue > 500 and orange < 50  # a few pixels of the axis x are reddish, too


@needs_browser
@pytest.mark.parametrize("kind", ["clouds", "scores"])
def test_what_a_file_says_is_never_run(kind, tmp_path, dpc_here):
    source = tmp_path / "<img src=x onerror=\"document.documentElement.dataset.ran='yes'\">.h5"
    if kind == "clouds":
        write_balls(source, HOSTILE)
    else:
        with ScoresWriter(source, class_names=["a", HOSTILE]) as writer:
            writer.write(HOSTILE, np.array([0.1, 0.9]), label=1, split=HOSTILE)
    assert dpc_here("info", source, "--page", tmp_path / "h.html").returncode == 0
    shown = show(tmp_path / "h.html", tmp_path)
    assert shown.attribute("ran") is None and "<img" not in re.sub(
        r"<(script|style|title)\b.*?</\1>", "", shown.html, flags=re.S
    )
    assert source.name in unescape(re.search(r'<h1 id="title">(.*?)</h1>', shown.html)[1])
    assert HOSTILE in unescape(re.search(r"<(select id=\"sequence\"|tbody).*?</(select|tbody)>", shown.html, re.S)[0])


@needs_browser
def test_on_a_phone_nothing_lies_over_the_points(balls, tmp_path):
    """In a frame as wide as a phone: the picture, the legend and the bar are apart, and nothing reaches beyond the side."""
    inside = balls.with_name("inside.html")
    script = (
        f"<script>{WHEN_READY}"
        + """whenReady(() => {
      const box = (id) => { const { left, top, right, bottom } = $(id).getBoundingClientRect(); return [left, top, right, bottom]; };
      parent.postMessage(JSON.stringify([["head", "canvas", "legend", "bar"].map(box), document.documentElement.scrollWidth]), "*");
    });</script></body>"""
    )
    inside.write_text(balls.read_text(encoding="utf-8").replace("</body>", script), encoding="utf-8")
    outer = balls.with_name("outer.html")
    outer.write_text(
        '<html data-state="loading"><body><iframe src="inside.html" width="390" height="800"></iframe><script>onmessage = (event) => {'
        " document.documentElement.dataset.told = event.data; document.documentElement.dataset.state = 'ready'; };</script></body></html>"
    )
    for _ in range(3):
        html, said = open_page(outer.as_uri(), tmp_path, *FLAGS, f"--window-size={WIDTH},900")
        found = re.search(r'data-told="([^"]*)"', html)
        if found:
            break
    assert found, said[-2000:]
    boxes, wide = json.loads(unescape(found[1]))
    assert wide <= 390 and all(left >= 0 and right <= 390 for left, _, right, _ in boxes)
    for above, below in zip(boxes, boxes[1:]):
        assert above[3] <= below[1]
    canvas = boxes[1]
    assert (canvas[3] - canvas[1]) > 380  # most of the 800 pixels


@needs_browser
def test_light_and_dark_follow_the_system(balls, tmp_path):
    light, dark = (
        show(balls, tmp_path, "play=0", flags=(f"--blink-settings=preferredColorScheme={k}",)) for k in (1, 0)
    )
    assert light.pixels[5, 5].min() > 200 and dark.pixels[5, 5].max() < 60


# Other kinds.


def write_views(path: Path) -> np.ndarray:
    """Two cameras, three frames of one color each, u8 (2,3,4)."""
    colors = np.array([[[230, 20, 20, 255], [20, 200, 20, 255], [20, 20, 230, 255]]] * 2, np.uint8)
    colors[1] = colors[1, ::-1]
    lens, pose = np.tile([[40.0, 0, 16], [0, 40, 16], [0, 0, 1]], (2, 1, 1)), np.tile(np.eye(4), (2, 1, 1))
    pose[:, 2, 3] = 2
    header = ViewsHeader("toy", lens, pose, np.arange(3) / 10, ["reference", "test"], 0, (32, 32))
    with ViewsWriter(path, header) as writer:
        for view in range(2):
            for frame in range(3):
                writer.add(view, frame, np.tile(colors[view, frame], (32, 32, 1)))
    return colors


def test_a_page_of_views_holds_the_pictures(tmp_path, dpc_here):
    from PIL import Image

    colors = write_views(tmp_path / "v.h5")
    assert dpc_here("info", tmp_path / "v.h5", "--page", tmp_path / "v.html").returncode == 0
    header = header_of(tmp_path / "v.html")
    assert header["frames"] == [0, 1, 2] and header["rate"] == pytest.approx(10)
    text = (tmp_path / "v.html").read_text(encoding="utf-8")
    for view in range(2):
        strip = re.search(rf'id="view{view}" hidden>(.*?)</div>', text)[1]
        for frame, source in enumerate(re.findall(r'src="([^"]*)"', strip)):
            picture = Image.open(io.BytesIO(base64.b64decode(source.partition(",")[2])))
            assert picture.size == (32, 32)
            assert np.abs(np.asarray(picture.convert("RGBA")).astype(int) - colors[view, frame]).max() < 12
    refused = dpc_here("info", tmp_path / "v.h5", "--page", tmp_path / "w.html", "--sequence", "0")
    assert refused.returncode == 2 and b"--sequence is of point clouds" in refused.stderr


@needs_browser
def test_the_film_shows_one_frame_of_all_cameras(tmp_path, dpc_here):
    colors = write_views(tmp_path / "v.h5")
    assert dpc_here("info", tmp_path / "v.h5", "--page", tmp_path / "v.html").returncode == 0
    script = """
    const seen = () => [...document.querySelectorAll("canvas")]
      .map((canvas) => [...canvas.getContext("2d").getImageData(9, 9, 1, 1).data].join()).join(";");
    whenReady(() => {
      const before = seen();
      document.body.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight", bubbles: true }));
      setInterval(() => { if (seen() !== before) root.dataset.seen = seen(); }, 100);
    });"""
    shown = show(tmp_path / "v.html", tmp_path, "frame=1", script, wanted="seen")
    seen = [[int(value) for value in own.split(",")] for own in shown.attribute("seen").split(";")]
    assert np.abs(np.array(seen) - colors[:, 2]).max() < 12
    assert len(re.findall("<button[^>]* data-now", shown.html)) == 2 and "frame 2 / 2 · 0.20 s" in shown.html


@needs_browser
def test_the_table_of_scores_sorts_and_shows_mistakes(tmp_path, dpc_here):
    rng = np.random.default_rng(1)
    scores, labels = rng.dirichlet(np.ones(3), 30).astype(np.float32), rng.integers(-1, 3, 30)
    with ScoresWriter(tmp_path / "s.h5", class_names=["up", "down", "left"], streams=["static"]) as writer:
        for at, (own, label) in enumerate(zip(scores, labels)):
            writer.write(f"video {at}", own, label=int(label), streams={"static": own[::-1]})
    assert dpc_here("info", tmp_path / "s.h5", "--page", tmp_path / "s.html").returncode == 0
    shown = show(tmp_path / "s.html", tmp_path, "sort=probability&down=1&which=wrong")
    body = re.search(r"<tbody.*?</tbody>", shown.html, re.S)[0]
    names = re.findall(r"<td>video (\d+)</td>", body)
    wrong = [
        at for at in np.argsort(-scores.max(1), kind="stable") if labels[at] >= 0 and scores[at].argmax() != labels[at]
    ]
    assert [int(name) for name in names] == wrong
    right, known = int((scores.argmax(1) == labels).sum()), int((labels >= 0).sum())
    assert f"{right} of {known} right" in shown.html and f"{100 * right / known:.1f} %" in shown.html
    flipped = int((scores[:, ::-1].argmax(1) == labels).sum())
    assert f"static: {flipped} of {known} right" in shown.html
    assert f"{len(wrong)} samples of 30" in shown.html


def test_scores_that_are_no_probabilities_are_called_scores(tmp_path, dpc_here):
    with ScoresWriter(tmp_path / "s.h5", class_names=["a", "b"]) as writer:
        writer.write("one", np.array([-3.0, 7.5]))
    assert dpc_here("info", tmp_path / "s.h5", "--page", tmp_path / "s.html").returncode == 0
    header = header_of(tmp_path / "s.html")
    assert not header["probabilities"] and header["rows"][0]["best"] == [[1, 7.5], [0, -3.0]]


@needs_browser
def test_an_embedding_is_a_scatter(tmp_path, dpc_here):
    labels = np.repeat([0, 1, 14], [40, 40, 1])  # the colors begin anew at 14, with another shape
    spots = np.array([[-5, -5], [5, 5], [5, -5]])[np.repeat([0, 1, 2], [40, 40, 1])].astype(np.float32)
    spots[:80] += np.random.default_rng(0).normal(size=(80, 2))
    names, classes = [f"v{at}" for at in range(81)], ["low", "high", *map(str, range(2, 15))]
    stream = StreamEmbedding(spots, spots, {"accuracy": 0.9})
    write_embedding(tmp_path / "e.h5", names, labels, ["test"] * 81, {"static": stream}, class_names=classes)
    assert dpc_here("info", tmp_path / "e.h5", "--page", tmp_path / "e.html").returncode == 0
    assert [one["shape"] for one in header_of(tmp_path / "e.html")["classes"]] == ["circle", "circle", "square"]
    shown = show(tmp_path / "e.html", tmp_path, "theme=light")
    pixels = np.argwhere(near(shown.pixels[:, :640], BLUE))
    alone = pixels[:, 1] > pixels[:, 1].mean() + 100
    assert np.prod(np.ptp(pixels[alone], axis=0) + 1) == alone.sum()  # a square has corners
    blue, orange = pixels[~alone].mean(0), np.argwhere(near(shown.pixels[:, :640], ORANGE)).mean(0)
    assert blue[0] > orange[0] + 100 and blue[1] < orange[1] - 100  # low: left and at the bottom
    assert "accuracy 0.9" in shown.html


def test_a_scene_gets_the_viewer(tmp_path, dpc_here):
    write_scene(tmp_path / "scene.h5", toy_scene(per_part=20, frames=2), source="toy")
    assert dpc_here("info", tmp_path / "scene.h5", "--page", tmp_path / "scene.html").returncode == 0
    assert (
        "<title>scene.h5</title>" in (tmp_path / "scene.html").read_text()
        and header_of(tmp_path / "scene.html")["count"] == 40
    )
