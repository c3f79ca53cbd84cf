"""`dpc evaluate`: numbers with a name, a denominator and a protocol."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from dpcli.cli.options import Json, Picture, Seed
from dpcli.errors import UsageError

app = typer.Typer(no_args_is_help=True, help="Compare what a model says with the truth.")

Markdown = Annotated[bool, typer.Option("--markdown", help="Print markdown tables.")]
Parts = Annotated[str, typer.Argument(help="Parts file, or - for a pipe.")]
Truth = Annotated[Path, typer.Option("--truth", help="Clouds file with the true parts, and poses for motion.")]
Split = Annotated[
    str | None, typer.Option("--split", help="Sequences of the truth that count, or all. Default: test if any.")
]
Intersect = Annotated[bool, typer.Option("--intersect", help="Compare what both files have, list the rest.")]
Protocol = Annotated[str, typer.Option("--protocol", help="dpc, or release: the published code's numbers.")]


@app.command()
def classification(
    scores: Annotated[str, typer.Argument(help="Scores file, or - for a pipe.")],
    truth: Annotated[Path | None, typer.Option("--truth", help="Clouds file whose labels count instead.")] = None,
    split: Annotated[
        str | None, typer.Option("--split", help="Samples that count, or all. Default: test if there are any.")
    ] = None,
    as_markdown: Markdown = False,
    as_object: Json = False,
    picture: Picture = None,
) -> None:
    """Accuracy, per class and per stream, and the confusion matrix of a scores file."""
    _check_output(as_object, as_markdown, picture)
    from dpcli.evaluate.pictures import confusion_picture
    from dpcli.evaluate.protocol import as_json, evaluate_classification
    from dpcli.evaluate.tables import markdown, print_report
    from dpcli.store import ScoresReader, input_file

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
    as_markdown: Markdown = False,
    as_object: Json = False,
    picture: Picture = None,
) -> None:
    """AP, PQ, F1, precision and recall at IoU 0.5, mIoU and Rand index of a parts file."""
    _check_output(as_object, as_markdown, picture)
    from dpcli.evaluate.part_pictures import segmentation_picture
    from dpcli.evaluate.part_tables import segmentation_notes, segmentation_tables
    from dpcli.evaluate.segmentation_protocol import evaluate_segmentation, segmentation_json
    from dpcli.store import input_file

    with input_file(parts) as path:
        report = evaluate_segmentation(
            path, truth, protocol=protocol, ignore_below=ignore_below, split=split, intersect=intersect
        )
        if picture is not None:
            segmentation_picture(report, picture)
        if as_object:
            _print_object(segmentation_json(report, parts, _provenance(path)))
        else:
            _print_tables(segmentation_tables(report), segmentation_notes(report), as_markdown)


@app.command()
def motion(
    parts: Parts,
    truth: Truth,
    protocol: Protocol = "dpc",
    split: Split = None,
    intersect: Intersect = False,
    as_markdown: Markdown = False,
    as_object: Json = False,
    picture: Picture = None,
) -> None:
    """EPE3D, AccS, AccR and Outlier of a parts file's flow, and the errors of its part motions."""
    _check_output(as_object, as_markdown, picture)
    from dpcli.evaluate.motion_protocol import evaluate_motion, motion_json
    from dpcli.evaluate.part_pictures import motion_picture
    from dpcli.evaluate.part_tables import motion_notes, motion_tables
    from dpcli.store import input_file

    with input_file(parts) as path:
        report = evaluate_motion(path, truth, protocol=protocol, split=split, intersect=intersect)
        if picture is not None:
            motion_picture(report, picture)
        if as_object:
            _print_object(motion_json(report, parts, _provenance(path)))
        else:
            _print_tables(motion_tables(report), motion_notes(report), as_markdown)


@app.command()
def video(
    predicted: Annotated[
        str, typer.Argument(help="Views or gaussians file (- for a pipe), folder of images, .npy, or video file.")
    ],
    truth: Annotated[Path, typer.Option("--truth", help="The true video; a views file for a gaussians file.")],
    metrics: Annotated[
        str | None,
        typer.Option(
            "--metrics", help="Of psnr, psnr_foreground, ssim, ms_ssim, parts, tracks. Default: all but ms_ssim."
        ),
    ] = None,
    protocol: Annotated[
        str, typer.Option("--protocol", help="dpc, thesis, consistent4d or torchmetrics: ranges, borders, views.")
    ] = "dpc",
    background: Annotated[
        str | None, typer.Option("--background", help="white or black behind the object. Default: the protocol's.")
    ] = None,
    intersect: Annotated[bool, typer.Option("--intersect", help="Compare what both have, list the rest.")] = False,
    seed: Seed = 0,
    as_markdown: Markdown = False,
    as_object: Json = False,
    picture: Picture = None,
) -> None:
    """PSNR and SSIM per view of a video or a 4D scene; a scene's parts and tracks where the truth has them."""
    _check_output(as_object, as_markdown, picture)
    from dpcli.evaluate.video import evaluate_video
    from dpcli.evaluate.video_protocol import BACKGROUNDS, check_picture_of, parse_metrics, video_protocol
    from dpcli.evaluate.video_strip import Strip
    from dpcli.evaluate.video_tables import video_json, video_notes, video_tables
    from dpcli.store import input_file

    names, chosen = parse_metrics(metrics), video_protocol(protocol, background)
    check_picture_of(names, picture)
    strip = Strip(BACKGROUNDS[chosen.background]) if picture is not None else None
    with input_file(predicted) as path:
        report = evaluate_video(path, truth, metrics=names, protocol=protocol, background=background,
                                intersect=intersect, seed=seed, watch=strip)  # fmt: skip
        if strip is not None:
            strip.save(picture)
        if as_object:
            _print_object(video_json(report, predicted))
        else:
            _print_tables(video_tables(report), video_notes(report), as_markdown)


def _check_output(as_object: bool, as_markdown: bool, picture: Path | None) -> None:
    """Wrong output options are said before the work."""
    if as_object and as_markdown:
        raise UsageError("--json and --markdown: choose one form of output")
    if picture is not None:
        from dpcli.evaluate.pictures import check_picture

        check_picture(picture)


def _provenance(path: Path) -> list[dict]:
    from dpcli.store import PartsReader

    return PartsReader(path).provenance


def _print_object(found: dict[str, Any]) -> None:
    typer.echo(json.dumps(found, allow_nan=False))


def _print_tables(tables: list[Any], notes: list[str], as_markdown: bool) -> None:
    from dpcli.evaluate.tables import markdown_tables, print_tables

    if as_markdown:
        typer.echo(markdown_tables(tables, notes))
    else:
        print_tables(tables, notes, sys.stdout)
