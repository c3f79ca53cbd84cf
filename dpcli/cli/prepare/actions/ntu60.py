"""`dpc prepare ntu60`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.prepare.conversion import ConversionOptions, run_conversion
from dpcli.cli.prepare.options import Protocol


def ntu60(
    inputs: Annotated[
        list[Path], typer.Argument(help="Folders of nturgb+d_depth_masked, or ZIPs as downloaded (read in place).")
    ],
    *,
    protocol: Protocol = "xsub",
    intrinsics: Annotated[
        str, typer.Option("--intrinsics", help="peers (focal 280), kinect2, or a JSON file with fx fy cx cy, pixels.")
    ] = "peers",
    scale: Annotated[
        float, typer.Option("--scale", help="Millimeters per unit of length in the output; 1000: meters.")
    ] = 655.35,
    conversion: ConversionOptions,
) -> None:
    """Read NTU RGB+D 60: 60 actions in masked Kinect v2 depth, 56,880 videos of 40 subjects."""
    from dpcli.prepare.actions.ntu60 import NTU60, named_intrinsics

    run_conversion(
        "ntu60",
        lambda: NTU60(inputs=tuple(inputs), protocol=protocol, intrinsics=named_intrinsics(intrinsics), scale=scale),
        conversion,
    )
