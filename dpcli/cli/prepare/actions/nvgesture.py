"""`dpc prepare nvgesture`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from dpcli.cli.prepare.conversion import ConversionOptions, run_conversion
from dpcli.cli.prepare.options import PixelCoordinates


def nvgesture(
    raw: Annotated[Path, typer.Argument(help="Folder of the official list files and Video_data/.")],
    *,
    foreground: Annotated[
        Literal["otsu", "none"],
        typer.Option("--foreground", help="otsu: only the hand, by Otsu's threshold. none: every pixel with a depth."),
    ] = "otsu",
    erode: Annotated[
        int, typer.Option("--erode", min=0, max=1000, help="Pixels eroded from the hand's rim (3x3 erosions).")
    ] = 1,
    coordinates: PixelCoordinates = "image",
    conversion: ConversionOptions,
) -> None:
    """Read NvGesture: 25 hand gestures in 8-bit depth, 1,532 clips of 20 subjects."""
    from dpcli.prepare.actions.nvgesture import NvGesture

    run_conversion(
        "nvgesture",
        lambda: NvGesture(raw=raw, foreground=foreground, erode=erode, coordinates=coordinates),
        conversion,
        raw,
    )
