"""The check of an output that is there before a command begins: is it the result of the very same work?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from dpcli.errors import DataError, UsageError
from dpcli.store.writing.journal import sweep

WORK = ("config", "seed", "inputs", "version")  # what makes two commands the same work, data and program included
_NAMED = 4  # settings that a refusal names


class HasProvenance(Protocol):
    """A reader that knows the commands that led to its file, oldest first."""

    @property
    def provenance(self) -> list[dict]:
        """The entries as `runtime.provenance.record` makes them."""


def already_made(
    target: Path,
    entry: dict[str, Any],
    reader: Callable[[Path], HasProvenance],
    refusal: str = "exists, made with {differences}; write to another file, or --force to replace it",
    keys: Sequence[str] = ("config", "seed"),
) -> bool:
    """Returns whether `target` holds the result of the work that `entry`, a provenance entry, describes; False if it is absent.

    `reader` opens the file and checks it. Compared is the last command that made it, by `keys` of its entry. Raises
    UsageError when the file is another one's: of no kind that `reader` takes, or made otherwise, which `refusal` says
    behind its name. Leftovers of a run that was killed just after it had finished the file are removed.
    """
    if not target.exists():
        return False
    try:
        history = reader(target).provenance
    except DataError as error:
        raise UsageError(f"{error}\nIt stands where the output should go: write to another file, or --force") from None
    before = history[-1] if history else {}
    if not history or any(before.get(key) != entry.get(key) for key in keys):
        raise UsageError(f"{target}: {refusal.format(differences=_differences(before, entry))}")
    sweep(target)
    return True


def _differences(before: dict[str, Any], now: dict[str, Any]) -> str:
    """Returns the first settings that differ, in words."""
    old, new = ({**entry.get("config", {}), "seed": entry.get("seed")} for entry in (before, now))
    names = [name for name in {**old, **new} if old.get(name) != new.get(name)]
    return ", ".join(f"{name} {old.get(name)} (now {new.get(name)})" for name in names[:_NAMED])
