"""`dpc evaluate weights`: list, fetch, check what the learned metrics need."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dpcli.cli.options import Json
from dpcli.errors import DataError, DpcError, UsageError

if TYPE_CHECKING:
    from dpcli.evaluate.networks.weights import Checked, Weights

app = typer.Typer(no_args_is_help=True, help="Weights of learned metrics: what is needed, fetched, whole.")

Folder = Annotated[
    Path | None,
    typer.Option("--weights", help="Folder of weights. Default: $DPC_WEIGHTS, else dpc/weights in the user's cache."),
]
Names = Annotated[list[str] | None, typer.Argument(help="Names from `dpc evaluate weights list`.")]


def register(parent: typer.Typer) -> None:
    """Add the group `weights` to `dpc evaluate`."""
    parent.add_typer(app, name="weights")


@app.command("list")
def list_command(weights: Folder = None, as_object: Json = False) -> None:
    """Which weights there are, what for, under what license, and which are here (judged by their size)."""
    from dpcli.evaluate.networks.weights import check_all, known, weights_folder

    folder = weights_folder(weights)
    found = {entry: check_all(entry, folder, digest=False) for entry in known().values()}
    _show(found, folder, as_object)


@app.command("check")
def check_command(names: Names = None, weights: Folder = None, as_object: Json = False) -> None:
    """Compute the digests of the weights that are here; exit 3 if one is damaged, or is named and absent."""
    from dpcli.evaluate.networks.weights import check_all, known, named, weights_folder

    folder = weights_folder(weights)
    entries = [named(name) for name in names] if names else list(known().values())
    found = {entry: check_all(entry, folder) for entry in entries}
    if not names:
        found = {entry: each for entry, each in found.items() if each.state != "absent"}
    _show(found, folder, as_object)
    bad = [f"{entry.name}: {each.said}" for entry, each in found.items() if each.state != "present"]
    if bad:
        raise DataError(f"{folder}: {'; '.join(bad)}\nfetch again with `dpc evaluate weights fetch NAME`")


@app.command("fetch")
def fetch_command(
    names: Names = None,
    everything: Annotated[bool, typer.Option("--all", help="All of them, 2.4 GB.")] = False,
    weights: Folder = None,
) -> None:
    """Download weights, check them, and put them where the metrics find them; the paths go to stdout."""
    from dpcli.evaluate.networks.weights import known, named, weights_folder

    if bool(names) == everything:
        raise UsageError(f"name the weights, or give --all: {', '.join(known())}")
    if weights is not None:
        weights.mkdir(parents=True, exist_ok=True)
    entries = list(known().values()) if everything else [named(name) for name in names or []]
    _fetch(entries, weights_folder(weights))


def _fetch(entries: list[Weights], folder: Path) -> None:
    """One file that can't be had doesn't keep the others away."""
    from dpcli.evaluate.networks.weights_fetch import fetch
    from dpcli.runtime.progress import log

    failed: list[DpcError] = []
    for entry in entries:
        try:
            for path in fetch(entry, folder):
                typer.echo(str(path))
        except DpcError as error:
            failed.append(error)
    for error in failed[:-1]:
        log.error(str(error))
    if failed:
        raise failed[-1]


def _show(found: dict[Weights, Checked], folder: Path, as_object: bool) -> None:
    if as_object:
        entries = [_object(entry, each, folder) for entry, each in found.items()]
        typer.echo(json.dumps({"task": "weights", "folder": str(folder), "weights": entries}))
        return
    from dpcli.evaluate.classification.tables import TextTable, print_tables
    from dpcli.evaluate.networks.weights import bytes_text

    rows = [
        [
            entry.name,
            entry.used_by,
            bytes_text(sum(each.size for each in entry.files), entry.about),
            entry.license.split("(")[0].split(";")[0].strip(),
            checked.state,
        ]
        for entry, checked in found.items()
    ]
    table = TextTable("Weights of learned metrics", ["weights", "for", "size", "license", "state"], rows)
    lines = [line for entry, checked in found.items() for line in _lines(entry, checked, folder)]
    closing = "A license is the project's; --json says where none is stated for the weights themselves."
    print_tables([table], [*lines, closing, f"Folder: {folder}"], sys.stdout)


def _lines(entry: Weights, checked: Checked, folder: Path) -> list[str]:
    """Where an entry is and what was checked, or where it comes from."""
    if checked.state != "absent":
        return [f"{entry.name}: {folder / entry.file} ({checked.said})"]
    digest = f"SHA-256 {entry.sha256}" if entry.sha256 else "no published digest"
    return [f"{entry.name}: {entry.file} from {entry.url} ({digest})"]


def _object(entry: Weights, found: Checked, folder: Path) -> dict[str, Any]:
    files = [
        {
            "path": str(folder / each.file),
            "url": each.url,
            "size": each.size,
            "size_is_exact": not each.about,
            "published_sha256": each.sha256 or None,
        }
        for each in entry.files
    ]
    return {
        "name": entry.name,
        "used_by": entry.used_by,
        "license": entry.license,
        "state": found.state,
        "found": found.said,
        "sha256": found.digest or None,
        "by_hand": entry.by_hand,
        "files": files,
        "note": entry.note,
    }
