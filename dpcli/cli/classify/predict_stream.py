"""The options of `dpc classify predict --stream`, and which others don't go with it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dpcli.errors import UsageError

if TYPE_CHECKING:
    import numpy as np

    from dpcli.classify.commands.model_task import ModelTask
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
    """Raises UsageError when an option of --stream is given without it."""
    for name, value in given.items():
        if value not in (None, False):
            raise UsageError(f"--{name} goes with --stream")


def refuse_batch_options(given: dict[str, bool]) -> None:
    """Raises UsageError when an option of batch prediction is given. given: option -> whether it is."""
    for name in (name for name, typed in given.items() if typed):
        raise UsageError(f"--{name} does not go with --stream, which is one video, as it comes")


def predict_stream(task: ModelTask, hop: int | None, window: int | None, follow: float | None, as_json: bool) -> None:
    """Checks the options and predicts, a line per prediction on stdout."""
    if task.output == "-":
        raise UsageError("-o - would mix HDF5 with the lines on stdout; name a file, or leave -o out")
    if hop is not None and hop < 1:
        raise UsageError(f"--hop {hop}: expected at least 1 frame")
    if follow is not None and not follow >= 0:
        raise UsageError(f"--follow {follow:g}: expected seconds, 0 or more (inf: until a signal)")
    from dpcli.classify.commands.stream import StreamOptions
    from dpcli.classify.commands.stream import predict_stream as run
    from dpcli.cli.classify.stream_lines import Lines

    options = StreamOptions(hop or 1, window, follow or 0.0, cloud_files())
    run(task, options, lambda class_names, streams: Lines(class_names, streams, as_json))


def cloud_files() -> CloudFiles:
    """Returns how a folder's frames are read: what `dpc prepare clouds` reads, in its order."""
    from dpcli.classify.stream.frame_source import CloudFiles
    from dpcli.prepare.decode.cloud_files import SUFFIXES
    from dpcli.prepare.reader import natural_key

    return CloudFiles(SUFFIXES, natural_key, _read_points)


def _read_points(path: Path) -> np.ndarray:
    """Returns the points of a file, without those that are no measurement, as `dpc prepare clouds` does."""
    from dpcli.prepare.decode.cloud_files import read_cloud
    from dpcli.prepare.scans.cleaning import clean

    cloud = read_cloud(path)
    clean([cloud])
    return cloud.points
