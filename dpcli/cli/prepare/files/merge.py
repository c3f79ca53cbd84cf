"""`dpc prepare merge`."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.options import Force, Output
from dpcli.cli.prepare.options import Compression
from dpcli.errors import UsageError


def merge(
    inputs: Annotated[
        list[Path],
        typer.Argument(
            help="Files to join, one of them perhaps - for a pipe: all shards of one run (of prepare, predict ...), or any clouds."
        ),
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
    from dpcli.store.pipes import input_file, output_file

    if [str(one) for one in inputs].count("-") > 1:
        raise UsageError("-: is given twice; only one file comes through a pipe")
    label_map = LabelMap.read(labels) if labels else None
    with ExitStack() as spooled, output_file(output) as path:
        files = [spooled.enter_context(input_file(one)) if str(one) == "-" else one for one in inputs]
        report = merge_files(
            files, path, labels=label_map, prefix=prefix, compression=compression, force=force, resume=output != "-"
        )
    if output != "-":
        typer.echo(f"{output}: {report.counts()}")
