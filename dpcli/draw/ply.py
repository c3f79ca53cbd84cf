"""Point clouds with parts as binary PLY, for MeshLab, CloudCompare, Blender and the like."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.draw.palette import part_colors
from dpcli.draw.sequences import PointSequence
from dpcli.errors import DataError

_VERTEX = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("part", "<i4")]
)
_NAMES = {"f": "float", "u": "uchar", "i": "int"}


def write_ply(path: Path, points: np.ndarray, colors: np.ndarray | None, part: np.ndarray) -> None:
    """Writes one frame of points f32 (N,3), colors u8 (N,3) (None: by part), part ids (N) as an int property `part`.

    Binary, little-endian, PLY 1.0 (Turk 1994). DataError on shapes that don't fit, or when it can't be written.
    """
    colors = part_colors(part) if colors is None else colors
    count = len(points)
    if points.shape != (count, 3) or colors.shape != (count, 3) or part.shape != (count,):
        raise DataError(f"{path}: points {points.shape}, colors {colors.shape} and part {part.shape} don't fit")
    rows = np.empty(count, _VERTEX)
    for column, values in zip(_VERTEX.names, [*points.T, *colors.T, part], strict=True):
        rows[column] = values
    properties = [f"property {_NAMES[_VERTEX[name].kind]} {name}" for name in _VERTEX.names]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *properties, "end_header"]
    try:
        path.write_bytes(("\n".join(header) + "\n").encode("ascii") + rows.tobytes())
    except OSError as error:
        raise DataError(f"{path}: cannot be written ({error.strerror}); name an existing folder to write to") from None


def write_ply_frames(folder: Path, sequence: PointSequence) -> list[Path]:
    """Writes every frame of a sequence, colored by part, as 0000.ply, 0001.ply, ... in `folder`, which is made."""
    if sequence.part is None:
        raise DataError(f"sample {sequence.name!r} has no parts to write; `dpc segment predict` finds them")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"--ply {folder}: the folder cannot be made ({error.strerror})") from None
    offsets, paths = sequence.frame_offsets, []
    for t in range(sequence.num_frames):
        span = slice(offsets[t], offsets[t + 1])
        paths.append(folder / f"{t:04d}.ply")
        write_ply(paths[-1], sequence.points[span], None, sequence.part[span])
    return paths
