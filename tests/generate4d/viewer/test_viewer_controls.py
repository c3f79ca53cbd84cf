"""The page in a reader's hands: a script in the page clicks, drags and presses keys, and reports what came of it."""

from __future__ import annotations

import html
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.generate4d.viewer import write_page
from dpcli.generate4d.viewer.input_sheet import input_sheet
from dpcli.runtime.provenance import file_digest
from dpcli.store.gaussians import write_scene
from dpcli.store.views import ViewsHeader, ViewsWriter
from tests.support.browser import needs_browser, open_page
from tests.support.commands import exit_code
from tests.support.scenes import in_unit, toy_scene

_FLAGS = "--use-angle=swiftshader --enable-unsafe-swiftshader --virtual-time-budget=8000 --window-size=640,480".split()
# A browser without a screen draws few frames by itself; the page's clock ticks all the same
_CLOCK = (
    "<head><script>window.requestAnimationFrame = (tick) => setTimeout(() => tick(performance.now()), 16);</script>"
)
_DRIVER = """
<script>
const pause = (ms) => new Promise((done) => setTimeout(done, ms));
const press = (key, more) =>
  document.activeElement.dispatchEvent(new KeyboardEvent("keydown", { ...more, key, bubbles: true, cancelable: true }));
const at = (x, y) => ({ pointerId: 1, clientX: x, clientY: y, buttons: 1, bubbles: true });
const point = (name, x, y) => $("canvas").dispatchEvent(new PointerEvent(name, at(x, y)));
HTMLElement.prototype.setPointerCapture = () => {};  // made-up pointers can't be captured
(async () => {
  while (root.dataset.state === "loading") await pause(20);
  let result;
  try { result = await (async () => { %s })(); } catch (error) { result = { error: String(error) }; }
  root.dataset.result = JSON.stringify(result);
})();
</script></body>"""


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    """A views file of two cameras and 5 frames, 60 x 40 pixels; the reference's frame t is gray of 40 t."""
    path = tmp_path_factory.mktemp("clip") / "clip.h5"
    pose = np.tile(np.eye(4), (2, 1, 1))
    pose[:, 2, 3] = 3
    lens = np.tile(np.array([[50.0, 0, 30], [0, 50, 20], [0, 0, 1]]), (2, 1, 1))
    header = ViewsHeader("toy", lens, pose, np.arange(5) / 10, ["train", "reference"], 1, (60, 40))
    with ViewsWriter(path, header, source="toy", provenance={}) as writer:
        for view in range(2):
            for frame in range(5):
                picture = np.full((40, 60, 4), 255, np.uint8)
                picture[..., :3] = 40 * frame if view else 255
                writer.add(view, frame, picture)
    return path


@pytest.fixture(scope="module")
def page(tmp_path_factory, clip) -> Path:
    path = tmp_path_factory.mktemp("page") / "toy.html"
    write_page(toy_scene(per_part=400, frames=5), path, title="toy scene", clip=clip)
    return path


def _run(page: Path, script: str, tmp_path: Path, state: str = "time=0.1") -> dict:
    """Returns what a script (the body of an async function) returns in the page at such an address."""
    driven = tmp_path / "driven.html"
    text = page.read_text(encoding="utf-8").replace("<head>", _CLOCK)
    driven.write_text(text.replace("</body>", _DRIVER % script), encoding="utf-8")
    shown, said = open_page(f"{driven.as_uri()}#{state}", tmp_path, *_FLAGS)
    found = re.search(r'<html[^>]*data-result="([^"]*)"', shown)
    assert found, said[-2000:]
    return json.loads(html.unescape(found[1]))


@needs_browser
def test_a_link_holds_the_view(page, tmp_path):
    moved = """app.change({ azimuth: 1, elevation: 0.3, radius: 2.5, target: [0.1, 0.2, -0.3], color: 'part', trails: true,
      bounce: true, background: 'black' });"""
    address = _run(page, moved + "press('l'); return { address: app.address, written: location.href };", tmp_path)
    assert address["address"] == address["written"]
    state = address["address"].partition("#")[2]
    seen = _run(page, "return app.state;", tmp_path, state)
    assert (seen["azimuth"], seen["elevation"], seen["radius"]) == pytest.approx((1, 0.3, 2.5), abs=1e-4)
    assert seen["target"] == [0.1, 0.2, -0.3] and seen["time"] == pytest.approx(0.1)
    assert (seen["color"], seen["background"], seen["trails"], seen["bounce"]) == ("part", "black", True, True)


@needs_browser
def test_a_link_holds_the_view_of_a_small_world_and_of_a_fast_clip(tmp_path):
    """In units of the scene, four digits after the point would be none: of a grain in meters, of 20,000 frames a second."""
    small = in_unit(replace(toy_scene(frames=5), time=np.arange(5) / 20_000), 1e-5)
    write_page(small, tmp_path / "small.html", title="small")
    script = """app.change({ radius: 1.2345e-5, target: [1.25e-6, 0, -2.5e-6], time: app.timeline.times[3] });
      const [x, y] = projected(app.scene.placeAt(0, 3), app.camera);
      const address = app.address, seen = app.scene.seenAt(x, y, app.camera, new Set());
      history.replaceState(null, "", address); app.change({ ...app.home(), time: 0 }); app.readAddress(); return { ...app.state, seen };"""
    state = _run(tmp_path / "small.html", script, tmp_path, "time=0")
    assert state["radius"] == pytest.approx(1.2345e-5, rel=1e-4) and state["seen"] is not None
    assert state["target"] == pytest.approx([1.25e-6, 0, -2.5e-6], abs=1e-9)
    assert state["time"] == pytest.approx(3 / 20_000, abs=1e-6)


@needs_browser
def test_a_double_click_sets_the_pivot_on_what_is_seen(page, tmp_path):
    script = """
      const { width, height } = $("canvas"), found = [];
      for (let i = 0; i < app.scene.count && found.length < 1; i++) {
        const place = Array.from(app.scene.mean.subarray(3 * i, 3 * i + 3)), pixel = projected(place, app.camera);
        if (app.scene.color[3 * app.scene.count + i] > 200) found.push([place, pixel]);
      }
      const [place, pixel] = found[0], options = { clientX: pixel[0], clientY: pixel[1] };
      $("canvas").dispatchEvent(new MouseEvent("dblclick", options));
      await pause(1500);
      const target = app.state.target;
      $("canvas").dispatchEvent(new MouseEvent("dblclick", { clientX: 2, clientY: 2 }));
      return { place, target, home: app.state.target, forward: app.camera.forward };"""
    seen = _run(page, script, tmp_path)
    offset = np.subtract(seen["target"], seen["place"])
    along = np.dot(offset, seen["forward"])
    assert np.linalg.norm(offset - along * np.array(seen["forward"])) < 0.1 and along < 1e-2  # on its ray, or before it
    assert np.linalg.norm(seen["target"]) > 1e-3 and seen["home"] == [0, 0, 0]


@needs_browser
def test_a_drag_coasts_and_turning_by_itself_goes_on(page, tmp_path):
    script = """
      const start = app.state.azimuth;
      point("pointerdown", 300, 200);
      for (let x = 300; x >= 290; x -= 2) { point("pointermove", x, 200); await pause(10); }
      const let_go = app.state.azimuth;
      point("pointerup", 290, 200);
      await pause(1000);
      const coasted = app.state.azimuth;
      await pause(200);
      const rest = app.state.azimuth;
      press("a");
      await pause(200);
      const turned = app.state.azimuth;
      press("a");  // or it would be drawn turning for the rest of the browser's time
      return { start, let_go, coasted, rest, turned };"""
    seen = _run(page, script, tmp_path, "time=0.1&play=0")
    assert seen["start"] < seen["let_go"] < seen["coasted"] < seen["turned"] and seen["coasted"] == seen["rest"]


@needs_browser
def test_keys_do_what_the_list_says(page, tmp_path):
    script = """
      const seen = {}, before = app.state.radius;
      $("canvas").dispatchEvent(new WheelEvent("wheel", { deltaY: -100 * Math.log(2), ctrlKey: true, cancelable: true }));
      seen.pinched = before / app.state.radius;
      for (const key of ["4", "t", "o", "p", "?"]) press(key);
      for (const key of ["ArrowRight", "ArrowUp", "ArrowUp"]) press(key, { shiftKey: true });
      Object.assign(seen, app.state);
      seen.panel = !$("panel").hidden;
      const contrast = (where) => getComputedStyle(document.querySelector(where)).forcedColorAdjust;
      seen.contrast = [contrast("#ramp"), contrast('[data-color="depth"]')];
      seen.keys = Array.from($("panel").querySelectorAll("th"), (cell) => cell.textContent);
      await pause(200);
      const { width, height } = $("trails"), lines = $("trails").getContext("2d").getImageData(0, 0, width, height).data;
      seen.trails = !$("trails").hidden && lines.some((value) => value);
      let saved = null;
      HTMLAnchorElement.prototype.click = function () { saved = [this.download, this.href]; };
      press("s");
      for (let wait = 0; wait < 50 && !saved; wait++) await pause(50);
      return { ...seen, saved };"""
    seen = _run(page, script, tmp_path, "time=0.1&play=0&azimuth=0&elevation=0")
    assert np.rad2deg([seen["azimuth"], seen["elevation"]]) == pytest.approx([5, 10]) and seen["time"] == 0.1
    assert seen["pinched"] == pytest.approx(2)  # a pinch of a trackpad to twice the size
    assert seen["contrast"] == ["none", "none"]  # else high contrast takes their colors away
    assert (seen["color"], seen["bounce"], seen["input"], seen["panel"], seen["trails"]) == (
        "depth",
        True,
        False,
        True,
        True,
    )
    assert {"space", "f", "l", "s", "double click, double tap"} <= set(seen["keys"])
    assert seen["saved"][0] == "toy_scene.png" and seen["saved"][1].startswith("blob:")


@needs_browser
def test_the_panel_closes_without_keys(page, tmp_path):
    """On a phone, which has none, the panel covers the button that opened it; on its side, buttons leave room for the scene."""
    script = """
      const low = $("look").getBoundingClientRect().bottom;
      $("about").click();
      const close = $("panel").querySelector("button"), { x, y, width, height } = close.getBoundingClientRect();
      const found = [$("panel").hidden, document.elementFromPoint(x + width / 2, y + height / 2) === close];
      close.click();
      return [...found, $("panel").hidden, low];"""
    *found, low = _run(page, script, tmp_path)
    assert found == [False, True, True] and low < 80


@needs_browser
def test_back_and_forth_turns_at_both_ends(page, tmp_path):
    script = """const line = new Timeline([0, 1, 2], 1, 1), moves = [[1.5, 1, 1], [0.5, 1, -1], [1, 0.25, 1], [1, 100, 1]];
      return moves.map((move) => line.bounced(...move));"""
    assert _run(page, script, tmp_path) == [[1.5, -1], [0.5, 1], [1.25, 1], [0, -1]]


@needs_browser
def test_the_input_picture_is_that_of_the_frame(page, tmp_path):
    script = """
      const gray = [];
      for (let frame = 0; frame < 5; frame++) {
        app.change({ time: app.timeline.times[frame], play: false });
        await pause(200);
        gray.push($("input").getContext("2d").getImageData(30, 20, 1, 1).data[0]);
      }
      return { gray, clock: $("clock").textContent, size: [$("input").width, $("input").height] };"""
    seen = _run(page, script, tmp_path)
    assert seen["gray"] == pytest.approx([0, 40, 80, 120, 160], abs=3)
    assert seen["size"] == [60, 40] and seen["clock"].startswith("5 / 5")


@needs_browser
def test_a_lost_context_is_said_and_rebuilt(page, tmp_path):
    script = """
      const pixel = () => { app.draw(); const out = new Uint8Array(4 * 640 * 480), { gl } = app.painter;
        gl.readPixels(0, 0, 640, 480, gl.RGBA, gl.UNSIGNED_BYTE, out); return out.filter((value) => value !== 255).length; };
      const before = pixel(), lose = app.painter.gl.getExtension("WEBGL_lose_context");
      lose.loseContext();
      await pause(300);
      const said = $("error").hidden ? "" : $("error").textContent;
      lose.restoreContext();
      await pause(500);
      return { before, said, after: pixel(), hidden: $("error").hidden, state: root.dataset.state };"""
    seen = _run(page, script, tmp_path, "time=0.1&play=0")
    assert "graphics" in seen["said"] and seen["hidden"] and seen["state"] == "ready"
    assert seen["before"] > 1000 and seen["after"] == seen["before"]


def test_a_clip_of_another_length_is_refused(clip):
    with pytest.raises(DataError, match="5 frames, but the scene has 3"):
        input_sheet(clip, toy_scene(per_part=5, frames=3))


def test_pictures_of_another_clip_are_told(clip, tmp_path, capsys):
    """Two clips of as many frames: the scene's provenance knows which of them was fitted."""
    scene, made = toy_scene(per_part=5, frames=5), {"inputs": {"views": file_digest(clip)}}
    for name, entry, told in (
        ("own", made, False),
        ("other", {"inputs": {"views": "0" * 64}}, True),
        ("edited", {}, False),
    ):
        write_scene(tmp_path / f"{name}.h5", scene, provenance=[entry])
        words = (tmp_path / f"{name}.h5", "-o", tmp_path / f"{name}.html", "--input", clip)
        assert exit_code("generate4d", "view", *words) == 0
        assert ("another file than the one that was fitted" in " ".join(capsys.readouterr().err.split())) == told
