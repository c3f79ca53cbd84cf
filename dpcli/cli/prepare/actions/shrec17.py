"""`dpc prepare shrec17`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from dpcli.cli.prepare.conversion import ConversionOptions, run_conversion
from dpcli.cli.prepare.options import PixelCoordinates


def shrec17(
    raw: Annotated[Path, typer.Argument(help="Folder of train_gestures.txt, test_gestures.txt and gesture_1/ ...")],
    *,
    classes: Annotated[
        Literal["28", "14"], typer.Option("--classes", help="Classes: 28 (gesture and fingers) or 14 (gesture).")
    ] = "28",
    bbox: Annotated[
        bool,
        typer.Option(
            "--bbox/--no-bbox", help="Read only the hand's region of general_informations.txt, or the whole frame."
        ),
    ] = True,
    foreground: Annotated[
        Literal["component", "none"],
        typer.Option("--foreground", help="component: only the largest component. none: every pixel with a depth."),
    ] = "component",
    median: Annotated[
        Literal["0", "3", "5"], typer.Option("--median", help="Side of the median blur, pixels; 0 for none.")
    ] = "3",
    close: Annotated[
        int, typer.Option("--close", min=0, max=1000, help="Side of the closing, pixels; 0 for none.")
    ] = 7,
    coordinates: PixelCoordinates = "image",
    conversion: ConversionOptions,
) -> None:
    """Read SHREC'17 Track: 14 hand gestures, by one finger or the whole hand, 2,800 sequences of 28 subjects."""
    from dpcli.prepare.actions.shrec17 import Shrec17

    run_conversion(
        "shrec17",
        lambda: Shrec17(
            raw=raw,
            classes=int(classes),
            bbox=bbox,
            foreground=foreground,
            median=int(median),
            close=close,
            coordinates=coordinates,
        ),
        conversion,
        raw,
    )
