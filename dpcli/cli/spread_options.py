"""Options that say who works on the items of a command: processes, a shard of them, a cluster."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dpcli.cli.help_groups import RUNNING

if TYPE_CHECKING:
    from dpcli.runtime.machines.spread import Spread


def _shard_of(items: str, joined: str) -> Any:
    what = f"Only every Nth {items}, starting at I (0 to N-1); {joined}."
    return typer.Option("--shard", metavar="I/N", rich_help_panel=RUNNING, help=what)


Shard = Annotated[str, _shard_of("sample", "dpc prepare merge joins the shards")]
Dask = Annotated[
    str,
    typer.Option(
        "--dask", metavar="ADDRESS", rich_help_panel=RUNNING, help="Work on a Dask cluster: tcp://HOST:PORT, or local."
    ),
]


@dataclass(frozen=True)
class SpreadOptions:
    """Says who works on which samples; no byte of the whole depends on it."""

    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs",
            min=1,
            max=1024,
            rich_help_panel=RUNNING,
            help="Processes. Default: as many as make it faster; one on a GPU.",
        ),
    ] = None
    shard: Shard = ""
    dask: Dask = ""

    @property
    def spread(self) -> Spread:
        """Returns the choice as the commands take it. Raises UsageError for a shard that is none."""
        from dpcli.runtime.machines import shards, spread

        return spread.Spread(self.jobs, shards.Shard.parse(self.shard) if self.shard else None, self.dask)


@dataclass(frozen=True)
class SpreadClips(SpreadOptions):
    """Says who works on which clips, each of which becomes a file of its own."""

    shard: Annotated[str, _shard_of("clip", "each scene is a file, so nothing has to be joined")] = ""
