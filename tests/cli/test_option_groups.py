"""Options that commands share: fields of a dataclass become options, and come back as an instance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import pytest
import typer
from typer.testing import CliRunner

from dpcli.cli.help_groups import SectionedCommand
from dpcli.cli.option_groups import with_option_groups


@dataclass(frozen=True)
class Camera:
    size: Annotated[int, typer.Option("--size", min=1, help="Side, pixels.")] = 512
    color: Annotated[Literal["gray", "red"], typer.Option("--color", help="Which.")] = "gray"


@dataclass(frozen=True)
class SmallCamera(Camera):
    HEADING: ClassVar[str] = "Small camera"
    size: Annotated[int, typer.Option("--size", min=1, help="Side of the small one.")] = 8


@pytest.fixture
def called():
    found = []

    def run(*words: str) -> tuple[int, str]:
        app = typer.Typer(rich_markup_mode=None)

        @app.command(cls=SectionedCommand)
        @with_option_groups
        def film(
            name: Annotated[str, typer.Argument(help="Its name.")],
            *,
            frames: Annotated[int, typer.Option("--frames")] = 4,
            camera: SmallCamera,
        ) -> None:
            """Film something."""
            found.append((name, frames, camera))

        done = CliRunner().invoke(app, list(words))
        return done.exit_code, done.output

    return run, found


def test_options_of_a_group_reach_the_command_as_one_instance(called):
    run, found = called
    assert run("fox", "--color", "red", "--frames", "2") == (0, "")
    assert run("fox", "--size", "9")[0] == 0
    assert found == [("fox", 2, SmallCamera(8, "red")), ("fox", 4, SmallCamera(9, "gray"))]


def test_help_and_errors_are_those_of_ordinary_options(called):
    run, found = called
    code, text = run("--help")
    assert code == 0 and "Film something." in text and "Side of the small one." in text
    assert text.index("--frames") < text.index("Small camera:") < min(text.index("--size"), text.index("--color"))
    assert text.index("--frames") < text.index("--size") < text.index("--color")
    for words, message in ((("--size", "0"), "greater than or equal to 1"), (("--color", "blue"), "'gray', 'red'")):
        code, text = run("fox", *words)
        assert code == 2 and message in text
    assert not found


def test_two_options_of_one_name_are_a_mistake():
    def film(size: int, camera: Camera) -> None: ...

    with pytest.raises(ValueError, match="film: an option is there twice among size, size, color"):
        with_option_groups(film)
