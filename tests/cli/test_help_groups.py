"""Help of groups: every command with its whole description, under its heading."""

from __future__ import annotations

import pytest
import typer
from typer.testing import CliRunner

from dpcli.cli import app as cli
from dpcli.cli.help_groups import SectionedGroup, first_paragraph

LONG = "A description of more than eighty letters, which a list of commands would cut at the end of its only line here."


def toy() -> typer.Typer:
    app = typer.Typer(cls=SectionedGroup, rich_markup_mode=None)

    @app.command(rich_help_panel="Fruit", help=LONG + "\n\nAnd a second paragraph.")
    def apple() -> None: ...

    @app.command(rich_help_panel="Roots", help="Short.")
    def carrot() -> None: ...

    @app.command(rich_help_panel="Fruit", help="Also short.")
    def watermelon() -> None: ...

    @app.command(help="Without a heading.")
    def other() -> None: ...

    @app.command(hidden=True, help="Nobody reads this.")
    def secret() -> None: ...

    return app


def help_of(app: typer.Typer, *words: str) -> str:
    done = CliRunner().invoke(app, [*words, "--help"])
    assert done.exit_code == 0
    return done.output


def test_commands_stand_under_their_headings_in_the_order_of_those():
    text = help_of(toy())
    places = [
        text.index(word) for word in ("Fruit:", "apple ", "watermelon ", "Roots:", "carrot ", "Commands:", "other ")
    ]
    assert places == sorted(places)
    assert "secret" not in text and "second paragraph" not in text


def test_descriptions_are_whole_and_aligned_whatever_the_section():
    text = help_of(toy())
    assert LONG in " ".join(text.split()) and "..." not in text.split("Fruit:")[1]
    columns = {
        line.index(words) for line in text.splitlines() for words in ("A description", "Short.") if words in line
    }
    assert len(columns) == 1


@pytest.mark.parametrize("words", [(), ("prepare",), ("prepare", "synthetic")], ids=" ".join)
def test_the_groups_of_dpc_fit_and_cut_nothing(words):
    text = help_of(cli.application([*words, "--help"]), *words)
    assert max(map(len, text.splitlines())) <= 80
    group = typer.main.get_command(cli.application([*words, "--help"]))
    for word in words:
        group = group.commands[word]
    for command in group.commands.values():
        assert first_paragraph(command.help) in " ".join(text.split())


def test_prepare_names_every_command_once_under_a_heading_of_its_own():
    group = typer.main.get_command(cli.application()).commands["prepare"]
    text = help_of(cli.application(["prepare", "--help"]), "prepare")
    lines = [line.split()[0] for line in text.splitlines() if line.startswith("  ") and line[2:3].strip()]
    assert set(group.commands) <= set(lines) and len(group.commands) > 20
    assert "Commands:" not in text  # each has a heading


def commands_of(group, path=()):
    for name, command in group.commands.items():
        yield from commands_of(command, (*path, name)) if hasattr(command, "commands") else [((*path, name), command)]


def test_every_command_shows_at_most_fifteen_options_of_its_own_and_each_option_once():
    """Rarer ones stand under headings of their own, those of the run last."""
    many = {}
    for path, command in commands_of(typer.main.get_command(cli.application())):
        context = typer.Context(command, info_name=path[-1])
        lines = command.get_help(context).split("\nOptions:\n")[1].splitlines()
        headings = [line for line in lines if line.strip() and not line.startswith(" ")]
        assert not headings or headings[-1] == "Running:" or "Running:" not in headings, path
        shown = [line for line in lines if line.startswith("  -")]
        assert len(shown) == sum(one.param_type_name == "option" for one in command.get_params(context)), path
        many[" ".join(path)] = sum(line in shown for line in lines[: (lines + [""]).index("")]) - 1  # without --help
    assert len(many) > 50 and max(many.values()) <= 15, {name: count for name, count in many.items() if count > 15}


def test_a_text_without_an_empty_line_is_its_own_first_paragraph():
    assert first_paragraph("") == "" and first_paragraph(" a\n b ") == "a b"
