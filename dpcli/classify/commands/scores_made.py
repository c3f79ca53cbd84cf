"""The check of `predict` and `fuse` whether their scores are there already."""

from __future__ import annotations

from pathlib import Path

from dpcli.runtime.progress import log
from dpcli.store import ScoresReader
from dpcli.store.writing.already_made import WORK, already_made

OTHER_SCORES = "holds scores of another model, data or choice; use another -o, or --force to replace it"


def already_scored(target: Path, entry: dict) -> bool:
    """Returns whether `target` holds the scores of this very work, and says so. Raises UsageError when it holds something
    else."""
    if not already_made(target, entry, ScoresReader, OTHER_SCORES, WORK):
        return False
    log.info(f"{target}: already complete, made from the same model and data (--force makes it again)")
    return True
