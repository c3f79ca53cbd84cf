"""`dpc classify predict`: its options, and what it prints."""

from __future__ import annotations

from typing import Annotated

import typer

from dpcli.cli.classify import predict_segments as cutting
from dpcli.cli.classify import predict_stream as streaming
from dpcli.cli.classify.options import Data, Model, RejectBelow, Split
from dpcli.cli.option_groups import with_option_groups
from dpcli.cli.options import Device, Force, Seed, TrustedBackbone
from dpcli.cli.spread_options import SpreadOptions
from dpcli.counted import counted
from dpcli.errors import UsageError


@with_option_groups
def predict(
    data: Data,
    model: Model,
    *,
    output: Annotated[
        str | None,
        typer.Option(
            "-o",
            "--output",
            help="File to write, or - for a pipe; --segments: .csv or .json. With --stream: may be left out.",
        ),
    ] = None,
    backbone: TrustedBackbone = None,
    split: Split = "auto",
    clips_per_video: Annotated[int, typer.Option(help="Clips spread evenly over a video; 0 takes every start.")] = 0,
    drop_short: Annotated[
        bool, typer.Option("--drop-short", help="Leave out videos shorter than a clip instead of padding.")
    ] = False,
    batch: Annotated[int, typer.Option(help="Clips at a time.")] = 8,
    segments: cutting.SegmentOptions,
    stream: streaming.StreamOptions,
    windows: streaming.WindowOptions,
    reject_below: RejectBelow = None,
    seed: Seed = 0,
    device: Device = "auto",
    spread: SpreadOptions,
    force: Force = False,
) -> None:
    """Write class scores of every video: softmax averaged over its clips, for each stream and fused."""
    from dpcli.classify.commands.model_task import ModelTask

    task = ModelTask(data, model, output, backbone, split, seed, device, force)
    batch_options = {"clips-per-video": clips_per_video != 0, "drop-short": drop_short, "batch": batch != 8}
    batch_options |= {"jobs": spread.jobs is not None, "shard": bool(spread.shard), "dask": bool(spread.dask)}
    if stream.stream:
        others = {"split": split != "auto", "segments": segments.segments, "shortest": segments.shortest is not None}
        streaming.refuse("--stream, which is one video, as it comes", others | batch_options)
        streaming.predict_stream(task, stream, windows, reject_below)
        return
    streaming.require("--stream", follow=stream.follow, json=stream.json_output, page=stream.page)
    if segments.segments:
        streaming.refuse("--segments, which looks at every frame of a recording in order", batch_options)
        cutting.predict_segments(task, windows, segments.shortest, reject_below)
        return
    streaming.require("--stream or --segments", **vars(windows))
    streaming.require("--segments", shortest=segments.shortest)
    if output is None:
        raise UsageError("Missing option '-o' / '--output'.")
    if batch < 1 or clips_per_video < 0:
        raise UsageError("--batch must be at least 1 and --clips-per-video at least 0")
    from dpcli.classify.commands.predict import predict as run

    result = run(task, clips_per_video or None, drop_short, batch, spread.spread, reject_below)
    if result.complete:
        typer.echo(f"{output}: complete")
    elif output != "-":
        typer.echo(f"{output}: scores of {counted(result.videos, 'video')} in {counted(result.classes, 'class')}")
