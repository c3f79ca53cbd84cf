"""`dpc evaluate weights`: lists, checks and fetches the weights of the learned metrics."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dpcli.errors import DpcError, UsageError
from dpcli.evaluate.networks.weights import (
    Checked,
    Weights,
    bytes_text,
    check_weights,
    known_weights,
    weights_folder,
    weights_named,
)
from dpcli.evaluate.networks.weights_fetch import fetch_weights
from dpcli.evaluate.results import Result
from dpcli.evaluate.text_tables import TextTable


def list_weights(folder: Path | None) -> Result:
    """Returns which weights there are, and which are in the folder, judged by their size."""
    place = weights_folder(folder)
    return _result({entry: check_weights(entry, place, digest=False) for entry in known_weights().values()}, place)


def check_named_weights(names: Sequence[str], folder: Path | None) -> Result:
    """Returns whether the named weights, or all that are in the folder, are whole, by their digests.

    The result is incomplete where one is damaged, or named and absent. Raises UsageError for a name there isn't.
    """
    place = weights_folder(folder)
    entries = [weights_named(name) for name in names] if names else list(known_weights().values())
    found = {entry: check_weights(entry, place) for entry in entries}
    if not names:
        found = {entry: each for entry, each in found.items() if each.state != "absent"}
    bad = [f"{entry.name}: {each.finding}" for entry, each in found.items() if each.state != "present"]
    wrong = f"{place}: {'; '.join(bad)}\nfetch again with `dpc evaluate weights fetch NAME`" if bad else ""
    return _result(found, place, wrong)


def choose_weights(names: Sequence[str], everything: bool) -> list[Weights]:
    """Returns the named weights, or all of them. Raises UsageError for neither or both, and for a name there isn't."""
    if bool(names) == everything:
        raise UsageError(f"name the weights, or give --all: {', '.join(known_weights())}")
    return list(known_weights().values()) if everything else [weights_named(name) for name in names]


def fetch_chosen_weights(entries: Sequence[Weights], folder: Path) -> tuple[list[Path], list[DpcError]]:
    """Downloads weights; returns the files that are there, and an error for each entry that can't be had.

    One that can't be had doesn't keep the others away.
    """
    paths: list[Path] = []
    failed: list[DpcError] = []
    for entry in entries:
        try:
            paths += fetch_weights(entry, folder)
        except DpcError as error:
            failed.append(error)
    return paths, failed


def _result(found: dict[Weights, Checked], folder: Path, incomplete: str = "") -> Result:
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
    notes = [_note(entry, checked, folder) for entry, checked in found.items()]
    closing = "A license is the project's; --json says where none is stated for the weights themselves."
    entries = [_entry_json(entry, each, folder) for entry, each in found.items()]
    data = {"task": "weights", "folder": str(folder), "weights": entries}
    if not found:  # nothing to check
        return Result(
            data, [], [f"No weights are installed in {folder}; `dpc evaluate weights list` shows what there is."]
        )
    return Result(data, [table], [*notes, closing, f"Folder: {folder}"], incomplete)


def _note(entry: Weights, checked: Checked, folder: Path) -> str:
    """Returns where an entry is and what was checked, or where it comes from."""
    if checked.state != "absent":
        return f"{entry.name}: {folder / entry.file} ({checked.finding})"
    digest = f"SHA-256 {entry.sha256}" if entry.sha256 else "no published digest"
    return f"{entry.name}: {entry.file} from {entry.url} ({digest})"


def _entry_json(entry: Weights, checked: Checked, folder: Path) -> dict[str, Any]:
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
        "state": checked.state,
        "found": checked.finding,
        "sha256": checked.digest or None,
        "by_hand": entry.by_hand,
        "files": files,
        "note": entry.note,
    }
