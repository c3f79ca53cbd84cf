"""The options of `dpc classify predict --segments`, and what it prints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

import typer

from dpcli.cli.classify.predict_stream import PANEL, WindowOptions
from dpcli.errors import UsageError

if TYPE_CHECKING:
    from dpcli.classify.commands.model_task import ModelTask


@dataclass(frozen=True)
class SegmentOptions:
    """Says whether, and how, recordings are cut into actions."""

    HEADING: ClassVar[str] = PANEL
    segments: Annotated[
        bool, typer.Option("--segments", help="Cut long recordings into actions, as .csv or .json.")
    ] = False
    shortest: Annotated[
        int | None,
        typer.Option(
            "--shortest", min=1, help="With --segments: least number of frames of an action. Default: a window."
        ),
    ] = None


def predict_segments(task: ModelTask, windows: WindowOptions, shortest: int | None, reject: str | None) -> None:
    """Checks the options, cuts the recordings, and prints how many segments there are, or with `-o -` the table itself."""
    if task.output is None:
        raise UsageError("Missing option '-o' / '--output'.")
    windows.check()
    from dpcli.classify.commands.segments import SegmentOptions as Options
    from dpcli.classify.commands.segments import predict_segments as run
    from dpcli.classify.commands.segments import segment_counts
    from dpcli.counted import counted

    found, text = run(task, Options(windows.hop, windows.window, shortest, reject))
    if task.output == "-":
        typer.echo(text, nl=False)
        return
    actions, nothing = segment_counts(found.recordings)
    stretches = counted(nothing, "stretch of nothing", "stretches of nothing")
    recordings = counted(len(found.recordings), "recording")
    typer.echo(f"{task.output}: {counted(actions, 'action')} and {stretches} in {recordings}")
