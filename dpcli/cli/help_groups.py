"""Help in sections: commands under headings by what they are for, and the options of one command likewise."""

from __future__ import annotations

from typing import Any

from typer.core import TyperCommand, TyperGroup

_OTHER_COMMANDS = "Commands"  # the heading over commands that name none
_OTHER_OPTIONS = "Options"
SETTINGS = "Settings"
RUNNING = "Running"
LABELS = "Labels and splits"


class SectionedGroup(TyperGroup):
    """Prints, as the help of a group, its commands in sections, with descriptions that wrap instead of being cut.

    The heading of a command is its ``rich_help_panel``; without one it stands under "Commands".
    """

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Writes one section for each heading, in the order in which the headings first appear."""
        commands = [command for name in self.list_commands(ctx) if (command := self.get_command(ctx, name))]
        rows = [
            (_heading(one, _OTHER_COMMANDS), (one.name, first_paragraph(one.help or "")))
            for one in commands
            if not one.hidden
        ]
        width = max((len(name) for _, (name, _) in rows), default=0)
        _write_sections([(heading, (name.ljust(width), text)) for heading, (name, text) in rows], formatter)


class SectionedCommand(TyperCommand):
    """Prints, as the help of a command, its arguments and own options, then those under other headings, those of the run last.

    The heading of an option is its ``rich_help_panel``; without one it stands under "Options".
    """

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Writes one section for each heading."""
        rows = []
        for one in self.get_params(ctx):
            record = one.get_help_record(ctx)
            if record is not None:
                rows.append((_heading(one, _OTHER_OPTIONS if one.param_type_name == "option" else "Arguments"), record))
        places = {"Arguments": 0, _OTHER_OPTIONS: 1, RUNNING: 3}  # all others between, as they come
        _write_sections(sorted(rows, key=lambda row: places.get(row[0], 2)), formatter)


def _heading(command_or_option: Any, default: str) -> str:
    heading = getattr(command_or_option, "rich_help_panel", None)
    return heading if isinstance(heading, str) else default  # typer's placeholder stands where none was given


def _write_sections(rows: list[tuple[str, tuple[str, str]]], formatter: Any) -> None:
    sections: dict[str, list[tuple[str, str]]] = {}
    for heading, row in rows:
        sections.setdefault(heading, []).append(row)
    for heading, lines in sections.items():
        with formatter.section(heading):
            formatter.write_dl(lines)


def first_paragraph(text: str) -> str:
    r"""Returns the text up to its first empty line, on one line.

    >>> first_paragraph("Any depth video,\n  8 or 16 bits.\n\nMore about it.")
    'Any depth video, 8 or 16 bits.'
    """
    return " ".join(text.strip().split("\n\n")[0].split())
