"""`dpc classify explain`: where in a clip a network acts, and how far apart videos are."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from dpcli.classify.explain.pac_settings import PAC
from dpcli.cli.classify.options import Data, Model, Split, Stream
from dpcli.cli.options import Device, Force, Json, Output, Seed, TrustedBackbone
from dpcli.cli.settings_options import options_of
from dpcli.counted import counted
from dpcli.errors import UsageError
from dpcli.runtime.settings.catalog import Given


@options_of(PAC)
def pac(
    data: Data,
    model: Model,
    output: Output,
    given: Given,
    picture: Annotated[
        Path | None, typer.Option("--picture", help="Write a picture (.png): rows samples and streams, columns frames.")
    ] = None,
    animation: Annotated[
        Path | None,
        typer.Option("--animation", help="Write an animation (.gif or .mp4), streams side by side, 6 frames/s."),
    ] = None,
    samples: Annotated[
        str, typer.Option(help="Names of videos with commas between, or how many, over all classes.")
    ] = "4",
    split: Split = "auto",
    stream: Stream = None,
    backbone: TrustedBackbone = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
) -> None:
    """Write point activation clouds: each point of a video's middle clip with its activation, 0 to 1 over the clip.

    Settings (--set): rule=activation|gradient, class, stage, frames and view of the picture.
    """
    from dpcli.classify.commands.explain_pac import PacRequest, explain_pac
    from dpcli.classify.commands.model_task import ModelTask
    from dpcli.classify.explain.pac_settings import PacSettings

    settings = PAC.resolve({"pac": PacSettings()}, given)["pac"]
    task = ModelTask(data, model, output, backbone, split, seed, device, force)
    done = explain_pac(task, PacRequest(samples, stream, settings, picture, animation))
    if output != "-":
        typer.echo(
            f"{output}: activations of {done.points:,} points in {counted(done.clips, 'clip')} of {counted(done.frames, 'frame')}"
        )


def tsne(
    data: Data,
    model: Model,
    output: Output,
    picture: Annotated[
        Path | None,
        typer.Option("--picture", help="Write a picture (.png, .pdf, .svg): a panel a stream, a dot a video."),
    ] = None,
    stream: Stream = None,
    split: Split = "auto",
    perplexity: Annotated[
        float | None,
        typer.Option(
            help="Perplexity of t-SNE: about how many neighbors stay near. Default: 30, at most a third of the videos."
        ),
    ] = None,
    clips_per_video: Annotated[int, typer.Option(min=0, help="Clips averaged for a video; 0 takes every start.")] = 4,
    batch: Annotated[int, typer.Option(help="Clips at a time.")] = 8,
    backbone: TrustedBackbone = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
    json_output: Json = False,
) -> None:
    """Map videos into the plane by t-SNE of the vectors before the last layer; say how well neighbors and classes agree."""
    if batch < 1:
        raise UsageError(f"--batch {batch}: expected at least 1")
    from dpcli.classify.commands.explain_tsne import TsneRequest, explain_tsne
    from dpcli.classify.commands.model_task import ModelTask
    from dpcli.runtime.progress import log

    task = ModelTask(data, model, output, backbone, split, seed, device, force)
    result = explain_tsne(task, TsneRequest(stream, perplexity, clips_per_video or None, batch, picture))
    if json_output and output != "-":
        typer.echo(json.dumps(result.report()))
        return
    show = log.info if output == "-" else typer.echo
    for line in result.lines():
        show(line)
