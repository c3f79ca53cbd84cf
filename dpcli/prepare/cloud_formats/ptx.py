"""PTX files of terrestrial scanners (Leica Cyclone): one scan or several, each with the place where the scanner stood."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.cloud import AT_ORIGIN, Cloud, cloud_of_columns, require_points
from dpcli.prepare.cloud_formats.plain_numbers import parse_plain
from dpcli.text_files import decode_text

_HEADER = (1, 1, 3, 3, 3, 3, 4, 4, 4, 4)  # numbers in the lines before a scan: columns, rows, scanner, axes, matrix
_MOST = 1e9  # columns or rows of a scan
_NAMES = "x y z intensity red green blue".split()


def read_ptx(path: Path, keep: Sequence[str] = ()) -> Cloud:
    """Reads the points of all scans, turned and moved as each scan's matrix says, without rays that met nothing.

    Raises DataError when a scan's header is none, or a scan holds fewer points than it says.
    """
    scans = list(_scans(path, [line for line in decode_text(path).split("\n") if line.strip()]))
    scans = [scan for scan in scans if len(scan)] or scans[:1]  # one without points has no columns to compare
    if len({scan.shape[1] for scan in scans}) != 1:
        raise DataError(
            f"{path}: its scans have different columns; expected x y z intensity, and perhaps colors, in all"
        )
    values = np.concatenate(scans)
    met = np.isfinite(values).all(1)
    cloud = cloud_of_columns(path, dict(zip(_NAMES, values[met].T)), keep)
    cloud.dropped = {AT_ORIGIN: int(np.count_nonzero(~met))} if not met.all() else {}
    return cloud


def _scans(path: Path, lines: list[str]) -> Iterator[np.ndarray]:
    """Yields the columns of each scan, f64 (N,4 or 7), NaN for x, y and z where a ray met nothing."""
    start = 0
    while start < len(lines) or not start:
        header = [_numbers(line) for line in lines[start : start + len(_HEADER)]]
        if tuple(map(len, header)) != _HEADER or not all(
            0 <= one[0] < _MOST and one[0].is_integer() for one in header[:2]
        ):
            raise DataError(
                f"{path}: row {start + 1} begins no scan; expected its columns, rows, axes and a 4x4 matrix"
            )
        first, count = start + len(_HEADER), int(header[0][0] * header[1][0])
        rows = lines[first : first + count]
        require_points(path, count, len(rows))
        width = len(rows[0].split()) if rows else 4
        values = parse_plain("\n".join(rows), width, None) if rows else np.empty((0, width))
        if values is None or width not in (4, 7):
            raise DataError(f"{path}: a row of a scan is no x y z intensity [red green blue]; damaged, export it again")
        matrix = np.array(header[6:])
        if not np.allclose(matrix[:, 3], (0, 0, 0, 1)):
            raise DataError(
                f"{path}: the matrix in rows {start + 7} to {start + 10} doesn't end with 0 0 0 1 in its last column, as PTX"
                " has it, whose last row is the scanner's place; export it again, or transpose it"
            )
        met = (values[:, :3] != 0).any(1)
        values[:, :3] = np.where(met[:, None], values[:, :3] @ matrix[:3, :3] + matrix[3, :3], np.nan)
        yield values
        start = first + count


def _numbers(line: str) -> list[float]:
    """Returns the numbers of a line, none where it holds words."""
    try:
        return [float(word) for word in line.split()]
    except ValueError:
        return []
