"""`dpc evaluate`: numbers with a name, a denominator and a protocol."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.evaluate import compare as evaluate_compare
from dpcli.cli.evaluate import report as evaluate_report
from dpcli.cli.evaluate import video as evaluate_video
from dpcli.cli.evaluate import weights as evaluate_weights
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

app = typer.Typer(no_args_is_help=True)

Parts = Annotated[str, typer.Argument(help="Parts file, or - for a pipe.")]
Truth = Annotated[
    Path, typer.Option("--truth", help="Clouds file with the true parts; poses or scene_flow for motion.")
]
Split = Annotated[
    str | None, typer.Option("--split", help="Sequences of the truth that count, or all. Default: test if any.")
]
Protocol = Annotated[str, typer.Option("--protocol", help="dpc, or release: the published code's numbers.")]


@app.command()
def classification(
    scores: Annotated[str, typer.Argument(help="Scores file, or - for a pipe.")],
    truth: Annotated[Path | None, typer.Option("--truth", help="Clouds file whose labels count instead.")] = None,
    split: Annotated[
        str | None, typer.Option("--split", help="Samples that count, or all. Default: test if there are any.")
    ] = None,
    intersect: Intersect = False,
    confidence: Confidence = 0.95,
    resamples: Resamples = 2000,
    seed: Seed = 0,
    as_markdown: Markdown = False,
    as_object: Json = False,
    picture: Picture = None,
) -> None:
    """Accuracy, per class and per stream, and the confusion matrix of a scores file."""
    check_output(as_object, as_markdown, picture)
    from dpcli.evaluate.bootstrap import Resampling
    from dpcli.evaluate.classification.confusion_picture import confusion_picture
    from dpcli.evaluate.classification.protocol import as_json, evaluate_classification
    from dpcli.evaluate.classification.tables import markdown, print_report
    from dpcli.store import ScoresReader, input_file

    resampling = Resampling(resamples, confidence, seed)
    with input_file(scores) as path:
        report = evaluate_classification(path, truth, split, intersect=intersect, resampling=resampling)
        if picture is not None:
            confusion_picture(report, picture)
        if as_object:
            typer.echo(json.dumps(as_json(report, scores, ScoresReader(path).provenance), allow_nan=False))
        elif as_markdown:
            typer.echo(markdown(report))
        else:
            print_report(report, sys.stdout)


@app.command()
def segmentation(
    parts: Parts,
    truth: Truth,
    protocol: Protocol = "dpc",
    ignore_below: Annotated[
        int, typer.Option("--ignore-below", min=0, help="True parts of fewer points are ignored.")
    ] = 0,
    split: Split = None,
    intersect: Intersect = False,
    confidence: Confidence = 0.95,
    resamples: Resamples = 2000,
    seed: Seed = 0,
    as_markdown: Markdown = False,
    as_object: Json = False,
    picture: Picture = None,
) -> None:
    """AP, PQ, F1, precision and recall at IoU 0.5, mIoU and Rand index of a parts file."""
    check_output(as_object, as_markdown, picture)
    from dpcli.evaluate.bootstrap import Resampling
    from dpcli.evaluate.segmentation.class_bars import segmentation_picture
    from dpcli.evaluate.segmentation.protocol import evaluate_segmentation, segmentation_json
    from dpcli.evaluate.segmentation.tables import segmentation_notes, segmentation_tables
    from dpcli.store import input_file

    resampling = Resampling(resamples, confidence, seed)
    with input_file(parts) as path:
        report = evaluate_segmentation(
            path,
            truth,
            protocol=protocol,
            ignore_below=ignore_below,
            split=split,
            intersect=intersect,
            resampling=resampling,
        )
        if picture is not None:
            segmentation_picture(report, picture)
        if as_object:
            print_object(segmentation_json(report, parts, _provenance(path)))
        else:
            print_tables(segmentation_tables(report), segmentation_notes(report), as_markdown)


@app.command()
def motion(
    parts: Parts,
    truth: Truth,
    protocol: Protocol = "dpc",
    split: Split = None,
    intersect: Intersect = False,
    confidence: Confidence = 0.95,
    resamples: Resamples = 2000,
    seed: Seed = 0,
    as_markdown: Markdown = False,
    as_object: Json = False,
    picture: Picture = None,
) -> None:
    """EPE3D, AccS, AccR and Outlier of a parts file's flow, and the errors of its part motions."""
    check_output(as_object, as_markdown, picture)
    from dpcli.evaluate.bootstrap import Resampling
    from dpcli.evaluate.segmentation.class_bars import motion_picture
    from dpcli.evaluate.segmentation.motion_protocol import evaluate_motion, motion_json
    from dpcli.evaluate.segmentation.tables import motion_notes, motion_tables
    from dpcli.store import input_file

    resampling = Resampling(resamples, confidence, seed)
    with input_file(parts) as path:
        report = evaluate_motion(
            path, truth, protocol=protocol, split=split, intersect=intersect, resampling=resampling
        )
        if picture is not None:
            motion_picture(report, picture)
        if as_object:
            print_object(motion_json(report, parts, _provenance(path)))
        else:
            print_tables(motion_tables(report), motion_notes(report), as_markdown)


def _provenance(path: Path) -> list[dict]:
    from dpcli.store import PartsReader

    return PartsReader(path).provenance


for _more in (evaluate_video, evaluate_compare, evaluate_report, evaluate_weights):
    _more.register(app)
