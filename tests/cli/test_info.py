"""`dpc info` and `dpc evaluate` as a person runs them: pipes, exit codes, messages, start-up."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from dpcli.draw.page.points import PageFacts
from dpcli.draw.page.scatter import scatter_page
from dpcli.evaluate.segmentation.protocol import evaluate_segmentation
from dpcli.evaluate.segmentation.sequence_pass import Keeping
from dpcli.store import CloudSequence, CloudsWriter, ScoresWriter
from dpcli.store.gaussians import write_scene
from tests.support.commands import told
from tests.support.parts_helpers import perfect, truth_sequence, write_parts, write_truth
from tests.support.scenes import toy_scene

ROOT = Path(__file__).parents[2]


def dpc(*arguments: object, stdin: bytes | None = None) -> subprocess.CompletedProcess:
    """In this process, or in one of its own where something comes through a pipe."""
    if stdin is None:
        done = told(*arguments)
        return subprocess.CompletedProcess(arguments, done.returncode, done.stdout.encode(), done.stderr.encode())
    command = [sys.executable, "-m", "dpcli", *map(str, arguments)]
    return subprocess.run(command, input=stdin, capture_output=True, cwd=ROOT, timeout=120)


@pytest.fixture(scope="module")
def clouds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("info") / "clouds.h5"
    rng = np.random.default_rng(0)
    with CloudsWriter(path, class_names=["wave", "[bold]push"], provenance={"command": "dpc made [it]"}) as writer:
        for index in range(4):
            frames = [rng.normal(size=(300, 3)) for _ in range(3)]
            split = ("train", "test")[index % 2]
            writer.write(CloudSequence.from_frames(f"s{index}", frames, label=index // 2, split=split))
    return path


@pytest.fixture(scope="module")
def scores(clouds: Path) -> Path:
    path = clouds.with_name("scores.h5")
    with ScoresWriter(path, class_names=["wave", "[bold]push"]) as writer:
        for index in range(4):
            writer.write(f"s{index}", np.eye(2)[index // 2], label=index // 2, split=("train", "test")[index % 2])
    return path


def test_a_file_and_a_pipe_say_the_same(clouds: Path) -> None:
    direct, piped = dpc("info", clouds, "--json", stdin=b""), dpc("info", "-", "--json", stdin=clouds.read_bytes())
    assert (direct.returncode, piped.returncode) == (0, 0) and direct.stderr == b""
    first, second = json.loads(direct.stdout), json.loads(piped.stdout)
    assert first.pop("file") == str(clouds) and second.pop("file") == "-"
    assert first == second and first["counts"]["points"] == 4 * 3 * 300


def test_text_for_people(clouds: Path) -> None:
    text = dpc("info", clouds).stdout.decode()
    for part in ("4 sequences, 12 frames, 3,600 points", "train (2), test (2)", "[bold]push", "1. dpc made [it]"):
        assert part in text


@pytest.mark.parametrize(
    "unit, end", [("mm", " mm"), ("300 raw depth units", " (300 raw depth units)"), ("", ""), (None, "")]
)
def test_a_unit_of_several_words_stands_apart_from_the_number(
    clouds: Path, tmp_path: Path, unit: str | None, end: str
) -> None:
    shutil.copy(clouds, tmp_path / "c.h5")
    with h5py.File(tmp_path / "c.h5", "r+") as file:
        del file.attrs["length_unit"]
        if unit is not None:
            file.attrs["length_unit"] = unit
    (line,) = (
        line for line in dpc("info", tmp_path / "c.h5").stdout.decode().splitlines() if line.startswith("range x")
    )
    assert re.fullmatch(r"range x +-[\d.]+ to [\d.]+" + re.escape(end), line)


def test_picture(clouds: Path, tmp_path: Path) -> None:
    from PIL import Image

    result = dpc("info", clouds, "--picture", tmp_path / "sheet.png", "--samples", 2, "--frames", 3)
    assert result.returncode == 0
    with Image.open(tmp_path / "sheet.png") as image:
        small = image.size
    assert dpc("info", clouds, "--picture", tmp_path / "more.png", "--samples", 4, "--frames", 3).returncode == 0
    with Image.open(tmp_path / "more.png") as image:
        assert image.size[0] == small[0] and 1.9 < image.size[1] / small[1] < 2.1


def broken_files(folder: Path, clouds: Path) -> dict[str, Path]:
    whole = clouds.read_bytes()
    contents = {
        "truncated": whole[: len(whole) // 2],
        "not an HDF5 file": b"x,y,z\n1,2,3\n",
        "empty": b"",
        "an HDF5 file, but not one of dpc's": None,
        "schema 9": None,
    }
    paths = {}
    for number, (said, content) in enumerate(contents.items()):
        path = paths[said] = folder / f"{number}.h5"
        if content is not None:
            path.write_bytes(content)
            continue
        with h5py.File(path, "w") as file:
            file["points"] = np.zeros((3, 3))
            if said == "schema 9":
                file.attrs.update({"dpc_kind": "clouds", "dpc_schema": 9})
    return paths


def assert_explained(result: subprocess.CompletedProcess, code: int, *said: str) -> None:
    """The exit code, one or two lines on stderr that say so, nothing on stdout."""
    lines = result.stderr.decode().splitlines()
    assert result.returncode == code and result.stdout == b""
    assert 1 <= len(lines) <= 2 and lines[0].startswith("dpc: error: ")
    assert all(part in lines[0] for part in said), lines


def test_the_checker_of_messages_rejects_a_trace() -> None:
    trace = subprocess.CompletedProcess([], 1, b"", b"Traceback (most recent call last):\n  File\nValueError: x\n")
    with pytest.raises(AssertionError):
        assert_explained(trace, 1)


def test_bad_files_are_explained(clouds: Path, tmp_path: Path) -> None:
    for said, path in broken_files(tmp_path, clouds).items():
        assert_explained(dpc("info", path), 3, str(path), said)
    assert_explained(dpc("info", tmp_path / "none.h5"), 3, "none.h5", "no such file")
    assert_explained(dpc("info", tmp_path), 3, str(tmp_path), "folder")


def test_bad_pipes_are_explained(clouds: Path) -> None:
    assert_explained(dpc("info", "-", stdin=b""), 3, "stdin", "empty")
    assert_explained(dpc("info", "-", stdin=clouds.read_bytes()[:5000]), 3, "truncated")
    assert_explained(dpc("evaluate", "classification", "-", stdin=b"no HDF5 at all"), 3, "not an HDF5 file")


def test_a_file_of_another_kind_says_which(clouds: Path, scores: Path, tmp_path: Path) -> None:
    assert_explained(dpc("evaluate", "classification", clouds), 3, "'clouds'", "'scores'")
    assert_explained(dpc("evaluate", "classification", scores, "--truth", scores), 3, "'scores'", "'clouds'")
    assert_explained(dpc("info", scores, "--picture", "x.png"), 2, "'scores'", "dpc evaluate classification")
    write_scene(tmp_path / "scene.h5", toy_scene())
    assert_explained(dpc("info", tmp_path / "scene.h5", "--picture", "x.png"), 2, "'gaussians'", "generate4d render")


def test_evaluate_from_a_pipe_equals_a_file(scores: Path, clouds: Path) -> None:
    arguments = ["evaluate", "classification", "--truth", clouds, "--json"]
    direct, piped = dpc(*arguments, scores), dpc(*arguments, "-", stdin=scores.read_bytes())
    first, second = json.loads(direct.stdout), json.loads(piped.stdout)
    assert first["metrics"] == second["metrics"] and first["metrics"]["accuracy"] == 1
    assert first["denominators"]["samples"] == 2


def test_help_and_wrong_options() -> None:
    assert b"--picture" in dpc("info", "--help").stdout
    assert dpc("evaluate", "classification").returncode == 2
    assert dpc("info", "x.h5", "--nonsense").returncode == 2


def test_help_imports_nothing_heavy() -> None:
    heavy = ["torch", "open3d", "cv2", "numba", "scipy", "matplotlib", "sklearn", "h5py", "numpy"]
    code = (
        "import sys\nfrom dpcli.cli.app import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        f"print('HEAVY', [name for name in {heavy} if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, cwd=ROOT, timeout=60)
    assert result.stdout.decode().splitlines()[-1] == "HEAVY []"


def test_what_the_system_refuses_is_said_in_words(capsys) -> None:
    """Not as a bug: a folder that may not be read, a file where a folder should be. An error without a file is one."""
    from dpcli.cli.app import _explain

    for error in (
        PermissionError(13, "Permission denied", "there"),
        NotADirectoryError(20, "Not a directory", "there"),
    ):
        assert _explain(error) == 3
        said = capsys.readouterr().err
        assert said.startswith("dpc: error: there: ") and "Errno" not in said and "bug" not in said
    with pytest.raises(OSError):
        _explain(OSError(5, "Input/output error"))


def test_a_shipped_model_tells_its_classes_and_training(dpc_here):
    done = dpc_here("info", "msraction3d-24")
    assert done.returncode == 0, done.stderr.decode()
    text = " ".join(done.stdout.decode().split())
    for said in (
        "model, dpc-kinet-1",
        "class names 20: high arm wave",
        "config num frames 24",
        "notes trained on 266 videos",
        "timing clips",
        "msraction3d-24.md",
        "notes command dpc classify train",
    ):
        assert said in text, said
    told = json.loads(dpc_here("info", "articulated-compact", "--json").stdout)
    assert told["kind"] == "model" and told["format"] == "dpc-parts-1" and told["header"]["config"]["slots"] == 8


def test_a_training_folder_is_its_best_weights(dpc_here, tmp_path):
    """Counted by hand; another program's file has no configuration, and a cut one is told."""
    from safetensors.numpy import save_file

    (tmp_path / "run").mkdir()
    weights = tmp_path / "run" / "best.safetensors"
    save_file(
        {"a": np.zeros((3, 4), np.float16), "b": np.zeros(5, np.float32)},
        weights,
        {"note": "[not json", "weights": "x", "kind": "7", "class_names": "5", "loss": "NaN"},
    )
    for name in (weights, weights.parent):
        told = json.loads(dpc_here("info", name, "--json").stdout)
        assert (told["kind"], told["weights"], told["tensors"], told["types"]) == ("model", 17, 2, ["F16", "F32"])
        assert told["header"] == {"note": "[not json", "weights": "x", "kind": 7, "class_names": 5, "loss": "NaN"}
        assert told["format"] is None and told["card"] is None and told["file"] == str(weights)
    assert b"model, of another program" in dpc_here("info", weights).stdout
    refused = dpc_here("info", weights, "--picture", tmp_path / "x.png")
    assert refused.returncode == 2 and b"holds weights" in refused.stderr
    (weights.parent / "config.json").write_text("{}")
    last = weights.rename(weights.with_name("last.safetensors"))
    early = dpc_here("info", weights.parent)
    assert early.returncode == 3 and f"no best.safetensors yet; {last} has the weights".encode() in early.stderr
    last.rename(weights)
    weights.write_bytes(weights.read_bytes()[:-9])
    cut = dpc_here("info", weights)
    assert cut.returncode == 3 and b"not a complete safetensors file" in cut.stderr
    for other in (tmp_path, "msraction3d", "no/msraction3d-24", "*"):
        assert dpc_here("info", other).returncode == 3


def test_statistics_have_no_page_and_say_what_has(dpc_here, tmp_path: Path) -> None:
    truth = truth_sequence("s0", seed=0)
    paths = write_parts(tmp_path / "parts.h5", [perfect(truth, 4)]), write_truth(tmp_path / "truth.h5", [truth])
    evaluate_segmentation(*paths, keeping=Keeping(tmp_path / "kept.h5"))
    refused = dpc_here("info", tmp_path / "kept.h5", "--page", tmp_path / "k.html")
    assert refused.returncode == 2 and b"dpc evaluate report" in refused.stderr


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e3])
def test_dots_of_an_embedding_stay_apart_whatever_their_scale(scale: float) -> None:
    places = np.random.default_rng(0).normal(size=(40, 2)).astype(np.float32) * np.float32(scale)
    page = scatter_page(PageFacts("e", ""), [""] * 40, [], np.zeros(40, int), {"static": (places, {})})
    shown = json.loads(re.search(r'id="header">(.*?)</script>', page, re.S)[1])["planes"][0]["places"]
    assert np.abs(np.array(shown) - places).max() <= 1e-4 * np.ptp(places)


def test_settings_beside_a_model_that_another_program_wrote_are_told(dpc_here, tmp_path: Path) -> None:
    """TOML has dates and NaN, which JSON has not."""
    from safetensors.numpy import save_file

    save_file({"a": np.zeros(3, np.float32)}, tmp_path / "m.safetensors")
    (tmp_path / "settings.toml").write_text("made = 2024-01-02\n[train]\nlr = nan\nsteps = 5\n")
    said = json.loads(dpc_here("info", tmp_path / "m.safetensors", "--json").stdout)
    assert said["settings"] == {"made": "2024-01-02", "train": {"lr": "NaN", "steps": 5}}
    assert b"train lr                 NaN\n" in dpc_here("info", tmp_path / "m.safetensors").stdout


def test_provenance_with_nan_of_another_program_is_told(clouds: Path, dpc_here, tmp_path: Path) -> None:
    shutil.copy(clouds, tmp_path / "c.h5")
    with h5py.File(tmp_path / "c.h5", "r+") as file:
        file["provenance"][0] = '{"command": "theirs", "config": {"scale": NaN}}'
    done = dpc_here("info", tmp_path / "c.h5", "--json")
    assert json.loads(done.stdout)["provenance"] == [{"command": "theirs", "config": {"scale": "NaN"}}], done.stderr


@pytest.mark.parametrize("words", [("--sequence", "s0"), ("--view", "x-zy")])
def test_options_of_pictures_are_refused_without_one(clouds: Path, words: tuple[str, str], dpc_here) -> None:
    """Of a model as well, whose other options say that it has neither."""
    for file in (clouds, "msraction3d-24"):
        refused = dpc_here("info", file, *words)
        assert refused.returncode == 2 and words[0].encode() in refused.stderr and b"--page" in refused.stderr
