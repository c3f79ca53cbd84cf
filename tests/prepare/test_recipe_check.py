"""`--check`: what a folder lacks, by its recipe; found where it is broken, and only there."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from dpcli.cli.app import app
from dpcli.errors import DataError
from dpcli.prepare import recipe_check
from dpcli.prepare.recipe_check import RECIPES, Tree, check_folder, check_rows, expand_braces, read_recipe
from tests.support.commands import told as dpc
from tests.support.prepare_helpers import ROOT, ToyReader, write_msr

RECIPE = """
title = "A toy set"
[get]
ask = "its authors"
[[raw]]
path = "seq/{00..02}/*.bin"
what = "scans"
each = [2, 1, 1]
bytes = [4, 8]
[[raw]]
path = ["lists/*.txt", "lists.csv"]
what = "lists"
[[raw]]
path = "**/clip.avi"
what = "videos"
count = 3
[[raw]]
path = "notes.txt"
what = "notes"
optional = true
[[raw]]
path = "all.zip"
what = "archive"
instead_of = "videos"
"""


@pytest.fixture
def toy(tmp_path, monkeypatch) -> Path:
    (tmp_path / "recipes").mkdir()
    (tmp_path / "recipes" / "toy.toml").write_text(RECIPE)
    monkeypatch.setattr(recipe_check, "RECIPES", tmp_path / "recipes")
    raw = tmp_path / "raw ü"
    for name in (
        "seq/00/a.bin",
        "seq/00/b.bin",
        "seq/01/a.bin",
        "seq/02/a.bin",
        "lists.csv",
        "x/clip.avi",
        "x/y z/clip.avi",
        "clip.avi",
    ):
        (raw / name).parent.mkdir(parents=True, exist_ok=True)
        (raw / name).write_bytes(b"12345")
    return raw


def faults(raw: Path) -> list[str]:
    return check_rows(read_recipe("toy")[1], Tree(raw))[1]


def test_a_whole_folder_passes(toy):
    lines = list(check_folder("toy", toy, ToyReader))
    assert faults(toy) == [] and lines[-1].startswith("ok       index: 5 samples to convert, 0")
    assert [line.split()[1] for line in lines if line.startswith("optional")] == ["notes:"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda raw: (raw / "seq/01/a.bin").unlink(), "seq/01/*.bin: 0 files, expected 1"),
        (lambda raw: (raw / "seq/00/c.bin").write_bytes(b"12345"), "seq/00/*.bin: 3 files, expected 2"),
        (lambda raw: (raw / "seq/02/a.bin").write_bytes(b"123"), "seq/02/a.bin: 3 bytes, expected 4 to 8 bytes"),
        (lambda raw: (raw / "x/clip.avi").unlink(), "**/clip.avi: 2 files, expected 3"),
        (lambda raw: (raw / "clip.avi").write_bytes(b""), "clip.avi: 0 bytes, expected at least 1 bytes"),
        (lambda raw: (raw / "lists.csv").unlink(), "lists/*.txt: missing"),
        (
            lambda raw: ((raw / "lists.csv").unlink(), (raw / "lists.csv").symlink_to("gone")),
            "lists.csv: a link to nowhere",
        ),
    ],
)
def test_each_fault_is_found_and_no_other(toy, change, message):
    change(toy)
    (found,) = faults(toy)
    assert found.startswith(message)
    told = []
    with pytest.raises(DataError, match="1 thing missing or wrong; where to get it: its authors"):
        told.extend(check_folder("toy", toy, ToyReader))


def test_one_of_two_rows_suffices(toy):
    for clip in toy.rglob("clip.avi"):
        clip.unlink()
    assert any("clip.avi" in fault for fault in faults(toy))
    (toy / "all.zip").write_bytes(b"zip")
    assert faults(toy) == []


def test_hidden_twins_of_macos_are_no_files(toy):
    for path in [path for path in toy.rglob("*") if path.is_file()]:
        path.with_name(f"._{path.name}").write_bytes(b"")
        twin = toy / "__MACOSX" / path.relative_to(toy)
        twin.parent.mkdir(parents=True, exist_ok=True)
        twin.write_bytes(b"")
    assert not faults(toy)


def test_links_in_a_circle_end(toy):
    (toy / "x" / "loop").symlink_to(toy)
    assert faults(toy) == []
    outside = toy.parent / "elsewhere"
    outside.mkdir()
    (outside / "clip.avi").write_bytes(b"12345")
    (toy / "linked").symlink_to(outside)
    assert faults(toy) == ["**/clip.avi: 4 files, expected 3"]


def test_what_the_index_finds_is_told(toy):
    class Listed(ToyReader):
        def items(self):
            from dataclasses import replace

            return [replace(item, problem="list.txt, line 3: no such file") for item in super().items()[:1]]

    told = []
    with pytest.raises(DataError, match="1 thing "):
        for line in check_folder("toy", toy, Listed):
            told.append(line)
    assert told[-1].strip() == "toy000: list.txt, line 3: no such file"


def test_braces():
    assert expand_braces("a{08..11}/{x,y}") == [f"a{n}/{c}" for n in ("08", "09", "10", "11") for c in "xy"]
    assert expand_braces("plain[1]") == ["plain[1]"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[raw]]\nfile = 'x'", "has \\['file'\\]"),
        ("[[raw]]\nwhat = 'x'", "no path"),
        ("[[raw]]\npath = '{0..2}'\neach = [1, 2]", "each has 2 numbers, but .* names 3 paths"),
    ],
)
def test_recipes_that_say_something_else_are_refused(toy, text, message):
    (recipe_check.RECIPES / "toy.toml").write_text(text)
    with pytest.raises(DataError, match=message):
        read_recipe("toy")
    with pytest.raises(DataError, match="no recipe for other; there are toy"):
        read_recipe("other")


@pytest.mark.parametrize("name", sorted(path.stem for path in (ROOT / "data_recipes").glob("*.toml")))
def test_every_recipe_can_be_checked(name):
    assert RECIPES.resolve() == ROOT / "data_recipes"
    recipe, rows = read_recipe(name)
    assert recipe["name"] == name
    known = {row.what for row in rows}
    assert len(known) == len(rows) and {row.instead_of for row in rows} - {""} <= known


def test_the_command(tmp_path):
    raw = write_msr(tmp_path / "raw", ["a01_s01_e01", "a02_s06_e01"])
    done = dpc("prepare", "msraction3d", raw, "--check")
    assert done.returncode == 3 and "depth videos" in done.stdout and "2 files, expected 567" in done.stdout
    assert "Traceback" not in done.stderr and " missing or wrong" in done.stderr
    nowhere = dpc("prepare", "msraction3d", tmp_path / "nowhere", "--check")
    assert nowhere.returncode == 3 and "does not exist" in nowhere.stderr
    without = dpc("prepare", "msraction3d", raw)
    assert without.returncode == 2 and "-o/--output FILE is missing" in without.stderr


# ---- clips and animals, which become views ----


def check(*arguments: object):
    return CliRunner().invoke(app, ["prepare", *map(str, arguments), "--check"])


@pytest.fixture
def panda(tmp_path) -> Path:
    """An animal of three frames, two cameras: pictures are a few bytes, as none is opened."""
    folder = tmp_path / "panda"
    (folder / "bones" / "walk").mkdir(parents=True)
    row = "0 0 1 1 0 0 0 1 0 0 0 0\n"
    (folder / "CamPose.inf").write_text(2 * row)
    (folder / "Intrinsic.inf").write_text("".join(f"{k}\n9 0 4\n0 9 4\n0 0 1\n\n" for k in range(2)))
    (folder / "sequences").write_text("walk 3\n")
    for frame in range(3):
        pictures = folder / "img" / "walk" / str(frame)
        pictures.mkdir(parents=True)
        for view in range(2):
            (pictures / f"img_{view:04d}.jpg").write_bytes(b"picture")
            (pictures / f"img_{view:04d}_alpha.png").write_bytes(b"mask")
        (folder / "bones" / "walk" / f"Bones_{frame:04d}.inf").write_text(row)
    return folder


def test_a_whole_animal_passes(panda):
    done = check("artemis", panda)
    assert done.exit_code == 0, done.stdout
    assert "index: 1 sample to convert, 0 that cannot be" in done.stdout and "MISSING" not in done.stdout
    assert "optional voxels and their bones" in done.stdout
    for folder in (panda / "img/walk").iterdir():  # a copy of one camera only is whole in itself
        for path in folder.glob("img_0001*"):
            path.unlink()
    assert check("artemis", panda).exit_code == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda raw: (raw / "CamPose.inf").unlink(), "CamPose.inf: missing"),
        (lambda raw: (raw / "Intrinsic.inf").write_text("0\n9 0 4\n0 9 4\n0 0 1\n"), "2 cameras, Intrinsic.inf 1"),
        (lambda raw: (raw / "img/walk/1/img_0001.jpg").unlink(), "1 file missing, the first: img/walk/1/img_0001.jpg"),
        (lambda raw: (raw / "img/walk/2/img_0000_alpha.png").unlink(), "the first: img/walk/2/img_0000_alpha.png"),
        (lambda raw: (raw / "img/walk/0/img_0000.jpg").write_bytes(b""), "0 bytes, expected at least 1"),
        (lambda raw: (raw / "bones/walk/Bones_0001.inf").unlink(), "the first: bones/walk/Bones_0001.inf"),
        (lambda raw: (raw / "sequences").write_text("walk 5\n"), "walk: 3 of the 5 frames are there"),
        (
            lambda raw: (raw / "sequences").write_text("walk 3\nrun 9\n"),
            "img/run: missing; sequences gives it 9 frames",
        ),
        (lambda raw: shutil.rmtree(raw / "img"), "img/*/*/img_????_alpha.png: missing"),
    ],
)
def test_what_an_animal_lacks_is_told(panda, change, message):
    change(panda)
    done = check("artemis", panda)
    assert isinstance(done.exception, DataError) and message in done.stdout, done.stdout
    assert "missing or wrong" in str(done.exception)


def test_only_the_motion_that_is_asked_for(panda):
    (panda / "sequences").write_text("walk 3\nrun 9\n")
    assert check("artemis", panda, "--motion", "walk").exit_code == 0
    assert "img/run: missing" in check("artemis", panda, "--motion", "run").stdout


@pytest.fixture
def clip(tmp_path) -> Path:
    (tmp_path / "clip").mkdir()
    for number in range(4):
        Image.new("RGBA", (8, 6)).save(tmp_path / "clip" / f"{number}.png")
    return tmp_path / "clip"


def test_a_whole_clip_passes(clip):
    done = check("video", clip)
    assert done.exit_code == 0 and "4 samples to convert, 0 that" in done.stdout, done.stdout
    Image.new("L", (8, 6)).save(clip.parent / "a.gif", save_all=True, append_images=[Image.new("L", (8, 6), 90)])
    done = check("video", clip.parent / "a.gif")
    assert done.exit_code == 0 and "2 samples to convert" in done.stdout, done.stdout


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda raw: (raw / "2.png").write_bytes(b""), "2.png: 0 bytes"),
        (lambda raw: (raw / "2.png").write_bytes(b"no picture"), "2.png: not a readable image"),
        (
            lambda raw: Image.new("L", (9, 6)).save(raw / "3.png"),
            "3.png: 9x6, 0.png is 8x6; export all frames at one size",
        ),
        (lambda raw: [path.unlink() for path in raw.iterdir()], "MISSING"),
        (
            lambda raw: (raw / "rgba").mkdir() or [p.rename(raw / "rgba" / p.name) for p in raw.glob("*.png")],
            "it has folders (rgba): name one of them",
        ),
    ],
)
def test_what_a_clip_lacks_is_told(clip, change, message):
    change(clip)
    done = check("video", clip)
    assert isinstance(done.exception, DataError) and message in done.stdout, done.stdout


def test_masks_and_views_of_a_clip_are_looked_for(clip):
    masks, views = clip.parent / "masks", clip.parent / "views"
    masks.mkdir()
    shutil.copy(clip / "0.png", masks)
    assert "1 mask for 4 frames" in check("video", clip, "--mask", masks).stdout
    for frame in range(4):
        (views / f"{frame}_rgba").mkdir(parents=True)
        for view in range(6 - (frame == 3)):
            shutil.copy(clip / "0.png", views / f"{frame}_rgba" / f"{view}.png")
    assert "4 folders of 5/6 pictures" in check("video", clip, "--views", views).stdout
    shutil.copy(clip / "0.png", views / "3_rgba" / "5.png")
    assert check("video", clip, "--views", views).exit_code == 0
    assert "-o/--output FILE is missing" in str(CliRunner().invoke(app, ["prepare", "video", str(clip)]).exception)


def test_files_of_ones_own_are_checked_by_the_index_alone(tmp_path, dpc_here):
    for name in ("0", "1"):
        np.save(tmp_path / f"{name}.npy", np.ones((4, 8, 8), np.uint16))
    done = dpc_here("prepare", "depth", tmp_path, "--check")
    assert done.returncode == 0 and b"2 samples to convert, 0 that cannot be" in done.stdout, done.stderr
    (tmp_path / "2.npy").symlink_to("nowhere.npy")
    done = dpc_here("prepare", "depth", tmp_path, "--check")
    assert done.returncode == 3 and b"a link to nowhere.npy, which is missing" in done.stdout
    done = dpc_here("prepare", "synthetic", "gestures", "--check")
    assert done.returncode == 3 and b"reads no files" in done.stderr
