"""A `dpc` command in this process: for tests about what it says or makes, not about processes. Saves the start."""

from __future__ import annotations

from dpcli.cli.app import main


def exit_code(*words: object) -> int:
    """Run it; what it would have left to the shell."""
    try:
        main(list(map(str, words)))
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0
