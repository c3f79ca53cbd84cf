"""`dpc prepare split`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dpcli.cli.options import Force, Seed
from dpcli.cli.prepare.lists import three_shares, whole_numbers
from dpcli.cli.prepare.options import Compression
from dpcli.counted import counted
from dpcli.standard_streams import printable

if TYPE_CHECKING:
    from dpcli.prepare.commands.split import SplitChoice


@dataclass(frozen=True)
class SplitOptions:
    """Holds the options that say how samples are divided; at most one of the three ways, else the splits of the file."""

    listed: Annotated[Path | None, typer.Option("--list", help="CSV: name,split. Samples not listed are left out.")] = (
        None
    )
    train_subjects: Annotated[
        str, typer.Option("--train-subjects", help="Subjects of split train, such as 1,3,5; those not named are test.")
    ] = ""
    validation_subjects: Annotated[
        str, typer.Option("--validation-subjects", help="Subjects of split validation, such as 2,4.")
    ] = ""
    fractions: Annotated[
        str, typer.Option("--fractions", help="Draw shares train,validation,test, such as 0.8,0.1,0.1.")
    ] = ""
    stratify: Annotated[
        bool,
        typer.Option("--stratify/--no-stratify", help="Divide each class in these fractions (not with --by-subject)."),
    ] = True
    by_subject: Annotated[bool, typer.Option("--by-subject", help="Keep all of a subject's samples in one split.")] = (
        False
    )
    seed: Seed = 0

    def choice(self) -> SplitChoice:
        """Returns these options as `dpcli.prepare` takes them."""
        from dpcli.prepare.commands.split import SplitChoice

        named = {
            "train": whole_numbers(self.train_subjects, "--train-subjects"),
            "validation": whole_numbers(self.validation_subjects, "--validation-subjects"),
        }
        return SplitChoice(
            subjects={name: numbers for name, numbers in named.items() if numbers} or None,
            listed=self.listed,
            fractions=three_shares(self.fractions) if self.fractions else None,
            stratify=self.stratify,
            by_subject=self.by_subject,
            seed=self.seed,
        )


def split(
    clouds: Annotated[str, typer.Argument(help="File of clouds, or - for a pipe.")],
    output: Annotated[
        str,
        typer.Option(
            "-o", "--output", help="Folder for train.h5, validation.h5, test.h5; or one FILE.h5, or - for a pipe."
        ),
    ],
    options: SplitOptions,
    compression: Compression = "none",
    force: Force = False,
) -> None:
    """Divide a file of clouds: by the splits in it, a list, subjects or fractions.

    For example: dpc prepare split own.h5 --fractions 0.8,0.1,0.1 -o own_split.h5
    """
    from dpcli.prepare.commands.split import split as split_file
    from dpcli.store.pipes import input_file, output_file

    with input_file(clouds) as source, output_file(output) as target:
        counts = split_file(source, target, options.choice(), compression=compression, force=force)
    for name, count in counts.items() if output != "-" else ():
        typer.echo(printable(f"{name or 'in no split, left out'}: {counted(count, 'sequence')}"))
