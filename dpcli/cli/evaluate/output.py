"""Prints what the commands of `dpc evaluate` found: tables, markdown, or one JSON object."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Any, TextIO

import typer

from dpcli.errors import DataError
from dpcli.standard_streams import printable, rich_console

if TYPE_CHECKING:
    from rich.table import Table

    from dpcli.cli.evaluate.options import FormOptions
    from dpcli.evaluate.results import Result
    from dpcli.evaluate.text_tables import TextTable


def print_result(result: Result, form: FormOptions) -> None:
    """Prints a result in the form asked for. Raises DataError afterwards where something that was asked for is missing."""
    if form.as_object:
        print_object(result.data)
    elif form.as_markdown:
        from dpcli.evaluate.text_tables import markdown_tables

        typer.echo(markdown_tables(result.tables, result.notes))
    else:
        print_tables(result.tables, result.notes, sys.stdout)
    if result.incomplete:
        raise DataError(result.incomplete)


def print_object(data: dict[str, Any]) -> None:
    """Prints one JSON object on a line."""
    typer.echo(json.dumps(data, allow_nan=False))


def print_tables(tables: list[TextTable], notes: list[str], stream: TextIO) -> None:
    """Writes tables, then notes, to a terminal, or plainly to a file; a hint stands for a table wider than the terminal."""
    console = rich_console(stream)
    for table in tables:
        if table.width > console.width:
            console.print(f"{table.title}: {table.width} columns wide; widen the terminal, or use --picture.\n")
        else:
            console.print(_rich_table(table), "")
    for note in notes:
        console.print(printable(note))


def _rich_table(table: TextTable) -> Table:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    made = Table(
        title=Text(table.title),
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1),
        pad_edge=False,
        title_style="bold",
        show_edge=False,
    )
    for position, name in enumerate(table.header):
        made.add_column(Text(name), justify="left" if position == 0 else "right", no_wrap=True)
    for row in table.rows:
        made.add_row(*(Text(cell) for cell in row))
    return made
