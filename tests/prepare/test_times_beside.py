"""Times that a text beside frames lists, of clouds and of depth: whose rows are whose, and what doesn't fit is told."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest

from dpcli.store import CloudsReader
from dpcli.store.views import ViewsReader
from tests.support.commands import exit_code

SECONDS = np.cumsum([0.0, 0.1, 0.25, 0.1, 0.05, 0.2])


def dates(seconds: np.ndarray) -> list[str]:
    begin = datetime(2011, 9, 26, 23, 59, 59, 750_000)
    return [str(begin + timedelta(seconds=float(one))) for one in seconds]


FORMS = {
    "seconds": lambda s: [f"{one:.6e}" for one in s],
    "since 1970": lambda s: [f"{1.7e9 + one:.6f}" for one in s],
    "milliseconds since 1970": lambda s: [str(round(1.7e12 + one * 1e3)) for one in s],
    "nanoseconds since 1970": lambda s: [str(1_700_000_000_000_000_000 + round(one * 1e9)) for one in s],
    "dates": dates,
    "a unit in the name": lambda s: ["time [ms]", *(str(round(one * 1e3)) for one in s)],
    "with a name and a remark": lambda s: ["timestamp", "# of the scanner", *(repr(float(one)) for one in s), ""],
}


def write_frames(folder: Path, kind: str, numbers: list[int]) -> None:
    rng = np.random.default_rng(0)
    folder.mkdir(parents=True, exist_ok=True)
    for number in numbers:
        if kind == "clouds":
            np.savetxt(folder / f"{number:06d}.xyz", rng.normal(size=(40, 3)))
        else:
            cv2.imwrite(str(folder / f"{number:06d}.png"), rng.integers(500, 900, (6, 8)).astype(np.uint16))


def converted(kind: str, raw: Path, out: Path, capfd) -> tuple[np.ndarray | None, str]:
    more = ("--fov", 60) if kind == "depth" else ()
    capfd.readouterr()
    assert exit_code("prepare", kind, raw, "-o", out, "--force", *more) == 0
    with CloudsReader(out) as reader:
        return reader.read(0).time, capfd.readouterr().err


@pytest.mark.parametrize("kind", ["clouds", "depth"])
@pytest.mark.parametrize("form", FORMS)
def test_the_times_are_those_of_the_rows(tmp_path, capfd, kind, form):
    write_frames(tmp_path / "raw" / "drive" / "data", kind, range(6))
    (tmp_path / "raw" / "drive" / "timestamps.txt").write_text("\n".join(FORMS[form](SECONDS)))
    time, said = converted(kind, tmp_path / "raw", tmp_path / "a.h5", capfd)
    np.testing.assert_allclose(time, SECONDS, atol=1e-3 if "milli" in form else 1e-5)
    assert "its frames have the times in timestamps.txt" in said and "left out" not in said


@pytest.mark.parametrize("kind", ["clouds", "depth"])
@pytest.mark.parametrize("folder", ["drive", "drive/data"])
def test_other_times_are_other_data(tmp_path, capfd, kind, folder):
    write_frames(tmp_path / "raw" / "drive" / "data", kind, range(3))
    for text in ("0\n0.1\n0.2", "0\n0.1\n0.3"):  # of one size
        (tmp_path / "raw" / folder / "times.txt").write_text(text)
        code = exit_code("prepare", kind, tmp_path / "raw", "-o", tmp_path / "a.h5")
    assert code == 2 and "exists, made with other samples" in capfd.readouterr().err


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_texts_of_windows_are_read(tmp_path, capfd, encoding):
    write_frames(tmp_path, "clouds", range(6))
    (tmp_path / "times.txt").write_text("\r\n".join(FORMS["seconds"](SECONDS)), encoding=encoding, newline="")
    np.testing.assert_allclose(converted("clouds", tmp_path, tmp_path / "a.h5", capfd)[0], SECONDS, atol=1e-5)


@pytest.mark.parametrize("first", [0, 1])
def test_a_missing_frame_leaves_its_row_out(tmp_path, capfd, first):
    write_frames(tmp_path, "clouds", [first + n for n in (0, 1, 3, 5)])
    (tmp_path / "times.txt").write_text("\n".join(FORMS["seconds"](SECONDS)))
    time, said = converted("clouds", tmp_path, tmp_path / "a.h5", capfd)
    np.testing.assert_allclose(time, SECONDS[[0, 1, 3, 5]], atol=1e-5)
    assert "numbered with gaps" in said


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        (["0", "0.1"], "times.txt (2 times for 6 frames)"),
        (FORMS["seconds"](np.append(SECONDS, [1.0, 1.2])), "times.txt (8 times for 6 frames)"),
        (["0", "0.1", "0.05", "0.2", "0.3", "0.4"], "times.txt (no times)"),
        (["a", "b", "1 2", "c", "d", "e"], "times.txt (no times)"),
        (["0", "1", "2", "3", "4", "5"], "times.txt (no times)"),  # which counts
        (["0", "0.1", "nan", "0.2", "0.3", "0.4"], "times.txt (no times)"),
        ([], "times.txt (no times)"),
    ],
    ids=range(7),
)
def test_a_text_that_does_not_fit_is_named_with_the_reason(tmp_path, capfd, rows, told):
    write_frames(tmp_path, "clouds", range(6))
    (tmp_path / "times.txt").write_text("\n".join(rows))
    time, said = converted("clouds", tmp_path, tmp_path / "a.h5", capfd)
    assert time is None and f"left out: {told}" in said


def test_names_that_are_times_and_a_given_rate_come_first_and_nothing_above_the_folder_is_read(tmp_path, capfd):
    write_frames(tmp_path / "raw", "clouds", range(6))
    (tmp_path / "times.txt").write_text("\n".join(FORMS["seconds"](SECONDS)))
    assert converted("clouds", tmp_path / "raw", tmp_path / "a.h5", capfd)[0] is None
    (tmp_path / "raw" / "times.txt").write_text("\n".join(FORMS["seconds"](SECONDS)))
    assert exit_code("prepare", "clouds", tmp_path / "raw", "-o", tmp_path / "b.h5", "--fps", 10) == 0
    with CloudsReader(tmp_path / "b.h5") as reader:
        np.testing.assert_allclose(reader.read(0).time, np.arange(6) / 10, atol=1e-6)
    for old, at in zip(sorted((tmp_path / "raw").glob("*.xyz")), 1.7e9 + np.arange(6) / 2):
        old.rename(old.with_name(f"{at:.6f}.xyz"))
    np.testing.assert_allclose(
        converted("clouds", tmp_path / "raw", tmp_path / "a.h5", capfd)[0], np.arange(6) / 2, atol=1e-5
    )


def test_pictures_of_a_clip_have_their_times(tmp_path, capfd):
    rng = np.random.default_rng(0)
    for t in range(6):
        picture = np.zeros((24, 24, 4), np.uint8)
        picture[6:18, 4 + t : 14 + t] = [*rng.integers(0, 255, 3), 255]
        cv2.imwrite(str(tmp_path / f"{t}.png"), picture)
    (tmp_path / "times.txt").write_text("\n".join(FORMS["dates"](SECONDS)))
    assert exit_code("prepare", "video", tmp_path, "-o", tmp_path / "v.h5", "--size", 32) == 0
    said = capfd.readouterr().err
    assert "its frames have the times in times.txt" in said and "assumed" not in said
    with ViewsReader(tmp_path / "v.h5") as reader:
        np.testing.assert_allclose(reader.header.time, SECONDS, atol=1e-5)
    (tmp_path / "times.txt").write_text("\n".join(FORMS["dates"](2 * SECONDS)))  # other times make another file
    assert exit_code("prepare", "video", tmp_path, "-o", tmp_path / "v.h5", "--size", 32) == 2
    assert "made with other times; write to" in " ".join(capfd.readouterr().err.split())
    (tmp_path / "times.txt").write_text("0\n0.1\n")
    assert exit_code("prepare", "video", tmp_path, "-o", tmp_path / "w.h5", "--size", 32) == 0
    said = capfd.readouterr().err
    assert "left out: times.txt (2 times for 6 frames)" in said and "16 per second assumed" in said
    for t, at in enumerate(1.3e9 + SECONDS):  # TUM and ROS name pictures so
        (tmp_path / f"{t}.png").rename(tmp_path / f"{at:.6f}.png")
    assert exit_code("prepare", "video", tmp_path, "-o", tmp_path / "x.h5", "--size", 32) == 0
    said = capfd.readouterr().err
    assert "its frames have the times in their names" in said and "missing" not in said and "assumed" not in said
    with ViewsReader(tmp_path / "x.h5") as reader:
        np.testing.assert_allclose(reader.header.time, SECONDS, atol=1e-5)
