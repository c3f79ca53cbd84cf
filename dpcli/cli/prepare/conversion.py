"""Options of every command that turns raw data into clouds, and the one way in which such a command runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from dpcli.cli.help_groups import RUNNING
from dpcli.cli.options import Force, Jobs, OnError, Seed
from dpcli.cli.prepare.options import Check, Compression, FileOrPipe, ItemSeconds, PointsAtMost, Sampling
from dpcli.cli.spread_options import Dask, Shard
from dpcli.errors import UsageError, reading
from dpcli.runtime.device import cpu_count
from dpcli.runtime.worker_server import ensure_server
from dpcli.standard_streams import printable


@dataclass(frozen=True)
class ConversionOptions:
    """Holds the options that every conversion has, whatever it reads."""

    output: FileOrPipe = ""
    points: PointsAtMost = 0
    sampling: Sampling = "random"
    limit: Annotated[
        int | None,
        typer.Option("--limit", min=1, rich_help_panel=RUNNING, help="Convert only the first N samples, for a trial."),
    ] = None
    compression: Compression = "none"
    on_error: OnError = "skip"
    jobs: Jobs = None
    shard: Shard = ""
    dask: Dask = ""
    item_seconds: ItemSeconds = 120
    check: Check = False
    seed: Seed = 0
    force: Force = False


@dataclass(frozen=True)
class PublishedConversion(ConversionOptions):
    """Holds the same options with the number of points that the published scenes have."""

    points: PointsAtMost = 8192
    sampling: Sampling = "fps"


def run_conversion(
    name: str, make_reader: Callable[[], Any], options: ConversionOptions, raw: Path | None = None
) -> None:
    """Converts what the reader reads and prints what was written, or prints what is missing with `--check`.

    name: the command's, which is also its recipe's. raw: the folder that `--check` compares with the recipe.
    """

    if str(raw) == "-":
        raise UsageError("-: raw data come from files and folders, not through a pipe; name them")

    def made() -> Any:
        with reading(raw or f"prepare {name}"):  # some look into the folder to choose how it is read
            return make_reader()

    if options.check:
        print_check(name, raw, made)
        return
    require_output(options.output)
    if (options.jobs or cpu_count()) != 1 and not options.dask:
        ensure_server("dpcli.prepare.convert_item")  # while libraries load here and the folder is listed
    reader = made()
    from dpcli.prepare.commands.convert import convert_raw_data
    from dpcli.prepare.pipeline import Conversion
    from dpcli.runtime.machines import shards
    from dpcli.runtime.progress import log

    shared = {key: value for key, value in vars(options).items() if key not in ("output", "shard", "dask", "check")}
    shard = shards.Shard.parse(options.shard) if options.shard else None
    conversion = Conversion(**shared, shard=shard, task=f"prepare {name}")
    report = convert_raw_data(reader, options.output, conversion, options.dask)
    for line in report.lines():
        log.warn(line)
    for line in report.closing:
        log.info(line)
    if options.output != "-":
        typer.echo(f"{options.output}: {report.counts()}")


def require_output(output: str) -> None:
    """Raises UsageError when no output was named; `--check` needs none, so the parser can't ask for it."""
    if not output:
        raise UsageError("-o/--output FILE is missing: the file to write, or - for a pipe")


def print_check(name: str, raw: Path | None, make_index: Callable[[], Any], *, file: bool = False) -> None:
    """Prints what of the recipe is in the folder and what is missing."""
    from dpcli.prepare.recipe_check import check_folder

    for line in check_folder(name, raw, make_index, file=file):
        typer.echo(printable(line))
