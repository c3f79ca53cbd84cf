"""Options spelled the same in every command."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from dpcli.cli.help_groups import RUNNING
from dpcli.errors import UsageError

_LARGEST_SEED = 2**63 - 1  # what torch and an attribute of an HDF5 file hold

Output = Annotated[str, typer.Option("-o", "--output", help="File to write, or - for a pipe.")]
Scene = Annotated[str, typer.Argument(help="A gaussians file, or - for a pipe.")]


def completion(words: Sequence[str]) -> Callable[[str], list[str]]:
    """Returns what completes the begun value of an option in a shell: those of some words that begin so."""
    return lambda incomplete: [word for word in words if word.startswith(incomplete)]


def _read_seed(text: str) -> int:
    """Returns the seed. Raises UsageError unless it is a whole number that torch and an HDF5 attribute hold."""
    try:
        seed = int(text)
    except ValueError:
        seed = -1
    if not 0 <= seed <= _LARGEST_SEED:
        raise UsageError(f"--seed {text}: expected a whole number from 0 to {_LARGEST_SEED}")
    return seed


Seed = Annotated[
    int,
    typer.Option(
        "--seed", parser=_read_seed, metavar="INTEGER", rich_help_panel=RUNNING, help="Seed of all randomness."
    ),
]
Jobs = Annotated[
    int | None,
    typer.Option(
        "--jobs", min=1, max=1024, rich_help_panel=RUNNING, help="Processes. Default: the CPUs this process may use."
    ),
]
Device = Annotated[str, typer.Option("--device", rich_help_panel=RUNNING, help="auto, cpu, cuda or cuda:N.")]
OnError = Annotated[
    Literal["skip", "stop"],
    typer.Option(
        "--on-error", rich_help_panel=RUNNING, help="After a bad sample: skip it and list it at the end, or stop."
    ),
]
Force = Annotated[
    bool,
    typer.Option("--force", rich_help_panel=RUNNING, help="Start over, even if the output or a part of it exists."),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")]
Picture = Annotated[Path | None, typer.Option("--picture", help="Write a picture (.png) to this file.")]
TrustedBackbone = Annotated[
    str | None,
    typer.Option(
        "--backbone",
        help="Your own backbone as module:Class, where the model was trained on one; its code is run only if it is named here.",
    ),
]
