"""`dpc evaluate`: numbers with a name, a denominator and a protocol."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.options import Json, Picture
from dpcli.errors import UsageError

app = typer.Typer(no_args_is_help=True, help="Compare what a model says with the truth.")


@app.callback()
def _group() -> None:
    """Keeps `classification` a subcommand while it is the only one."""


@app.command()
def classification(
    scores: Annotated[str, typer.Argument(help="Scores file, or - for a pipe.")],
    truth: Annotated[Path | None, typer.Option("--truth", help="Clouds file whose labels count instead.")] = None,
    split: Annotated[
        str | None, typer.Option("--split", help="Samples that count, or all. Default: test if there are any.")
    ] = None,
    as_markdown: Annotated[bool, typer.Option("--markdown", help="Print markdown tables.")] = False,
    as_object: Json = False,
    picture: Picture = None,
) -> None:
    """Accuracy, per class and per stream, and the confusion matrix of a scores file."""
    if as_object and as_markdown:
        raise UsageError("--json and --markdown: choose one form of output")
    from dpcli.evaluate.pictures import check_picture, confusion_picture
    from dpcli.evaluate.protocol import as_json, evaluate_classification
    from dpcli.evaluate.tables import markdown, print_report
    from dpcli.store import ScoresReader, input_file

    if picture is not None:
        check_picture(picture)
    with input_file(scores) as path:
        report = evaluate_classification(path, truth, split)
        if picture is not None:
            confusion_picture(report, picture)
        if as_object:
            typer.echo(json.dumps(as_json(report, scores, ScoresReader(path).provenance), allow_nan=False))
        elif as_markdown:
            typer.echo(markdown(report))
        else:
            print_report(report, sys.stdout)
