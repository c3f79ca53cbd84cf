"""The options of `dpc classify predict --stream`, and which others don't go with it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dpcli.errors import UsageError

if TYPE_CHECKING:
    import numpy as np

    from dpcli.classify.stream.frame_source import CloudFiles

Stream = Annotated[
    bool,
    typer.Option("--stream", help="Predict while frames still arrive; DATA is then -, a growing file or a folder."),
]
Hop = Annotated[int | None, typer.Option("--hop", help="With --stream: frames between predictions. Default: 1.")]
Window = Annotated[
    int | None,
    typer.Option("--window", help="With --stream: frames to look back at, for models trained with --timing uniform."),
]
Follow = Annotated[
    float | None,
    typer.Option(
        "--follow", help="With --stream: seconds to wait for more at the end of a file or folder. Default: 0."
    ),
]

JsonLines = Annotated[bool, typer.Option("--json", help="With --stream: one JSON object per line.")]


def require_stream(**given: object) -> None:
    """UsageError when an option of --stream is given without it."""
    for name, value in given.items():
        if value not in (None, False):
            raise UsageError(f"--{name} goes with --stream")


def predict_stream(
    data: str,
    model: str,
    output: str | None,
    *,
    refused: dict[str, bool],
    hop: int | None,
    window: int | None,
    follow: float | None,
    seed: int,
    device: str,
    force: bool,
    json_output: bool,
    backbone: str | None = None,
) -> None:
    """Check the options and run. `refused` maps options of batch prediction to whether they were given."""
    for name in (name for name, given in refused.items() if given):
        raise UsageError(f"--{name} does not go with --stream, which is one video, as it comes")
    if output == "-":
        raise UsageError("-o - would mix HDF5 with the lines on stdout; name a file, or leave -o out")
    if hop is not None and hop < 1:
        raise UsageError(f"--hop {hop}: expected at least 1 frame")
    if follow is not None and not follow >= 0:
        raise UsageError(f"--follow {follow:g}: expected seconds, 0 or more (inf: until a signal)")
    from dpcli.classify.commands.stream import run_stream

    run_stream(
        data,
        model,
        output,
        hop=hop or 1,
        window=window,
        follow=follow or 0.0,
        seed=seed,
        device=device,
        force=force,
        json_output=json_output,
        files=cloud_files(),
        backbone=backbone,
    )


def cloud_files() -> CloudFiles:
    """A folder's frames: what `dpc prepare clouds` reads, in its order."""
    from dpcli.classify.stream.frame_source import CloudFiles
    from dpcli.prepare.decode.cloud_files import SUFFIXES
    from dpcli.prepare.reader import natural_key

    return CloudFiles(SUFFIXES, natural_key, _read_points)


def _read_points(path: Path) -> np.ndarray:
    """The points of a file, those with NaN left out as `dpc prepare clouds` does: organized clouds mark gaps so."""
    from dpcli.prepare.decode.cloud_files import read_cloud
    from dpcli.prepare.scans.clouds import drop_invalid

    cloud = read_cloud(path)
    drop_invalid(cloud)
    return cloud.points
