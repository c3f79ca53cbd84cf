"""`dpc prepare clouds`: anybody's point cloud files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.prepare.conversion import ConversionOptions, run_conversion
from dpcli.cli.prepare.options import LabelTable, Stride


def clouds(
    raw: Annotated[
        Path, typer.Argument(help="Folder of .ply .pcd .npy .npz .bin .csv .las .xyz frames, or of such folders.")
    ],
    *,
    bin_columns: Annotated[
        int, typer.Option("--bin-columns", help="float32 values per point of a .bin; KITTI has 4.")
    ] = 4,
    scale: Annotated[float, typer.Option("--scale", help="Input units per unit of length in the output.")] = 1.0,
    unit: Annotated[str, typer.Option("--unit", help="Name of the output's unit of length.")] = "m",
    fps: Annotated[
        float | None, typer.Option("--fps", help="Frames per second; writes the time of every frame.")
    ] = None,
    stride: Stride = 1,
    label_from_folder: Annotated[
        bool,
        typer.Option(
            "--label-from-folder",
            help="Take labels from folders RAW/CLASS/SEQUENCE/frames, or RAW/train/CLASS/... and RAW/test/CLASS/...",
        ),
    ] = False,
    labels: LabelTable = None,
    conversion: ConversionOptions,
) -> None:
    """Reads point cloud files: a folder is a sequence, its files are the frames.

    For example: dpc prepare clouds scans --fps 10 -o own.h5
    """
    from dpcli.prepare.scans.clouds import CloudFolders

    run_conversion(
        "clouds",
        lambda: CloudFolders(
            raw=raw,
            bin_columns=bin_columns,
            scale=scale,
            unit=unit,
            fps=fps,
            stride=stride,
            label_from_folder=label_from_folder,
            labels=labels,
        ),
        conversion,
        raw,
    )
