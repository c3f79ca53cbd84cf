"""`dpc prepare preprocessed`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from dpcli.cli.prepare.conversion import ConversionOptions, run_conversion
from dpcli.cli.prepare.options import Protocol


def preprocessed(
    raw: Annotated[
        Path, typer.Argument(help="Folder of pts_label.npy, or of .npz by MeteorNet's or PSTNet's scripts.")
    ],
    *,
    form: Annotated[
        Literal["auto", "msraction3d", "ntu60", "pts_label"],
        typer.Option(
            "--form", help="msraction3d, ntu60: one .npz per video. pts_label: gestures. auto: by the first file found."
        ),
    ] = "auto",
    classes: Annotated[
        Literal["28", "14"], typer.Option("--classes", help="Classes of SHREC'17: 28 (gesture and fingers) or 14.")
    ] = "28",
    lists: Annotated[
        Path | None, typer.Option("--lists", help="Folder of SHREC'17's two list files. Default: RAW.")
    ] = None,
    protocol: Protocol = "xsub",
    scale: Annotated[
        float | None,
        typer.Option("--scale", help="Stored units per unit of length in the output. Default: the peers' loaders'."),
    ] = None,
    conversion: ConversionOptions,
) -> None:
    """Read clouds made by others' code: pts_label.npy (PointLSTM, Kinet), .npz (MeteorNet, PSTNet and its followers)."""
    from dpcli.prepare.actions.preprocessed import open_preprocessed

    run_conversion(
        "preprocessed", lambda: open_preprocessed(raw, form, int(classes), lists, protocol, scale), conversion, raw
    )
