"""`dpc prepare merge`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.options import Force, Output
from dpcli.cli.prepare.options import Compression


def merge(
    inputs: Annotated[
        list[Path],
        typer.Argument(help="Files to join: all shards of one run (of prepare, predict ...), or any clouds."),
    ],
    output: Output,
    labels: Annotated[
        Path | None, typer.Option("--labels", help="TOML or JSON: which class of which file becomes which.")
    ] = None,
    prefix: Annotated[
        bool,
        typer.Option(
            "--prefix",
            help="Name samples FILE/NAME (FOLDER/NAME for files of the same name), so that names may repeat in the inputs.",
        ),
    ] = False,
    compression: Compression = "none",
    force: Force = False,
) -> None:
    """Join files: the shards of one run, whatever it wrote, in their order; or clouds of unlike sources with a label map.

    Shards keep the compression that they were made with.
    """
    from dpcli.prepare.commands.merge import merge as merge_files
    from dpcli.prepare.label_map import LabelMap
    from dpcli.store.pipes import output_file

    label_map = LabelMap.read(labels) if labels else None
    with output_file(output) as path:
        report = merge_files(
            inputs, path, labels=label_map, prefix=prefix, compression=compression, force=force, resume=output != "-"
        )
    if output != "-":
        typer.echo(f"{output}: {report.counts()}")
