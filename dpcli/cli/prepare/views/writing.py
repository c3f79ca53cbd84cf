"""The one way in which a command that makes views runs."""

from __future__ import annotations

from typing import Any

import typer

from dpcli.cli.prepare.conversion import require_output
from dpcli.counted import counted
from dpcli.standard_streams import printable


def write_views(make_clip: Any, output: str, *, source: str, **options: Any) -> None:
    """Converts one clip into `output` (a path, or - for a pipe) and prints what it holds."""
    require_output(output)
    from dpcli.prepare.views.views_pipeline import convert_clip
    from dpcli.store.pipes import output_file

    with output_file(output) as path:
        header = convert_clip(make_clip, path, source=source, task=f"prepare {source}", **options)
    if output != "-":
        size = f"{header.size[0]}x{header.size[1]}"
        typer.echo(
            printable(
                f"{output}: {header.name}, {counted(header.num_views, 'view')}, {counted(header.num_frames, 'frame')}, {size}"
            )
        )
