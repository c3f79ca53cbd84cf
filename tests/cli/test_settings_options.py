"""Options made from settings: flags, choices, `--preset`, `--config`, `--set`, `--help-all`."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal

import pytest
import typer

from dpcli.cli.settings_options import options_of
from dpcli.errors import DataError, UsageError
from dpcli.runtime.settings.catalog import Catalog, Given
from dpcli.runtime.settings.fields import Settings, setting
from dpcli.runtime.settings.value_types import is_tuple, write_text
from tests.fuzz.fuzz_options import SETTINGS


@dataclass(frozen=True)
class Network(Settings):
    """What a network is made of."""

    num_frames: int = setting(16, "Frames per clip.", least=1, name="frames")
    centroids: tuple[int, int] = setting((1024, 512), "Neighborhoods of the two stages.", least=1)
    dropout: float = setting(0.0, "Dropout before the last layer.", least=0, below=1)


@dataclass(frozen=True)
class Schedule(Settings):
    """How long and how fast."""

    decay: Literal["cosine", "constant"] = setting("cosine", "Course of the learning rate.")
    learning_rate: float = setting(1e-3, "Adam's learning rate.", above=0, name="lr")
    amp: bool | None = setting(None, "Products in bfloat16.")
    drop_short: bool = setting(False, "Leave short videos out.")
    workers: int | None = setting(None, "Processes that load.", least=0)


CATALOG = Catalog(network=Network, schedule=Schedule)
PRESETS = {
    "thesis": {"network": Network(), "schedule": Schedule()},
    "quick": {"network": Network(centroids=(256, 128)), "schedule": Schedule()},
    "tiny": {"network": Network(centroids=(256, 128)), "schedule": Schedule()},
}
EVERYDAY = ("frames", "centroids", "decay", "lr", "amp", "drop_short", "workers")
app = typer.Typer(rich_markup_mode=None, add_completion=False)
received: list = []


@app.command()
@options_of(CATALOG, EVERYDAY, presets=PRESETS, preset="quick")
def train(
    data: Annotated[str, typer.Argument(help="A file.")],
    given: Given,
    output: Annotated[str, typer.Option("-o", "--output", help="A folder.")],
    seed: Annotated[int, typer.Option(help="A seed.")] = 0,
) -> None:
    """Train something."""
    received[:] = [data, given, output, seed]


@app.command()
@options_of(CATALOG, ("lr",))
def plain(given: Given) -> None:
    """Do something that has no presets."""
    received[:] = [given]


def run(*words: str) -> int:
    received.clear()
    return typer.main.get_command(app).main(args=list(words), prog_name="dpc", standalone_mode=False)


def refusal(*words: str) -> str:
    with pytest.raises((UsageError, DataError)) as caught:
        run(*words)
    assert received == []
    return str(caught.value)


def said(capsys, *words: str) -> str:
    assert run(*words) == 0
    assert received == []
    return capsys.readouterr().out


def test_a_command_gets_what_was_given(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text("dropout = 0.5\n")
    run(
        "train",
        "x.h5",
        "-o",
        "out",
        "--frames",
        "8",
        "--centroids",
        "4,2",
        "--decay",
        "constant",
        "--no-amp",
        "--drop-short",
        "--workers",
        "none",
        "--config",
        str(path),
        "--set",
        "lr=1",
        "--seed",
        "3",
        "--preset",
        "tiny",
    )
    flags = {"frames": 8, "centroids": (4, 2), "decay": "constant", "amp": False, "drop_short": True}
    data, given, output, seed = received
    assert (data, output, seed) == ("x.h5", "out", 3)
    assert given == Given("tiny", {"dropout": 0.5}, {"lr": 1.0}, {**flags, "workers": None})


def test_nothing_is_given_unless_said():
    run("train", "x.h5", "-o", "out")
    assert received[1] == Given("quick")
    run("plain")
    assert received == [Given(None)]


def test_switches_have_both_forms():
    for words, value in ((["--amp"], True), (["--no-amp"], False)):
        run("train", "x", "-o", "out", *words)
        assert received[1].flags == {"amp": value}


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--frames", "0"], "frames = 0: expected at least 1"),
        (["--frames", "x"], "frames = x: expected a whole number"),
        (["--lr", "nan"], "lr = nan: expected a number above 0"),
        (["--decay", "cosin"], "decay = cosin: expected one of cosine, constant; did you mean cosine?"),
        (["--centroids", "4"], "centroids = 4: expected 2 whole numbers, as 1024,512 on the command line"),
        (["--preset", "quik"], "preset = quik: expected one of thesis, quick, tiny; did you mean quick?"),
        (["--lr", "1", "--set", "lr=2"], "lr is given twice, by --lr and by --set; leave one out"),
        (["--drop-short", "--set", "drop-short=true"], "drop_short is given twice, by --drop-short and by --set"),
        (["--set", "lr=2", "--set", "lr=2"], "lr is given twice, by --set lr=2 and --set lr=2; leave one out"),
        (["--set", "lr"], "--set lr: expected NAME=VALUE, such as --set lr=0.001"),
        (["--set", "dropuot=0"], "unknown setting dropuot; did you mean dropout?"),
        (["--config", "/no/such.toml"], "/no/such.toml: no such file"),
    ],
)
def test_a_bad_option_is_told_before_any_work(words, sentence):
    assert refusal("train", "x.h5", "-o", "out", *words).startswith(sentence)


def test_an_unknown_option_is_refused():
    with pytest.raises(Exception, match="--dropout"):
        run("train", "x.h5", "-o", "out", "--dropout", "0.1")


def test_help_shows_everyday_options_alone(capsys):
    text = " ".join(said(capsys, "train", "--help").split())
    assert "--decay [cosine|constant] Course of the learning rate. [default: cosine]" in text
    assert "--centroids <int>,<int> Neighborhoods of the two stages. [default: the preset's; at least 1]" in text
    assert "--frames <int> Frames per clip. [default: 16; at least 1]" in text
    assert "--amp / --no-amp" in text and "--preset [thesis|quick|tiny]" in text and "[default: quick]" in text
    assert "--set NAME=VALUE" in text and "--config FILE" in text and "dropout" not in text
    assert "given" not in text
    assert "--preset" not in said(capsys, "plain", "--help")


def test_help_all_lists_every_setting(capsys, monkeypatch):
    for columns in (60, 100):
        monkeypatch.setenv("COLUMNS", str(columns))
        text = said(capsys, "train", "--help-all")
        assert all(len(line) <= columns for line in text.splitlines())
        assert text.startswith("Usage: dpc train [OPTIONS] ")
        words = " ".join(text.split())
        for name in CATALOG.settings:
            assert f" {name} " in words
        assert "[default: thesis 1024,512; quick, tiny 256,128]" in words
        assert "dropout <float> Dropout before the last layer. [at least 0 and below 1] [default: 0.0]" in words
        assert "network:" in text.splitlines() and "schedule:" in text.splitlines()


def test_help_all_comes_before_any_refusal(capsys):
    assert "schedule:" in said(capsys, "train", "--frames", "0", "--help-all")


def test_help_all_without_presets(capsys):
    assert "[default: 1024,512]" in " ".join(said(capsys, "plain", "--help-all").split())


def test_wrong_declarations_fail_at_once():
    def command(given: Given, frames: int = 1) -> None: ...

    with pytest.raises(KeyError):
        options_of(CATALOG, ("no_such",))
    with pytest.raises(ValueError, match="frames"):
        options_of(CATALOG, ("frames",))(command)


def test_shells_complete_words():
    command = typer.main.get_command(app).commands["train"]
    context = command.make_context("train", ["x", "-o", "y"])
    options = {one.opts[-1]: one for one in command.params}

    def complete(option: str, text: str) -> list[str]:
        return [item.value for item in options[option].shell_complete(context, text)]

    assert complete("--decay", "co") == ["cosine", "constant"]
    assert complete("--preset", "t") == ["thesis", "tiny"]
    assert complete("--set", "d") == [
        "dropout=",
        "decay=cosine",
        "decay=constant",
        "drop_short=true",
        "drop_short=false",
    ]


def test_neither_torch_nor_numpy_is_loaded():
    code = "import sys, dpcli.cli.settings_options; sys.exit(bool({'torch', 'numpy', 'h5py'} & set(sys.modules)))"
    root = Path(__file__).resolve().parents[2]
    assert subprocess.run([sys.executable, "-c", code], cwd=root).returncode == 0


def test_settings_far_above_the_usual_are_named_where_memory_ends(tmp_path):
    @options_of(CATALOG, ("lr",), presets=PRESETS, preset="quick")
    def greedy(given: Given) -> None:
        raise MemoryError("Unable to allocate 7.28 TiB for an array")

    (tmp_path / "s.toml").write_text("frames = 500000\n")
    words = {"config_file": tmp_path / "s.toml", "set_values": ["centroids=90000,512", "workers=1"], "lr": 0.1}
    with pytest.raises(
        UsageError, match=r"^frames = 500000, centroids = 90000,512, lr = 0.1: more memory would be needed"
    ):
        greedy(preset_name="quick", **words)
    with pytest.raises(MemoryError):
        greedy(preset_name="quick", config_file=None, set_values=["frames=8"], lr=None)


@pytest.mark.parametrize("catalog", SETTINGS.values())
def test_no_setting_takes_a_count_of_a_thousand_millions(catalog):
    """A size of gigabytes is refused before anything is made of it."""
    module, name = catalog
    whole = [one for one in getattr(import_module(module), name).settings.values() if "int" in str(one.hint).lower()]
    for one in whole:
        for value in (10**9, 10**12):
            text = write_text(one.default) if is_tuple(one.hint) and one.default else "0"
            with pytest.raises(UsageError, match=f"^{one.name} = "):
                one.parse(re.sub(r"\d+(?![.\d])", str(value), text))
