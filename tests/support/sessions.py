"""The processes of a session, for tests that kill some of them and see whether any survives."""

from __future__ import annotations

from pathlib import Path


def members(session: int) -> dict[int, int]:
    """Returns the living processes of a session and their parents."""
    found = {}
    for place in Path("/proc").glob("[0-9]*"):
        try:
            fields = (place / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == session and fields[0] not in "ZX":
            found[int(place.name)] = int(fields[1])
    return found


def workers_of(session: int) -> list[int]:
    """Returns the processes whose parent is the fork server, not the command itself."""
    family = members(session)
    return [pid for pid, parent in family.items() if parent in family and parent != session]
