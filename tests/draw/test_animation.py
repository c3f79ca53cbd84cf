"""Videos, animations, pictures and folders of them: what players read, and nothing half made."""

from __future__ import annotations

import base64
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dpcli.draw.animation import _folder, output_kind, write_pictures
from dpcli.errors import DataError, DpcError, UsageError
from tests.support.browser import held_page, needs_browser, open_page


def moving_square(count: int = 6, shape: tuple[int, int] = (31, 40)) -> list[np.ndarray]:
    pictures = [np.full((*shape, 3), 255, np.uint8) for _ in range(count)]
    for number, picture in enumerate(pictures):
        picture[8:24, 4 * number : 4 * number + 12] = [200, 30, 40]
    return pictures


def test_a_video_plays_back(tmp_path):
    import cv2

    write_pictures(tmp_path / "a.mp4", iter(moving_square()), fps=12.5)
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(12.5)
    frames = [picture[..., ::-1] for ok, picture in iter(video.read, (False, None)) if ok]
    assert len(frames) == 6 and frames[0].shape == (32, 40, 3)  # an even height
    for read, own in zip(frames, moving_square()):
        assert np.abs(read[:31].astype(int) - own).mean() < 10


def test_a_video_without_the_encoder_package(tmp_path, monkeypatch, capsys):
    import sys

    import cv2

    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    write_pictures(tmp_path / "a.mp4", iter(moving_square()), fps=10)
    assert "imageio-ffmpeg" in capsys.readouterr().err
    assert cv2.VideoCapture(str(tmp_path / "a.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 6


def test_animation_folder_and_picture(tmp_path):
    from PIL import Image

    write_pictures(tmp_path / "a.gif", iter(moving_square()), fps=10)
    with Image.open(tmp_path / "a.gif") as image:
        assert (image.n_frames, image.info["duration"], image.info["loop"], image.size) == (6, 100, 0, (40, 31))
    write_pictures(tmp_path / "all", iter(moving_square()), fps=10)
    assert [path.name for path in sorted((tmp_path / "all").iterdir())] == [f"{i:04d}.png" for i in range(6)]
    write_pictures(tmp_path / "a.png", iter(moving_square()), fps=10)
    for path, number in ((tmp_path / "all" / "0003.png", 3), (tmp_path / "a.png", 0)):
        np.testing.assert_array_equal(np.asarray(Image.open(path)), moving_square()[number])


@pytest.mark.parametrize(("fps", "seconds"), [(24, 1.0), (30, 0.8), (7.5, 3.2), (60, 0.48)])
def test_an_animation_lasts_as_long_as_asked_for_or_says_that_it_cannot(tmp_path, capsys, fps, seconds):
    from PIL import Image

    write_pictures(tmp_path / "a.gif", iter(moving_square(24, (31, 120))), fps=fps)
    with Image.open(tmp_path / "a.gif") as image:
        pauses = [image.seek(frame) or image.info["duration"] for frame in range(image.n_frames)]
    assert sum(pauses) / 1000 == pytest.approx(seconds)
    assert ("at most 50 pictures a second: it takes 1.2 times as long" in capsys.readouterr().err) is (fps > 50)


def test_the_order_of_many_pictures_is_that_of_their_names(tmp_path, monkeypatch):
    """Shells and most programs sort names as text: 10000.png would come before 1001.png."""
    monkeypatch.setattr(Image.Image, "save", lambda image, path: path.write_bytes(image.tobytes()))  # takes a tenth
    _folder(tmp_path / "many", (np.full((1, 1, 3), 255 * (frame == 10_000), np.uint8) for frame in range(10_001)), 10)
    names = sorted(path.name for path in (tmp_path / "many").iterdir())
    assert len(names) == 10_001 and (names[0], names[-1]) == ("00000.png", "10000.png")
    assert [(tmp_path / "many" / name).read_bytes() for name in names[-2:]] == [b"\0\0\0", b"\xff\xff\xff"]


def test_nothing_half_made_stays(tmp_path):
    def breaking():
        yield from moving_square(2)
        raise DataError("no more")

    for name in ("a.mp4", "a.gif", "all"):
        with pytest.raises(DataError, match="no more"):
            write_pictures(tmp_path / name, breaking(), fps=10)
    assert not list(tmp_path.iterdir())
    (tmp_path / "a.png").write_bytes(b"mine")
    with pytest.raises(UsageError, match="--force"):
        write_pictures(tmp_path / "a.png", iter(moving_square()), fps=10)
    assert (tmp_path / "a.png").read_bytes() == b"mine"
    with pytest.raises(UsageError, match="ends in .mp4, .gif, .png"):
        output_kind(Path("a.avi"))
    write_pictures(tmp_path / "frames", iter(moving_square()), fps=10)
    write_pictures(tmp_path / "frames", iter(moving_square()), fps=10, force=True)
    (tmp_path / "frames" / "thesis.tex").write_bytes(b"mine")
    with pytest.raises(UsageError, match="other things, too, such as thesis.tex"):
        write_pictures(tmp_path / "frames", iter(moving_square()), fps=10, force=True)
    assert (tmp_path / "frames" / "thesis.tex").read_bytes() == b"mine"
    with pytest.raises(DpcError, match="does not exist"):
        write_pictures(tmp_path / "no" / "a.png", iter(moving_square()), fps=10)


def test_an_animation_has_one_table_of_colors(tmp_path):
    """A color that stands still keeps its number in every picture, so that nothing flickers."""
    from PIL import Image

    write_pictures(tmp_path / "a.gif", moving_square(), fps=10)
    with Image.open(tmp_path / "a.gif") as image:
        shown = []
        for number in range(image.n_frames):
            image.seek(number)
            shown.append(np.asarray(image.convert("RGB")).astype(int))
    for picture, truth in zip(shown, moving_square()):
        assert np.abs(picture - truth).max() <= 8
    np.testing.assert_array_equal(np.unique([picture[0, 0] for picture in shown], axis=0), [shown[0][0, 0]])


@pytest.mark.parametrize("lowest, shades", [(180, 3), (245, 1)])
def test_the_ground_of_an_animation_keeps_its_color(tmp_path, lowest, shades):
    """Among many more colors than an animation has, and beside a few that are nearly white: white stays white."""
    from PIL import Image

    rng = np.random.default_rng(0)
    pictures = [np.full((60, 80, 3), 255, np.uint8) for _ in range(6)]
    for picture in pictures:
        picture[10:40, 10:60] = rng.integers(lowest, 256, (30, 50, shades))
    write_pictures(tmp_path / "a.gif", pictures, fps=10)
    with Image.open(tmp_path / "a.gif") as image:
        assert (np.asarray(image.convert("RGB"))[:5] == 255).all()


@needs_browser
@pytest.mark.parametrize("side", [96, 800])  # browsers take untagged videos of these sizes for different matrices
def test_a_browser_shows_the_colors_that_were_written(tmp_path, side):
    colors = [(200, 30, 30), (30, 160, 60), (40, 60, 200), (230, 200, 60), (120, 120, 120), (255, 255, 255)]
    picture = np.repeat(np.repeat(np.array([colors], np.uint8), side, 0), side // 6, 1)
    write_pictures(tmp_path / "a.mp4", [picture] * 3, fps=10)
    film = base64.b64encode((tmp_path / "a.mp4").read_bytes()).decode()
    page = tmp_path / "a.html"
    with held_page() as (hold, go_on):
        page.write_text(f"""<html><body>{hold}<video id="v" muted src="data:video/mp4;base64,{film}"></video><script>
        const video = document.querySelector("video"), canvas = document.createElement("canvas");
        video.onseeked = () => {{
          [canvas.width, canvas.height] = [video.videoWidth, video.videoHeight];
          const context = canvas.getContext("2d");
          context.drawImage(video, 0, 0);
          const at = (k) =>
            [...context.getImageData((k + 0.5) * video.videoWidth / 6, video.videoHeight / 2, 1, 1).data];
          if (at(5)[0] === 0) {{ setTimeout(video.onseeked, 100); return; }}  // the white place: no picture is decoded yet
          document.documentElement.dataset.seen = [0, 1, 2, 3, 4, 5].map((k) => at(k).slice(0, 3).join()).join(" ");
          {go_on}
        }};
        video.onloadeddata = () => {{ video.currentTime = 0.1; }};
        </script></body></html>""")
        html, said = open_page(page.as_uri(), tmp_path)
    seen = re.search(r'data-seen="([^"]*)"', html)
    assert seen, said[-2000:]
    read = np.array([[int(level) for level in color.split(",")] for color in seen[1].split()])
    assert np.abs(read - colors).max() <= 8


FULL = """
import resource, sys
from pathlib import Path
import numpy as np
from dpcli.draw.animation import write_pictures
from dpcli.errors import DpcError
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), int(sys.argv[1])))
try:
    write_pictures(Path("a.mp4"), [np.full((16, 16, 3), n, np.uint8) for n in range(90)], fps=10)
except DpcError as error:
    print(error)
"""


def test_a_video_whose_last_bytes_find_no_room_is_an_error_wherever_it_is_cut(tmp_path):
    """An encoder writes a short one as it ends, and doesn't tell that it could not."""

    def write(limit):
        words = [sys.executable, "-c", FULL, str(limit)]
        env = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
        return subprocess.run(words, cwd=tmp_path, env=env, capture_output=True, text=True, check=True).stdout

    assert write(1 << 20) == ""
    whole = (tmp_path / "a.mp4").read_bytes()
    (tmp_path / "a.mp4").unlink()
    for limit in (1000, len(whole) - 1):
        assert "a.mp4: the file size limit is reached" in write(limit)
        assert list(tmp_path.iterdir()) == []
    assert write(len(whole)) == "" and (tmp_path / "a.mp4").read_bytes() == whole
