"""`dpc evaluate compare` and `dpc evaluate runs`: is a difference more than chance, and how much do runs differ."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dpcli.cli.evaluate.output import (
    Confidence,
    Intersect,
    Markdown,
    Resamples,
    check_output,
    print_object,
    print_tables,
)
from dpcli.cli.options import Json, Picture, Seed
from dpcli.errors import UsageError

if TYPE_CHECKING:
    from dpcli.evaluate.compare.sample_metrics import Question

Truth = Annotated[
    Path | None, typer.Option("--truth", help="The truth: clouds file for parts, video for videos and scenes.")
]
Metrics = Annotated[
    str | None, typer.Option("--metrics", help="Such as accuracy or miou,ap,epe3d. Default: all there are.")
]
Protocol = Annotated[str, typer.Option("--protocol", help="Of parts: dpc or release; of videos: as evaluate video.")]
IgnoreBelow = Annotated[int, typer.Option("--ignore-below", min=0, help="True parts of fewer points are ignored.")]
Split = Annotated[str | None, typer.Option("--split", help="Samples that count, or all. Default: test if any.")]


def register(app: typer.Typer) -> None:
    """Add the two commands to `dpc evaluate`."""
    app.command()(compare)
    app.command()(runs)


def compare(
    first: Annotated[str, typer.Argument(metavar="A", help="Scores or parts file, scene or video; - for a pipe.")],
    second: Annotated[str, typer.Argument(metavar="B", help="Another of the same samples.")],
    truth: Truth = None,
    metrics: Metrics = None,
    protocol: Protocol = "dpc",
    ignore_below: IgnoreBelow = 0,
    split: Split = None,
    intersect: Intersect = False,
    confidence: Confidence = 0.95,
    resamples: Resamples = 2000,
    seed: Seed = 0,
    as_markdown: Markdown = False,
    as_object: Json = False,
    picture: Picture = None,
) -> None:
    """Two predictions of the same samples: differences with paired intervals and p values, and what changed most."""
    check_output(as_object, as_markdown, picture)
    from dpcli.evaluate.bootstrap import Resampling
    from dpcli.evaluate.compare.paired import compare_json, evaluate_compare
    from dpcli.evaluate.compare.tables import compare_notes, compare_picture, compare_tables

    resampling = Resampling(resamples, confidence, seed)
    question = _question(truth, metrics, protocol, split, ignore_below, intersect)
    with ExitStack() as stack:
        paths = _opened(stack, [first, second])
        report = evaluate_compare(paths[0], paths[1], question, resampling, (first, second))
    if picture is not None:
        compare_picture(report, picture)
    if as_object:
        print_object(compare_json(report))
    else:
        print_tables(compare_tables(report), compare_notes(report), as_markdown)


def runs(
    files: Annotated[
        list[str],
        typer.Argument(metavar="FILE...", help="Scores or parts files, scenes, videos, or JSON that evaluate printed."),
    ],
    truth: Truth = None,
    metrics: Metrics = None,
    protocol: Protocol = "dpc",
    ignore_below: IgnoreBelow = 0,
    split: Split = None,
    confidence: Confidence = 0.95,
    as_markdown: Markdown = False,
    as_object: Json = False,
) -> None:
    """The same evaluation of several runs (seeds): one row each, mean and standard deviation, t interval of the mean."""
    check_output(as_object, as_markdown, None)
    if not 0 < confidence < 1:
        raise UsageError(f"--confidence {confidence:g}: expected a share between 0 and 1, such as 0.95")
    from dpcli.evaluate.compare.runs import evaluate_runs, runs_json
    from dpcli.evaluate.compare.tables import runs_notes, runs_tables

    with ExitStack() as stack:
        question = _question(truth, metrics, protocol, split, ignore_below, False)
        report = evaluate_runs(_opened(stack, files), question, confidence, files)
    if as_object:
        print_object(runs_json(report))
    else:
        print_tables(runs_tables(report), runs_notes(report), as_markdown)


def _opened(stack: ExitStack, arguments: list[str]) -> list[Path]:
    from dpcli.store import input_file

    if arguments.count("-") > 1:
        raise UsageError("-: a pipe holds one file; name the others")
    return [stack.enter_context(input_file(argument)) for argument in arguments]


def _question(
    truth: Path | None, metrics: str | None, protocol: str, split: str | None, ignore_below: int, intersect: bool
) -> Question:
    from dpcli.evaluate.compare.sample_metrics import Question

    names = None
    if metrics is not None:
        names = tuple(dict.fromkeys(name.strip() for name in metrics.split(",") if name.strip()))
        if not names:
            raise UsageError("--metrics: names none; expected some such as accuracy or miou,ap")
    return Question(truth, names, protocol, split, ignore_below, intersect)
