"""`dpc prepare merge | split`: several files of clouds into one, one into several."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.options import Force, Output, Seed
from dpcli.errors import UsageError

_Compression = Annotated[str, typer.Option("--compression", help="Of the coordinates: none, lzf or gzip.")]


def register(app: typer.Typer) -> None:
    """Add the commands to `dpc prepare`."""
    app.command("merge")(merge)
    app.command("split")(split)


def merge(
    inputs: Annotated[list[Path], typer.Argument(help="Files to join: all shards of one conversion, or any others.")],
    output: Output,
    labels: Annotated[
        Path | None, typer.Option("--labels", help="TOML or JSON: which class of which file becomes which.")
    ] = None,
    prefix: Annotated[
        bool,
        typer.Option(
            "--prefix", help="Samples are named FILE/NAME (FOLDER/NAME of files called alike): names may repeat."
        ),
    ] = False,
    compression: Annotated[
        str, typer.Option("--compression", help="Of the coordinates: none, lzf or gzip. Shards: as they were made.")
    ] = "none",
    force: Force = False,
) -> None:
    """Join files of clouds: the shards of one conversion in their order, or unlike sources with a label map."""
    from dpcli.prepare.commands.merge import merge as join
    from dpcli.prepare.label_map import LabelMap
    from dpcli.store.pipes import output_file

    chosen = LabelMap.read(labels) if labels else None
    with output_file(output) as path:
        report = join(
            inputs, path, labels=chosen, prefix=prefix, compression=compression, force=force, resume=output != "-"
        )
    if output != "-":
        counts = f"{report.written} sequences, {report.frames} frames, {report.points} points"
        typer.echo(f"{output}: {counts}, {len(report.skipped)} skipped")


def split(
    clouds: Annotated[Path, typer.Argument(help="File of clouds.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for train.h5, validation.h5, test.h5; or one FILE.h5.")
    ],
    listed: Annotated[
        Path | None, typer.Option("--list", help="CSV: name,split. Samples not listed are left out.")
    ] = None,
    train_subjects: Annotated[
        str, typer.Option("--train-subjects", help="As 1,3,5; subjects not named are test.")
    ] = "",
    validation_subjects: Annotated[str, typer.Option("--validation-subjects", help="As 2,4.")] = "",
    fractions: Annotated[str, typer.Option("--fractions", help="Drawn: train,validation,test, as 0.8,0.1,0.1.")] = "",
    stratify: Annotated[
        bool, typer.Option("--stratify/--no-stratify", help="Each class in these fractions (not with --by-subject).")
    ] = True,
    by_subject: Annotated[bool, typer.Option("--by-subject", help="All of a subject's samples in one split.")] = False,
    compression: _Compression = "none",
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Divide a file of clouds: by the splits it tells, a list, subjects or fractions."""
    from dpcli.prepare.commands.split import SplitChoice
    from dpcli.prepare.commands.split import split as divide

    named = {
        "train": _numbers(train_subjects, "--train-subjects"),
        "validation": _numbers(validation_subjects, "--validation-subjects"),
    }
    subjects = {name: numbers for name, numbers in named.items() if numbers} or None
    shares = _shares(fractions) if fractions else None
    counts = divide(
        clouds,
        output,
        SplitChoice(subjects, listed, shares, stratify, by_subject, seed),
        compression=compression,
        force=force,
    )
    for name, count in counts.items():
        typer.echo(f"{name or 'in no split, left out'}: {count} sequences")


def _numbers(text: str, option: str) -> tuple[int, ...]:
    try:
        return tuple(int(word) for word in text.split(",") if word.strip())
    except ValueError:
        raise UsageError(f"{option} {text}: expected whole numbers with commas, such as 1,2,3") from None


def _shares(text: str) -> tuple[float, float, float]:
    try:
        train, validation, test = (float(word) for word in text.split(","))
    except ValueError:
        raise UsageError(f"--fractions {text}: expected three numbers, such as 0.8,0.1,0.1") from None
    return train, validation, test
