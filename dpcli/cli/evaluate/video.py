"""`dpc evaluate video`: options in, one call, tables out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

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
from dpcli.cli.options import Device, Json, Picture, Seed
from dpcli.errors import DataError


def register(app: typer.Typer) -> None:
    """Add the command to `dpc evaluate`."""
    app.command("video")(video)


def video(
    predicted: Annotated[
        str, typer.Argument(help="Views or gaussians file (- for a pipe), folder of images, .npy, or video file.")
    ],
    truth: Annotated[Path, typer.Option("--truth", help="The true video; a views file for a gaussians file.")],
    metrics: Annotated[
        str | None,
        typer.Option(
            "--metrics",
            help="Of psnr, psnr_foreground, ssim, ms_ssim, lpips, clip, clip_spherical, clip_views, clip_temporal, fvd, "
            "fid_vid_r3d50, fid_vid_inception, warping, parts, tracks. Default: PSNR, SSIM, and what the files allow of "
            "parts and tracks.",
        ),
    ] = None,
    protocol: Annotated[
        str,
        typer.Option("--protocol", help="dpc, thesis, consistent4d, disco or torchmetrics: all choices in one word."),
    ] = "dpc",
    background: Annotated[
        str | None, typer.Option("--background", help="white or black behind the object. Default: the protocol's.")
    ] = None,
    intersect: Intersect = False,
    lpips: Annotated[str | None, typer.Option("--lpips", help="alex, vgg or squeeze. Default: the protocol's.")] = None,
    fvd: Annotated[
        str | None, typer.Option("--fvd", help="styleganv, videogpt, disco or consistent4d. Default: the protocol's.")
    ] = None,
    every: Annotated[
        int, typer.Option("--every", min=1, help="Windows of FVD and FID-VID start at each so many frames.")
    ] = 1,
    weights: Annotated[
        Path | None, typer.Option("--weights", help="Folder of networks. Default: $DPC_WEIGHTS, else the user's cache.")
    ] = None,
    confidence: Confidence = 0.95,
    resamples: Resamples = 2000,
    device: Device = "auto",
    seed: Seed = 0,
    as_markdown: Markdown = False,
    as_object: Json = False,
    picture: Picture = None,
) -> None:
    """PSNR, SSIM, learned metrics of a video or a 4D scene; a scene's parts and tracks where the truth has them."""
    check_output(as_object, as_markdown, picture)
    from dpcli.evaluate.bootstrap import Resampling
    from dpcli.evaluate.video.comparison import evaluate_video
    from dpcli.evaluate.video.difference_strip import Strip
    from dpcli.evaluate.video.protocol import BACKGROUNDS, check_picture_of, parse_metrics, video_protocol
    from dpcli.evaluate.video.tables import video_json, video_notes, video_tables
    from dpcli.store import input_file

    names, chosen = parse_metrics(metrics), video_protocol(protocol, background, lpips=lpips, fvd=fvd, every=every)
    check_picture_of(names, picture)
    strip = Strip(BACKGROUNDS[chosen.background]) if picture is not None else None
    with input_file(predicted) as path:
        report = evaluate_video(
            path,
            truth,
            metrics=names,
            protocol=chosen,
            intersect=intersect,
            seed=seed,
            watch=strip,
            weights=weights,
            device=_device(names, device),
            resampling=Resampling(resamples, confidence, seed),
        )
        if strip is not None:
            strip.save(picture)
        if as_object:
            print_object(video_json(report, predicted))
        else:
            print_tables(video_tables(report), video_notes(report), as_markdown)
    if report.missing:
        name, reason = next(iter(report.missing.items()))
        more = f" ({', '.join(list(report.missing)[1:])} neither)" if len(report.missing) > 1 else ""
        raise DataError(f"{name} not computed{more}: {reason}")


def _device(names: tuple[str, ...] | None, asked: str) -> str:
    """torch is loaded for the learned metrics only."""
    from dpcli.evaluate.video.network_metrics import LEARNED

    if not set(names or ()) & set(LEARNED) - {"warping"}:
        return "cpu"
    from dpcli.runtime.device import choose_device

    return str(choose_device(asked))
