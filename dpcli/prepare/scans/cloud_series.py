"""Finds the frames of point cloud sequences in a tree of folders: one sequence at most in each folder."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from os.path import splitext
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.reader import natural_key
from dpcli.prepare.series import TEXTS, Series, choose_series, is_hidden

_PREFERRED = (".ply", ".pcd", ".las", ".laz", ".npz", ".npy", ".bin", ".xyz")  # of two files of one frame

_ABOUT_SENSORS = re.compile(  # folders whose texts tell of the vehicle, the camera or the objects
    r"oxts|imu|gps|gnss|poses?|odom\w*|calib\w*|labels?|label_\d|time_?stamps?|traj\w*|(in|ex)trinsics?", re.IGNORECASE
)
_FOREIGN = tuple(  # clouds and meshes that others read, and packed ones
    ".e57 .obj .stl .off .drc .glb .gltf .fbx .dae .usdz .fls .rcp .rcs .gz .zip .7z .rar .h5 .hdf5 .mat .xlsx .xls .ods"
    " .pcap .lvx .lvx2 .vtk .vtp .wrl .pkl .pt .pth .tfrecord".split()
)


def find_sequences(
    root: Path, suffixes: Sequence[str], *, pattern: str = "", table: Path | None = None
) -> list[Series]:
    """Returns the sequence of every folder at or below ``root`` that holds one, in natural order of the folders.

    suffixes: of point clouds. pattern: of the names of frames. table: a file that is no cloud, whatever its name. Raises
    DataError when there is none, or when a folder's clip must be chosen.
    """
    found, others = [], Counter[str]()
    for folder, names, foreign in _folders(root, suffixes, table.resolve() if table else None):
        others += foreign
        series = choose_series(folder, names, pattern=pattern, suffixes=_PREFERRED) if names else None
        if series and not is_pose(series.paths[0]):
            found.append(replace(series, left_out=(*series.left_out, *_counted(foreign))))
    if not found:
        asked = f" whose names fit --pattern '{pattern}'" if pattern else ""
        advice = f"; found {', '.join(_counted(others))}: save their points as .ply" if others else ""
        raise DataError(f"{root}: no point clouds ({', '.join(suffixes)}){asked}, or folders of them{advice}")
    return _without_logs(root, sorted(found, key=lambda one: natural_key(one.folder.relative_to(root).as_posix())))


def _without_logs(root: Path, found: list[Series]) -> list[Series]:
    """Returns the sequences without the texts of folders such as KITTI's ``oxts``, which the first one names as left out;
    all of them where there is nothing else.
    """

    def is_log(one: Series) -> bool:
        parts = one.folder.relative_to(root).parts
        return one.suffix in TEXTS and any(_ABOUT_SENSORS.fullmatch(part) for part in parts)

    logs = [one for one in found if is_log(one)]
    if len(logs) in (0, len(found)):
        return found
    first, *others = [one for one in found if one not in logs]
    named = [f"{one.folder.relative_to(root).as_posix()}/{one.described()}" for one in logs]
    return [replace(first, left_out=(*first.left_out, *named)), *others]


def _counted(foreign: Counter[str]) -> tuple[str, ...]:
    return tuple(f"{count} {suffix} file{'s' if count > 1 else ''}" for suffix, count in sorted(foreign.items()))


def _folders(root: Path, suffixes: Sequence[str], table: Path | None) -> Iterator[tuple[Path, list[str], Counter[str]]]:
    """Yields every folder at or below ``root`` with the names of its point clouds, and how many it has in formats that
    are not read, by suffix; no folder that has neither.
    """
    for folder, below, names in os.walk(root):
        below[:] = [name for name in below if not is_hidden(name)]
        clouds = [name for name in names if is_cloud(name, suffixes) and Path(folder, name).is_file()]
        if table is not None:
            clouds = [name for name in clouds if Path(folder, name).resolve() != table]
        foreign = Counter(splitext(name)[1].lower() for name in names if name.lower().endswith(_FOREIGN))
        if clouds or foreign:
            yield Path(folder), clouds, foreign


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
