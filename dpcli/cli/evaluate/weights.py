"""`dpc evaluate weights`: list, check, fetch."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.evaluate.options import FormOptions
from dpcli.cli.evaluate.output import print_result
from dpcli.cli.options import Json

Folder = Annotated[
    Path | None,
    typer.Option("--weights", help="Folder of weights. Default: $DPC_WEIGHTS, else dpc/weights in the user's cache."),
]
Names = Annotated[list[str] | None, typer.Argument(help="Names from `dpc evaluate weights list`.")]


def list_command(weights: Folder = None, as_object: Json = False) -> None:
    """List the weights: what they are for, their license, and which are installed (judged by their size)."""
    from dpcli.evaluate.commands.weights import list_weights

    print_result(list_weights(weights), FormOptions(as_object=as_object))


def check_command(names: Names = None, weights: Folder = None, as_object: Json = False) -> None:
    """Compute the digests of the installed weights; exit 3 if one is damaged, or is named and absent."""
    from dpcli.evaluate.commands.weights import check_named_weights

    print_result(check_named_weights(names or [], weights), FormOptions(as_object=as_object))


def fetch_command(
    names: Names = None,
    everything: Annotated[bool, typer.Option("--all", help="Fetch all of them, 2.4 GB.")] = False,
    weights: Folder = None,
) -> None:
    """Download weights, check them, and put them where the metrics find them; print their paths to stdout."""
    from dpcli.evaluate.commands.weights import choose_weights, fetch_chosen_weights
    from dpcli.evaluate.networks.weights import weights_folder
    from dpcli.runtime.progress import log
    from dpcli.runtime.whole_file import make_folder

    entries = choose_weights(names or [], everything)
    if weights is not None:
        make_folder(weights, "--weights")
    paths, failed = fetch_chosen_weights(entries, weights_folder(weights))
    for path in paths:
        typer.echo(str(path))
    for error in failed[:-1]:
        log.error(str(error))
    if failed:
        raise failed[-1]
