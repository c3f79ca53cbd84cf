"""Options that commands of `dpc evaluate` share: groups of them, and words of which a wrong one ends at once."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from dpcli.cli.evaluate.app import ROOM
from dpcli.cli.evaluate.options import word_option
from dpcli.cli.option_groups import with_option_groups
from dpcli.errors import UsageError
from tests.support.commands import exit_code
from tests.support.evaluating import evaluate


@dataclass(frozen=True)
class Paint:
    color: Annotated[str, word_option("--color", ("red", "green"), "What to paint with.")] = "red"
    coats: Annotated[int, typer.Option("--coats", min=1, help="How often.")] = 2


@pytest.fixture
def run():
    seen = []

    @with_option_groups
    def paint(what: str, *, paint: Paint, dry: bool = False) -> None:
        """Paints something."""
        seen.append((what, paint, dry))

    app = typer.Typer(rich_markup_mode=None)
    app.command()(paint)

    def call(*words: str):
        result = CliRunner().invoke(app, words)
        if isinstance(result.exception, UsageError):
            raise result.exception
        return result, seen

    return call


def test_a_group_is_options_where_it_stands_and_one_value_in_the_command(run) -> None:
    _, seen = run("door", "--coats", "3", "--dry")
    assert seen == [("door", Paint("red", 3), True)]
    listed = run("--help")[0].output
    assert listed.index("--color [red|green]") < listed.index("--coats") < listed.index("--dry")
    assert "Paints something." in listed and "[default: red]" in listed


def test_wrong_values_end_before_the_command(run) -> None:
    with pytest.raises(UsageError, match="--color gren: expected red or green; did you mean green?"):
        run("door", "--color", "gren")
    assert run("door", "--coats", "0")[0].exit_code == 2
    assert run("--help")[1] == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("segmentation", "p.h5", "--truth", "t.h5", "--protocol", "relese"), "did you mean release"),
        (("motion", "p.h5", "--truth", "t.h5", "--protocol", "thesis"), "expected dpc or release"),
        (("video", "p.h5", "--truth", "t.h5", "--protocol", "dpcc"), "expected dpc, thesis, consistent4d"),
        (("video", "p.h5", "--truth", "t.h5", "--background", "wite"), "did you mean white"),
        (("video", "p.h5", "--truth", "t.h5", "--metrics", "psmr"), "--metrics psmr"),
        (("compare", "a.h5", "b.h5", "--json", "--markdown"), "choose one form"),
        (("runs", "a.h5", "--confidence", "95"), "--confidence 95"),
    ],
)
def test_wrong_words_end_before_a_file_is_opened(words, message) -> None:
    with pytest.raises(UsageError, match=message):
        evaluate(*words, raising=True)


def test_every_option_is_described_in_a_whole_phrase() -> None:
    """A help begins with a capital letter, and says more than a word."""
    for command in ROOM.application().registered_commands:
        for name, one in inspect.signature(command.callback, eval_str=True).parameters.items():
            (info,) = [own for own in one.annotation.__metadata__ if hasattr(own, "help")]
            assert info.help and len(info.help.split()) > 1, (command.callback.__name__, name)
            assert info.help[0].isupper() or info.help.startswith(("psnr", "auto")), (command.callback.__name__, name)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("--lpips vgg", "--lpips is of lpips: name it in --metrics, too"),
        ("--lpips vgg --metrics psnr,clip", "--lpips is of lpips"),
        ("--fvd videogpt --metrics lpips", "--fvd is of fvd"),
        ("--hop 3 --metrics lpips", "--hop is of fvd, fid_vid_r3d50, fid_vid_inception"),
        ("--background black --metrics parts,tracks", "--background black: parts, tracks compare no pictures"),
    ],
)
def test_a_choice_of_a_video_that_no_metric_depends_on_is_refused(words, sentence, tmp_path, capsys) -> None:
    files = ("none.h5", "--truth", "none.h5")
    assert exit_code("evaluate", "video", *files, *words.split()) == 2
    assert sentence in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    "words", ["--lpips vgg --metrics lpips", "--hop 3 --metrics fid_vid_r3d50", "--background black"]
)
def test_a_choice_of_a_video_that_a_metric_depends_on_is_taken(words, tmp_path, capsys) -> None:
    assert exit_code("evaluate", "video", tmp_path / "none.h5", "--truth", tmp_path / "none.h5", *words.split()) == 3
    assert "none.h5" in capsys.readouterr().err
