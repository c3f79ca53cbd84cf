"""`dpc classify predict`: its options, and what it prints."""

from __future__ import annotations

from typing import Annotated

import typer

from dpcli.cli.classify import predict_stream as streaming
from dpcli.cli.classify.options import Data, Model, Split
from dpcli.cli.option_groups import with_option_groups
from dpcli.cli.options import Device, Force, Seed, TrustedBackbone
from dpcli.cli.spread_options import SpreadOptions
from dpcli.errors import UsageError


@with_option_groups
def predict(
    data: Data,
    model: Model,
    *,
    output: Annotated[
        str | None,
        typer.Option("-o", "--output", help="File to write, or - for a pipe. With --stream: may be left out."),
    ] = None,
    backbone: TrustedBackbone = None,
    split: Split = "auto",
    clips_per_video: Annotated[int, typer.Option(help="Clips spread evenly over a video; 0 takes every start.")] = 0,
    drop_short: Annotated[
        bool, typer.Option("--drop-short", help="Leave out videos shorter than a clip instead of padding.")
    ] = False,
    batch: Annotated[int, typer.Option(help="Clips at a time.")] = 8,
    stream: streaming.Stream = False,
    hop: streaming.Hop = None,
    window: streaming.Window = None,
    follow: streaming.Follow = None,
    seed: Seed = 0,
    device: Device = "auto",
    spread: SpreadOptions,
    json_output: streaming.JsonLines = False,
    force: Force = False,
) -> None:
    """Write class scores of every video: softmax averaged over its clips, for each stream and fused."""
    from dpcli.classify.commands.model_task import ModelTask

    task = ModelTask(data, model, output, backbone, split, seed, device, force)
    if stream:
        batch_options = {"split": split != "auto", "clips-per-video": clips_per_video != 0}
        batch_options |= {"drop-short": drop_short, "batch": batch != 8}
        batch_options |= {"jobs": spread.jobs is not None, "shard": bool(spread.shard), "dask": bool(spread.dask)}
        streaming.refuse_batch_options(batch_options)
        streaming.predict_stream(task, hop, window, follow, json_output)
        return
    streaming.require_stream(hop=hop, window=window, follow=follow, json=json_output)
    if output is None:
        raise UsageError("Missing option '-o' / '--output'.")
    if batch < 1 or clips_per_video < 0:
        raise UsageError("--batch must be at least 1 and --clips-per-video at least 0")
    from dpcli.classify.commands.predict import predict as run

    result = run(task, clips_per_video or None, drop_short, batch, spread.spread)
    if result.complete:
        typer.echo(f"{output}: complete")
    elif output != "-":
        typer.echo(f"{output}: scores of {result.videos} videos in {result.classes} classes")
