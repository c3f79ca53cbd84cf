"""Options that several commands of `dpc prepare` share, each a type with its help and legal words."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from dpcli.cli.help_groups import LABELS, RUNNING

FileOrPipe = Annotated[str, typer.Option("-o", "--output", help="File to write, or - for a pipe.")]
Check = Annotated[bool, typer.Option("--check", help="Convert nothing; list what is there and what is missing.")]
Compression = Annotated[
    Literal["none", "lzf", "gzip"],
    typer.Option("--compression", rich_help_panel=RUNNING, help="How the coordinates are compressed."),
]
PointsAtMost = Annotated[
    int, typer.Option("--points", min=0, help="Keep at most this many points per frame; 0 keeps all.")
]
Sampling = Annotated[
    Literal["random", "fps", "voxel"],
    typer.Option("--sampling", help="How --points chooses: at random, farthest points (fps), or one per voxel."),
]
ItemSeconds = Annotated[
    float,
    typer.Option(
        "--item-seconds",
        min=0,
        rich_help_panel=RUNNING,
        help="Processor time that one sample may take, and 10 seconds more for each MB of its files; then it is skipped."
        " 0: no limit.",
    ),
]
Stride = Annotated[int, typer.Option("--stride", min=1, help="Keep every nth frame.")]
Pattern = Annotated[
    str,
    typer.Option(
        "--pattern", help="Which files of a folder are its frames, such as 'frame_*'. Default: found by their names."
    ),
]
Topic = Annotated[
    str, typer.Option("--topic", help="Topic of a recording (.bag, .mcap, .db3). Default: the only one that fits.")
]
LabelTable = Annotated[
    Path | None,
    typer.Option(
        "--labels", rich_help_panel=LABELS, help="CSV file of labels; its columns: name,label[,subject][,split]."
    ),
]
TestCategories = Annotated[
    str,
    typer.Option(
        "--test-categories", rich_help_panel=LABELS, help="Categories that are split test, such as Laptop,Scissors."
    ),
]
ValidationCategories = Annotated[
    str, typer.Option("--validation-categories", rich_help_panel=LABELS, help="Categories that are split validation.")
]
CategoryFractions = Annotated[
    str,
    typer.Option(
        "--fractions",
        rich_help_panel=LABELS,
        help="Shares train,validation,test of the objects in no named category. Default: 0.8,0.1,0.1, or all of them"
        " train when categories are named.",
    ),
]
SequencesPerObject = Annotated[
    int,
    typer.Option(
        "--sequences-per-object",
        "--pairs-per-object",
        min=1,
        max=100_000,
        help="Sequences of --frames drawn of each object.",
    ),
]
Protocol = Annotated[
    Literal["xsub", "xview"],
    typer.Option("--protocol", help="NTU's split into train and test: by subject (xsub) or by camera (xview)."),
]
PixelCoordinates = Annotated[
    Literal["image", "camera"],
    typer.Option(
        "--coordinates",
        help="image: row and column in pixels, and the depth as stored. camera: x y z of a pinhole camera.",
    ),
]
SceneCoordinates = Annotated[
    Literal["published", "camera"],
    typer.Option("--coordinates", help="published: x left, y up, z forward. camera: x right, y down, z forward."),
]
Far = Annotated[float, typer.Option("--far", help="Drop what is farther from the camera, meters.")]
Near = Annotated[float, typer.Option("--near", help="Drop what is less than this far ahead of the scanner, meters.")]
PictureSize = Annotated[int, typer.Option("--size", min=16, max=4096, help="Side of the square pictures, pixels.")]
FramesAtMost = Annotated[
    int, typer.Option("--frames", min=0, help="At most this many frames, evenly sampled; 0 keeps all.")
]
ClipFrames = Annotated[int, typer.Option("--frames", min=1, max=10_000, help="Frames, evenly spaced over the clip.")]
Border = Annotated[
    float, typer.Option("--border", help="Share of the picture left empty along the object's longer side.")
]
BadFrame = Annotated[
    Literal["skip", "stop"],
    typer.Option("--on-error", rich_help_panel=RUNNING, help="After a bad frame: stop, or skip it (leave it out)."),
]
