"""The page of a stream in a browser: it draws without an error and tells what was said at a frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dpcli.classify.confidence import Confidence
from dpcli.classify.segments.live_page import LivePage, Thinned
from dpcli.classify.segments.recording import Cutting
from dpcli.classify.stream.sliding_window import Prediction
from tests.support.browser import needs_browser, open_page

SURE, UNSURE = (0.9, 0.1), (0.5, 0.5)


def write(path, frames: int = 40, names: tuple[str, ...] = ("wave </script>", "bow"), least=0.7, rows=(SURE, UNSURE)):
    how = Cutting(8, 2, 4, Confidence(1.0, least))
    page, rng = LivePage(path, "stdin", names, how, "dpc classify predict -"), np.random.default_rng(0)
    for frame in range(frames):
        page.see(rng.normal(size=(0 if frame == 5 else 1 + frame % 40, 3)).astype(np.float32), 0.0)
        if frame >= 7 and frame % 2:
            row = np.array([rows[int(frame >= 20)]], np.float32)
            page.write(Prediction(frame, 1, row, row), 3.0 if frame == 18_003 else 0.02, 0)
    page.finish(np.array(rows[1:]), frames, 10, "end of stream")


def drawn(address: str, folder: Path, *options: str) -> tuple[str, str]:
    """Returns a page that has drawn, and what it says at its frame."""
    for budget in (4000, 16_000, 64_000):  # on a busy machine the time of a page may be over before it has drawn
        html, _ = open_page(address, folder, f"--virtual-time-budget={budget}", *options)
        said = html.split('id="said"')[1].split("</div>")[0]
        if not said.endswith(">"):
            break
    return html, said


@needs_browser
@pytest.mark.parametrize(
    "frame, told", [(12, "wave &lt;/script&gt; 0.90"), (38, "nothing happening"), (3, "not full yet")]
)
def test_the_page_tells_what_was_said_at_a_frame(tmp_path, frame, told):
    write(tmp_path / "live.html")
    address = f"file://{tmp_path / 'live.html'}#frame={frame}&play=0&renderer=2d"
    html, said = drawn(address, tmp_path)
    assert told in said and 'id="error" class="card" role="alert" hidden' in html


@needs_browser
def test_the_page_names_the_best_class_though_others_are_near_to_it_and_to_the_threshold(tmp_path):
    near = (0.3301, 0.3349, 0.3350)  # 84.2, 85.4 and 85.4 of 255; the threshold is 84.2 of it
    write(tmp_path / "live.html", names=("wave", "bow", "run"), least=0.33, rows=(near, (0.3299, 0.3301, 0.33)))
    for frame, told in ((12, "run 0.3"), (38, "bow 0.33")):
        assert told in drawn(f"file://{tmp_path / 'live.html'}#frame={frame}&play=0&renderer=2d", tmp_path)[1]


@needs_browser
@pytest.mark.parametrize(("width", "height"), [(500, 800), (900, 400)], ids=["phone", "on its side"])
def test_what_is_said_lies_under_no_button_and_points_keep_their_place(tmp_path, width, height):
    """(A headless Chromium has no windows narrower than 500.)"""
    write(tmp_path / "live.html", names=("a_name_of_one_word_that_is_long_" * 4, "bow"))
    script = """<script>setInterval(() => {
      const [said, home, stage] = ["said", "home", "stage"].map((id) => $(id).getBoundingClientRect());
      $("play").scrollIntoView();
      const reached = $("play").getBoundingClientRect().bottom <= innerHeight;
      root.dataset.apart = reached && said.right <= home.left && $("said").scrollWidth <= said.width + 1 && stage.height > 150;
    }, 200)</script></body>"""
    text = (tmp_path / "live.html").read_text("utf-8")
    (tmp_path / "live.html").write_text(text.replace("</body>", script), "utf-8")
    address = f"file://{tmp_path / 'live.html'}#frame=12&play=0&renderer=2d"
    html, said = drawn(address, tmp_path, f"--window-size={width},{height}")
    assert 'data-apart="true"' in html and ">a_name_of_one_word" in said


def test_the_page_of_an_hour_is_no_larger_than_that_of_minutes(tmp_path):
    write(tmp_path / "short.html", frames=4000)
    write(tmp_path / "long.html", frames=20_000)
    assert (tmp_path / "long.html").stat().st_size < 1.3 * (tmp_path / "short.html").stat().st_size
    text = (tmp_path / "long.html").read_text("utf-8")
    assert "20 ms on average, at most 3000" in text and '"highest": 3000' in text, "of a prediction that isn't shown"


@pytest.mark.parametrize("count", [1, 10, 11, 1000])
def test_a_row_of_any_length_is_kept_evenly(count):
    kept = Thinned(10, np.dtype([("number", int)]))
    for item in range(count):
        kept.add((item,) if kept.wants_next else ())
    assert kept.rows["number"].tolist() == list(range(0, count, kept.every)) and len(kept.rows) <= 10
