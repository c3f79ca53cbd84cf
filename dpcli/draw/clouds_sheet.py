"""A contact sheet of point cloud sequences: a row per sample, frames over time as columns, seen from the front."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np

from dpcli.draw.palette import heat_colors, part_colors
from dpcli.draw.points import Raster, draw_dots
from dpcli.draw.sequences import CloudsSource, PointSequence
from dpcli.draw.sheet import SheetRow, contact_sheet, save_picture, spread_evenly
from dpcli.draw.view import default_view, parse_view
from dpcli.errors import DataError

_HEIGHT = 150  # pixels of a cell
_NARROW, _WIDE = 0.6, 2.0  # a cell's width as a multiple of its height


def spread_samples(labels: np.ndarray, count: int) -> list[int]:
    """Returns at most `count` samples: those of `first_of_classes`, or of a single class evenly chosen ones."""
    return spread_evenly(len(labels), count) if len(np.unique(labels)) == 1 else first_of_classes(labels, count)


def first_of_classes(labels: np.ndarray, count: int) -> list[int]:
    """Returns at most `count` samples: the first of each class (or of evenly chosen classes), then the second of each, ...

    >>> first_of_classes(np.array([0, 0, 0, 1, 2, 2]), 4)
    [0, 1, 3, 4]
    """
    members: dict[int, list[int]] = defaultdict(list)
    for index, label in enumerate(np.asarray(labels).tolist()):
        members[label].append(index)
    classes = sorted(members)
    if count < len(classes):
        chosen = np.linspace(0, len(classes) - 1, count).round().astype(int)
        return [members[classes[i]][0] for i in chosen]
    turns = sorted((turn, label, index) for label in classes for turn, index in enumerate(members[label]))
    return [index for _, label, index in sorted(turns[:count], key=lambda item: (item[1], item[0]))]


def clouds_sheet(reader: CloudsSource, path: Path, samples: int = 8, frames: int = 8, view: str | None = None) -> None:
    """Writes the sheet to `path`. Color: the file's own, else the rigid part, else depth (bright = near).

    The scale is the same within a row. Reads only the frames it shows. Raises DataError when the picture can't be written.
    """
    axes = parse_view(view or default_view(reader.length_unit, reader.provenance))
    rows = []
    for index in spread_samples(reader.labels, samples):
        shown = spread_evenly(int(reader.frame_counts[index]), frames)
        sequence = reader.read(index, shown, [f for f in ("color", "part") if f in reader.fields])
        rows.append((_row_title(reader, index), shown, sequence.points @ axes.T, sequence))
    if not rows:
        raise DataError(f"{reader.path}: no sequences to draw")
    width = _cell_width([points for _, _, points, _ in rows])
    drawn = [
        SheetRow(title, [str(frame) for frame in shown], _draw_row(points, sequence, width))
        for title, shown, points, sequence in rows
    ]
    save_picture(contact_sheet(drawn), path)


def _row_title(reader: CloudsSource, index: int) -> str:
    label = int(reader.labels[index])
    name = reader.class_names[label] if 0 <= label < len(reader.class_names) else ""
    label_words = f"{label} {name}".strip() if label >= 0 else ""
    return " · ".join(part for part in (label_words, reader.names[index], reader.splits[index]) if part)


def _box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns center and extent (2) of what is seen, without the farthest thousandth on each side (stray points)."""
    low, high = np.percentile(points[:, :2], [0.1, 99.9], axis=0)
    return (low + high) / 2, np.maximum((high - low) * 1.1, 1e-6)


def _cell_width(rows: list[np.ndarray]) -> int:
    """Returns one width for all cells, such that the widest row fills its cells."""
    aspects = [extent[0] / extent[1] for extent in (_box(points)[1] for points in rows)]
    return int(_HEIGHT * np.clip(max(aspects), _NARROW, _WIDE))


def _draw_row(points: np.ndarray, sequence: PointSequence, width: int) -> list[np.ndarray]:
    center, extent = _box(points)
    raster = Raster(width, _HEIGHT, center, float(min(width / extent[0], _HEIGHT / extent[1])))
    colors, offsets = _point_colors(points, sequence), sequence.frame_offsets
    spans = [slice(int(a), int(b)) for a, b in zip(offsets[:-1], offsets[1:], strict=True)]
    return [draw_dots(points[span], colors[span], raster) for span in spans]


def _point_colors(points: np.ndarray, sequence: PointSequence) -> np.ndarray:  # [P, 3]
    if sequence.color is not None:
        return sequence.color
    if sequence.part is not None and len(np.unique(sequence.part)) > 1:
        return part_colors(sequence.part)
    near, far = np.percentile(points[:, 2], [1, 99])
    return heat_colors((points[:, 2] - near) / max(far - near, 1e-6), 0.92, 0.12)
