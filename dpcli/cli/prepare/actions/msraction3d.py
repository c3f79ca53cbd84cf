"""`dpc prepare msraction3d`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.prepare.conversion import ConversionOptions, run_conversion
from dpcli.cli.prepare.lists import whole_numbers


def msraction3d(
    raw: Annotated[Path, typer.Argument(help="Folder of aAA_sSS_eEE_sdepth.bin (official) or .mat files.")],
    *,
    focal: Annotated[
        float, typer.Option("--focal", help="Focal length, pixels; the default is that of the published protocols.")
    ] = 280.0,
    scale: Annotated[float, typer.Option("--scale", help="Raw depth units per unit of length in the output.")] = 300.0,
    train_subjects: Annotated[
        str, typer.Option("--train-subjects", help="Subjects whose videos are split train; all others are test.")
    ] = "1,2,3,4,5",
    conversion: ConversionOptions,
) -> None:
    """Read MSR-Action3D: 20 actions in Kinect depth, 567 videos of 10 subjects."""
    from dpcli.prepare.actions.msraction3d import MSRAction3D

    subjects = whole_numbers(train_subjects, "--train-subjects")
    run_conversion(
        "msraction3d", lambda: MSRAction3D(raw=raw, focal=focal, scale=scale, train_subjects=subjects), conversion, raw
    )
