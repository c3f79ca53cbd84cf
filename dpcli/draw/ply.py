"""Point clouds with parts as binary PLY, for MeshLab, CloudCompare, Blender and the like."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.draw.palette import part_colors
from dpcli.draw.sequences import PointSequence
from dpcli.errors import DataError, UsageError
from dpcli.path_names import frame_names
from dpcli.runtime.whole_file import check_replaced, make_folder, whole_file, write_whole

_VERTEX = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("part", "<i4")]
)
_NAMES = {"<f4": "float", "<f8": "double", "|u1": "uchar", "<i4": "int"}


def write_ply(path: Path, points: np.ndarray, part: np.ndarray) -> None:
    """Writes one frame of points f32 or f64 (N,3), which stay so, colored by their part ids (N), an int property `part`.

    Binary, little-endian, PLY 1.0 (Turk 1994). Raises DataError on shapes that don't fit, or when it can't be written.
    """
    count = len(points)
    if points.shape != (count, 3) or part.shape != (count,):
        raise DataError(f"{path}: points {points.shape} and part {part.shape} don't fit")
    wide = "<f8" if points.dtype == np.float64 else "<f4"
    vertex = np.dtype([(name, wide if name in "xyz" else _VERTEX[name]) for name in _VERTEX.names])
    rows = np.empty(count, vertex)
    for column, values in zip(vertex.names, [*points.T, *part_colors(part).T, part], strict=True):
        rows[column] = values
    properties = [f"property {_NAMES[vertex[name].str]} {name}" for name in vertex.names]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *properties, "end_header"]
    write_whole(path, ("\n".join(header) + "\n").encode("ascii") + rows.tobytes())


def write_ply_frames(folder: Path, sequence: PointSequence) -> list[Path]:
    """Writes every frame of a sequence, colored by part, as 0000.ply, 0001.ply, ... in `folder`, which appears whole.

    Frames that an earlier run left there are replaced, also where they were more. A sequence that was shifted (maps) is written
    where the raw data have it, in float64. Raises UsageError where a file is, or the folder holds other things.
    """
    if sequence.part is None:
        raise DataError(f"sample {sequence.name!r} has no parts to write; `dpc segment predict` finds them")
    if folder.is_file():
        raise UsageError(f"--ply {folder}: is a file, expected a folder for the frames")
    check_replaced(folder, ("[0-9]*.ply",))
    make_folder(folder.parent, "--ply")
    offsets, names = sequence.frame_offsets, frame_names(range(sequence.num_frames), ".ply")
    with whole_file(folder) as part:
        make_folder(part, "--ply")
        for t, name in enumerate(names):
            span = slice(offsets[t], offsets[t + 1])
            points = sequence.points[span]
            points = points if sequence.shift is None else points.astype(np.float64) + sequence.shift
            write_ply(part / name, points, sequence.part[span])
    return [folder / name for name in names]
