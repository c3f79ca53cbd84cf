"""Help of a group of commands: each with its whole description, under headings by what the commands are for."""

from __future__ import annotations

from typing import Any

from typer.core import TyperGroup

_OTHERS = "Commands"  # the heading over commands that name none


class SectionedGroup(TyperGroup):
    """A group whose help prints its commands in sections, with descriptions that wrap instead of being cut.

    The heading of a command is its ``rich_help_panel``; without one it stands under "Commands". Use it as
    ``typer.Typer(cls=SectionedGroup)``.
    """

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Writes one section for each heading, in the order in which the headings first appear."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for name in self.list_commands(ctx):
            command = self.get_command(ctx, name)
            if command is not None and not command.hidden:
                heading = getattr(command, "rich_help_panel", None)
                rows = sections.setdefault(heading if isinstance(heading, str) else _OTHERS, [])
                rows.append((name, first_paragraph(command.help or "")))
        width = max((len(name) for rows in sections.values() for name, _ in rows), default=0)
        for heading, rows in sections.items():
            with formatter.section(heading):
                formatter.write_dl([(name.ljust(width), text) for name, text in rows])


def first_paragraph(text: str) -> str:
    r"""Returns the text up to its first empty line, on one line.

    >>> first_paragraph("Any depth video,\n  8 or 16 bits.\n\nMore about it.")
    'Any depth video, 8 or 16 bits.'
    """
    return " ".join(text.strip().split("\n\n")[0].split())
