"""`dpc classify explain`: where in a clip, and how far apart videos are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.options import Device, Force, Json, Output, Seed, TrustedBackbone
from dpcli.errors import UsageError

app = typer.Typer(no_args_is_help=True, help="Look into a model: activations of points (pac), maps of videos (tsne).")

Data = Annotated[str, typer.Argument(help="A clouds file, or - for a pipe.")]
Model = Annotated[
    str, typer.Option("--model", help="A .safetensors file, a folder made by train, or a shipped model's name.")
]
Split = Annotated[
    str,
    typer.Option(
        help="Which samples: a split's name, all, auto (test where there is one), or validation: the training videos that"
        " the model's training held out."
    ),
]
Stream = Annotated[
    str | None,
    typer.Option(
        "--stream", help="One or more of static, dynamic, fused, with commas between. Default: static,dynamic."
    ),
]


@app.command()
def pac(
    data: Data,
    model: Model,
    output: Output,
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
    rule: Annotated[
        str,
        typer.Option(
            help="activation (thesis A.1.4: the largest activation, whatever the class) or gradient (Grad-CAM)."
        ),
    ] = "activation",
    target: Annotated[
        str | None,
        typer.Option("--class", help="With --rule gradient: a class's name or number, predicted (default) or label."),
    ] = None,
    stage: Annotated[
        int | None,
        typer.Option(min=1, help="Stage of the network, from 1. Default: 1 for activation, the last for gradient."),
    ] = None,
    frames: Annotated[int, typer.Option(min=1, max=60, help="Columns of the picture: frames of the clip.")] = 8,
    view: Annotated[
        str | None, typer.Option(help="Axes that point right, down and away in pictures, such as xyz or x-zy (z up).")
    ] = None,
    backbone: TrustedBackbone = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
) -> None:
    """Point activation clouds: each point of a video's middle clip with its activation, 0 to 1 over the clip."""
    from dpcli.classify.commands.explain import run_pac

    run_pac(
        data,
        model,
        output,
        picture=picture,
        animation=animation,
        samples=samples,
        split=split,
        stream=stream,
        rule=rule,
        target=target,
        stage=stage,
        frames=frames,
        view=view,
        seed=seed,
        device=device,
        force=force,
        backbone=backbone,
    )


@app.command()
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
        float | None, typer.Option(help="Neighbors that t-SNE keeps near. Default: 30, at most a third of the videos.")
    ] = None,
    clips_per_video: Annotated[int, typer.Option(min=0, help="Clips averaged for a video; 0 takes every start.")] = 4,
    batch: Annotated[int, typer.Option(help="Clips at a time.")] = 8,
    backbone: TrustedBackbone = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
    json_output: Json = False,
) -> None:
    """Videos in the plane by t-SNE of the vectors before the last layer; beside it, how well neighbors and classes agree."""
    if batch < 1:
        raise UsageError(f"--batch {batch}: expected at least 1")
    from dpcli.classify.commands.explain import run_tsne

    run_tsne(
        data,
        model,
        output,
        picture=picture,
        stream=stream,
        split=split,
        perplexity=perplexity,
        clips_per_video=clips_per_video or None,
        batch=batch,
        seed=seed,
        device=device,
        force=force,
        json_output=json_output,
        backbone=backbone,
    )
