"""Files of a folder, and links: one that leads out of the data is an error, because the file may not be what it seems."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from dpcli.errors import DataError


def leads_out(path: Path, root: Path) -> str:
    """Returns where a link takes ``path`` outside ``root``, "" when it stays inside or is no link at all."""
    target = os.path.realpath(path)
    inside = os.path.realpath(root)
    return "" if target == inside or target.startswith(inside.rstrip(os.sep) + os.sep) else target


def folder_files(folder: Path, root: Path, suffix: str) -> Iterator[tuple[str, Path]]:
    """Yields (name, path) of the files in a folder that end in ``suffix``, in no order.

    Raises DataError at a link out of ``root``.
    """
    with os.scandir(folder) as entries:
        for entry in entries:
            if not entry.name.lower().endswith(suffix):
                continue
            if entry.is_symlink() and (target := leads_out(Path(entry.path), root)):
                raise DataError(f"{entry.path}: a link that leads out of the data, to {target}; copy the file here")
            yield entry.name, Path(entry.path)
