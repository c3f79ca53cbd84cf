"""The options of `dpc classify predict --stream`, and which others don't go with it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import typer

from dpcli.errors import UsageError

if TYPE_CHECKING:
    import numpy as np

    from dpcli.classify.commands.model_task import ModelTask
    from dpcli.classify.stream.frame_source import CloudFiles

PANEL = "Streams and long recordings"  # heading in the help


@dataclass(frozen=True)
class WindowOptions:
    """Says which frames of a stream or a long recording each prediction looks at."""

    HEADING: ClassVar[str] = PANEL
    hop: Annotated[
        int | None,
        typer.Option(
            "--hop",
            help="With --stream or --segments: frames between predictions. Default: 1, or a quarter of the window.",
        ),
    ] = None
    window: Annotated[
        int | None,
        typer.Option(
            "--window",
            help="With --stream or --segments: frames of a window, for models trained with --timing uniform.",
        ),
    ] = None

    def check(self) -> None:
        """Raises UsageError for a hop of no frame."""
        if self.hop is not None and self.hop < 1:
            raise UsageError(f"--hop {self.hop}: expected at least 1 frame")


@dataclass(frozen=True)
class StreamOptions:
    """Says how a stream is read, predicted and shown."""

    HEADING: ClassVar[str] = PANEL
    stream: Annotated[
        bool,
        typer.Option("--stream", help="Predict while frames still arrive; DATA is then -, a growing file or a folder."),
    ] = False
    follow: Annotated[
        float | None,
        typer.Option(
            "--follow",
            help="With --stream: seconds to wait for more at the end of a file, folder or named pipe. Default: 0.",
        ),
    ] = None
    json_output: Annotated[bool, typer.Option("--json", help="With --stream: one JSON object per line.")] = False
    page: Annotated[
        Path | None,
        typer.Option(
            "--page", help="With --stream: write a page of the frames and predictions to this .html at the end."
        ),
    ] = None


def require(mode: str, **given: object) -> None:
    """Raises UsageError when an option that needs another one, `mode` in words, is given without it."""
    for name, value in given.items():
        if value not in (None, False):
            raise UsageError(f"--{name} goes with {mode}")


def refuse(reason: str, given: dict[str, bool]) -> None:
    """Raises UsageError, which tells the reason, when an option is given. given: option -> whether it is."""
    for name in (name for name, typed in given.items() if typed):
        raise UsageError(f"--{name} does not go with {reason}")


def predict_stream(task: ModelTask, given: StreamOptions, windows: WindowOptions, reject: str | None) -> None:
    """Checks the options and predicts: a line per prediction on stdout, or a view that changes in place on a terminal."""
    follow = given.follow
    if task.output == "-":
        raise UsageError("-o - would mix HDF5 with the lines on stdout; name a file, or leave -o out")
    windows.check()
    if follow is not None and not follow >= 0:
        raise UsageError(f"--follow {follow:g}: expected seconds, 0 or more (inf: until a signal)")
    if given.page is not None:
        check_page(given.page, task)
    from dpcli.classify.commands.stream import StreamOptions as Options
    from dpcli.classify.commands.stream import predict_stream as run
    from dpcli.cli.classify.stream_listeners import listener

    options = Options(windows.hop or 1, windows.window, follow or 0.0, cloud_files(), reject)
    run(task, options, lambda model: listener(model, given.json_output, given.page, task.source))


def check_page(page: Path, task: ModelTask) -> None:
    """Raises UsageError, before the work, where the page can't be written or would replace something."""
    from dpcli.runtime.whole_file import check_target

    check_target(page, "--page", (".html", ".htm"))
    if page.exists() and not task.force:
        raise UsageError(f"--page {page}: exists already; --force replaces it")


def cloud_files() -> CloudFiles:
    """Returns how a folder's frames are read: what `dpc prepare clouds` reads, in its order."""
    from dpcli.classify.stream.frame_source import CloudFiles
    from dpcli.prepare.decode.cloud_files import SUFFIXES
    from dpcli.prepare.reader import natural_key

    return CloudFiles(SUFFIXES, natural_key, _read_points)


def _read_points(path: Path, columns: tuple[str, ...]) -> np.ndarray:
    """Returns the points of a file with these columns beside their places, without those that are no measurement, as `dpc
    prepare clouds` does."""
    import numpy as np

    from dpcli.prepare.decode.cloud_files import read_cloud
    from dpcli.prepare.scans.cleaning import clean

    cloud = read_cloud(path, keep=columns)
    clean([cloud])
    return np.column_stack([cloud.points, *(cloud.extra[name] for name in columns)])
