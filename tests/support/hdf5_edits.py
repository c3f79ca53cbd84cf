"""Changes to HDF5 files that a test makes behind the back of the library."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py

Change = Callable[[h5py.File], object]


def edit(path: Path, change: Change) -> None:
    """Opens a file and changes it."""
    with h5py.File(path, "r+") as file:
        change(file)


def replacing(name: str, values: object) -> Change:
    """Returns the change that puts values, or a link, in the place of what is there."""

    def change(file: h5py.File) -> None:
        del file[name]
        file[name] = values

    return change
