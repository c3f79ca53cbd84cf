"""The options of `dpc classify predict --segments`, and what it prints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from dpcli.cli.classify.predict_stream import PANEL
from dpcli.errors import UsageError

if TYPE_CHECKING:
    from dpcli.classify.commands.model_task import ModelTask


@dataclass(frozen=True)
class SegmentOptions:
    """Says whether, and how, recordings are cut into actions."""

    segments: Annotated[
        bool,
        typer.Option("--segments", rich_help_panel=PANEL, help="Cut long recordings into actions, as .csv or .json."),
    ] = False
    shortest: Annotated[
        int | None,
        typer.Option(
            "--shortest",
            min=1,
            rich_help_panel=PANEL,
            help="With --segments: least number of frames of an action. Default: a window.",
        ),
    ] = None


def predict_segments(
    task: ModelTask, hop: int | None, window: int | None, shortest: int | None, reject: str | None
) -> None:
    """Checks the options, cuts the recordings, and prints how many segments there are, or with `-o -` the table itself."""
    if task.output is None:
        raise UsageError("Missing option '-o' / '--output'.")
    if hop is not None and hop < 1:
        raise UsageError(f"--hop {hop}: expected at least 1 frame")
    from dpcli.classify.commands.segments import SegmentOptions as Options
    from dpcli.classify.commands.segments import predict_segments as run
    from dpcli.classify.commands.segments import segment_counts
    from dpcli.counted import counted

    found, text = run(task, Options(hop, window, shortest, reject))
    if task.output == "-":
        typer.echo(text, nl=False)
        return
    actions, nothing = segment_counts(found.recordings)
    stretches = counted(nothing, "stretch of nothing", "stretches of nothing")
    recordings = counted(len(found.recordings), "recording")
    typer.echo(f"{task.output}: {counted(actions, 'action')} and {stretches} in {recordings}")
