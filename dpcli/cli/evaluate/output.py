"""What the commands of `dpc evaluate` share: options, and forms of output."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from dpcli.errors import UsageError

Markdown = Annotated[bool, typer.Option("--markdown", help="Print markdown tables.")]
Intersect = Annotated[bool, typer.Option("--intersect", help="Compare what both sides have, list the rest.")]
Confidence = Annotated[float, typer.Option("--confidence", help="Of the intervals, between 0 and 1.")]
Resamples = Annotated[int, typer.Option("--resamples", min=0, help="For bootstrap intervals; 0 for none.")]


def check_output(as_object: bool, as_markdown: bool, picture: Path | None) -> None:
    """Wrong output options are said before the work."""
    if as_object and as_markdown:
        raise UsageError("--json and --markdown: choose one form of output")
    if picture is not None:
        from dpcli.evaluate.classification.confusion_picture import check_picture

        check_picture(picture)


def print_object(found: dict[str, Any]) -> None:
    """One JSON object on a line."""
    typer.echo(json.dumps(found, allow_nan=False))


def print_tables(tables: list[Any], notes: list[str], as_markdown: bool) -> None:
    """Tables for a person, or as markdown."""
    from dpcli.evaluate.classification import tables as forms

    if as_markdown:
        typer.echo(forms.markdown_tables(tables, notes))
    else:
        forms.print_tables(tables, notes, sys.stdout)
