"""Finds the frames of point cloud sequences in a tree of folders: one sequence at most in each folder."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.reader import natural_key
from dpcli.prepare.series import TEXTS, Series, choose_series, is_hidden

_PREFERRED = (".ply", ".pcd", ".las", ".laz", ".npz", ".npy", ".bin", ".xyz")  # of two files of one frame


def find_sequences(
    root: Path, suffixes: Sequence[str], *, pattern: str = "", table: Path | None = None
) -> list[Series]:
    """Returns the sequence of every folder at or below ``root`` that holds one, in natural order of the folders.

    suffixes: of point clouds. pattern: of the names of frames. table: a file that is no cloud, whatever its name. Raises
    DataError when there is none, or when a folder's clip must be chosen.
    """
    found = []
    for folder, names in _folders(root, suffixes, table.resolve() if table else None):
        series = choose_series(folder, names, pattern=pattern, suffixes=_PREFERRED)
        if series and not is_pose(series.paths[0]):
            found.append(series)
    if not found:
        asked = f" whose names fit --pattern '{pattern}'" if pattern else ""
        raise DataError(f"{root}: no point clouds ({', '.join(suffixes)}){asked}, or folders of them")
    return sorted(found, key=lambda one: natural_key(one.folder.relative_to(root).as_posix()))


def _folders(root: Path, suffixes: Sequence[str], table: Path | None) -> Iterator[tuple[Path, list[str]]]:
    """Yields every folder at or below ``root`` with the names of its point clouds, when it has any."""
    for folder, below, names in os.walk(root):
        below[:] = [name for name in below if not is_hidden(name)]
        clouds = [name for name in names if is_cloud(name, suffixes) and Path(folder, name).is_file()]
        if table is not None:
            clouds = [name for name in clouds if Path(folder, name).resolve() != table]
        if clouds:
            yield Path(folder), clouds


def is_cloud(name: str, suffixes: Sequence[str]) -> bool:
    """Returns whether a file name looks like a point cloud."""
    return name.lower().endswith(tuple(suffixes)) and not is_hidden(name)


def is_pose(path: Path) -> bool:
    """Returns whether a text holds the pose of a camera, a 4x4 or 3x4 matrix whose first part is a rotation: no cloud."""
    if path.suffix.lower() not in TEXTS or path.stat().st_size > 2000:
        return False
    try:
        rows = [
            [float(v) for v in line.replace(",", " ").split()] for line in path.read_text().splitlines() if line.strip()
        ]
    except ValueError:  # words, or no text at all
        return False
    if [len(row) for row in rows] not in ([4] * 4, [4] * 3, [12], [16]):
        return False
    matrix = np.array([value for row in rows for value in row]).reshape(-1, 4)
    return bool(np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-3))
