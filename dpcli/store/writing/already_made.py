"""The check of an output that is there before a command begins: is it the result of the very same work?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from dpcli.config_diff import differences
from dpcli.errors import DataError, UsageError
from dpcli.runtime.progress import log
from dpcli.runtime.whole_file import refuse_existing
from dpcli.store.writing.journal import sweep

WORK = ("config", "seed", "inputs", "version")  # what makes two commands the same work, data and program included
_PLAIN = ("seed", "version", "inputs")
_NAMED = 4  # differences that a refusal names


class HasProvenance(Protocol):
    """Describes a reader that knows the commands that led to its file, oldest first."""

    @property
    def provenance(self) -> list[dict]:
        """Returns the entries as `runtime.provenance.record` makes them."""


def already_made(
    target: Path,
    entry: dict[str, Any],
    reader: Callable[[Path], HasProvenance],
    keys: Sequence[str] = ("config", "seed", "inputs"),
) -> bool:
    """Returns whether `target` holds the result of the work that `entry`, a provenance entry, describes, and logs it.

    `reader` opens the file and checks it. Compared is the last command that made it, by `keys` of its entry. False if
    there is no such file. Raises UsageError when the file is another one's: of no kind that `reader` takes, or made
    otherwise; the error names what differs. Leftovers of a run that was killed just after it had finished the file are removed.
    """
    if not target.exists():
        return False
    refuse_existing(target, force=True)
    try:
        history = reader(target).provenance
    except DataError as error:
        raise UsageError(f"{error}\nIt is where the output should go: write to another file, or use --force") from None
    before = history[-1] if history else {}
    if not history or any(before.get(key) != entry.get(key) for key in keys):
        made = _describe_differences(before, entry) if history else "by another program"
        raise UsageError(f"{target}: exists, made {made}; write to another file, or --force to replace it")
    sweep(target)
    log.info(f"{target}: already complete, made by the same command from the same data (--force makes it again)")
    return True


def _describe_differences(before: dict[str, Any], now: dict[str, Any]) -> str:
    """Returns the first settings that differ, and the inputs that are other files, in words."""
    old, new = ({**entry.get("config", {}), **{key: entry.get(key) for key in _PLAIN}} for entry in (before, now))
    return "with " + ("; ".join(differences(old, new)[:_NAMED]) or "other settings")
