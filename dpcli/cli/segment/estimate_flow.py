"""`dpc segment estimate-flow`."""

from __future__ import annotations

from typing import Annotated

import typer

from dpcli.cli.option_groups import with_option_groups
from dpcli.cli.options import Device, Force, Output, Seed
from dpcli.cli.spread_options import SpreadOptions
from dpcli.counted import counted


@with_option_groups
def estimate_flow(
    data: Annotated[str, typer.Argument(help="A clouds file, or - for a pipe.")],
    output: Output,
    *,
    flow: Annotated[
        str,
        typer.Option(
            help="How flow is estimated: icp (rigid bodies), nearest (point), or the file or folder of a trained estimator"
            " (dpc segment flow)."
        ),
    ] = "icp",
    points: Annotated[
        int, typer.Option(min=0, help="Points drawn from each frame; 0 takes all. Smaller frames are kept whole.")
    ] = 512,
    as_points: Annotated[
        bool,
        typer.Option(
            "--as-points",
            help="Write the flow as the points themselves, for a second classifier; scaled, one factor a sequence, so that "
            "its norms' 99th percentile is that of the points' distances from their mean.",
        ),
    ] = False,
    split: Annotated[str, typer.Option("--split", help="Sequences of this split, or all.")] = "all",
    seed: Seed = 0,
    device: Device = "auto",
    spread: SpreadOptions,
    force: Force = False,
) -> None:
    """Write the scene flow of every frame to the next (in the last frame, to the one before) as the field scene_flow of a clouds file."""
    from dpcli.segment.commands.estimate_flow import estimate_flow_of_file

    done = estimate_flow_of_file(
        data,
        output,
        flow=flow,
        points=points,
        as_points=as_points,
        split=split,
        seed=seed,
        device=device,
        force=force,
        spread=spread.spread,
    )
    if output != "-":
        typer.echo(f"{output}: flow of {counted(done.sequences, 'sequence')}, {counted(done.frames, 'frame')}")
