"""`dpc evaluate video`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.evaluate.options import Intersect, IntervalOptions, PictureOptions, word_option
from dpcli.cli.evaluate.output import print_result
from dpcli.cli.option_groups import with_option_groups
from dpcli.cli.options import Device
from dpcli.evaluate.choices import (
    BACKGROUNDS,
    FVD_VARIANTS,
    LPIPS_NETWORKS,
    VIDEO_METRICS,
    VIDEO_PROTOCOLS,
    parse_video_metrics,
)


@dataclass(frozen=True)
class ProtocolOptions:
    """Says what the numbers of a video stand for."""

    protocol: Annotated[
        str,
        word_option(
            "--protocol", VIDEO_PROTOCOLS, "Which views, sizes, colors and networks: those of this publication."
        ),
    ] = "dpc"
    background: Annotated[
        str | None, word_option("--background", tuple(BACKGROUNDS), "Color behind the object. Default: the protocol's.")
    ] = None
    lpips: Annotated[
        str | None, word_option("--lpips", LPIPS_NETWORKS, "Network of LPIPS. Default: the protocol's.")
    ] = None
    fvd: Annotated[
        str | None, word_option("--fvd", FVD_VARIANTS, "Published variant of FVD. Default: the protocol's.")
    ] = None
    hop: Annotated[
        int, typer.Option("--hop", min=1, help="Frames between the starts of two windows of FVD and FID-VID.")
    ] = 1


@with_option_groups
def video(
    predicted: Annotated[
        str, typer.Argument(help="Views or gaussians file (- for a pipe), folder of images, .npy array, or video file.")
    ],
    truth: Annotated[
        Path, typer.Option("--truth", help="The true video, of any of these kinds; a views file for a gaussians file.")
    ],
    *,
    choices: ProtocolOptions,
    metrics: Annotated[
        str | None,
        typer.Option(
            "--metrics",
            metavar="NAME,...",
            parser=lambda text: ",".join(parse_video_metrics(text)),
            help=f"Some of {', '.join(VIDEO_METRICS)}. Default: psnr, ssim, and what the files allow of psnr_foreground, "
            "silhouette_iou, parts, tracks and surface.",
        ),
    ] = None,
    intersect: Intersect = False,
    weights: Annotated[
        Path | None,
        typer.Option(
            "--weights", help="Folder of the networks' weights. Default: $DPC_WEIGHTS, else the user's cache."
        ),
    ] = None,
    device: Device = "auto",
    intervals: IntervalOptions,
    output: PictureOptions,
) -> None:
    """Evaluate a video or a 4D scene: PSNR, SSIM, LPIPS, CLIP, FVD, warping error, and a scene's parts, tracks and surface."""
    from dpcli.evaluate.commands.video import run_video
    from dpcli.evaluate.video.protocol import check_choices_of, video_protocol

    asked, networks = parse_video_metrics(metrics), {"lpips": choices.lpips, "fvd": choices.fvd, "hop": choices.hop}
    check_choices_of(asked, choices.background, **networks)
    result = run_video(
        predicted,
        truth,
        metrics=asked,
        protocol=video_protocol(choices.protocol, choices.background, **networks),
        intersect=intersect,
        weights=weights,
        device=device,
        resampling=intervals.resampling,
        picture=output.picture,
    )
    print_result(result, output)
