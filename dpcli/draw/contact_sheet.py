"""A contact sheet of point cloud sequences: a row per sample, frames over time as columns, seen from the front.

Drawn by a small z-buffer of our own: thousands of frames' points a second, no window system, no GPU.
"""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.store import CloudSequence, CloudsReader

CAMERA_VIEW = "xyz"  # right, down, away: OpenCV camera axes
IMAGE_VIEW = "yx-z"  # row, column and a depth that grows toward the viewer
_HEIGHT = 150  # pixels of a cell
_GAP, _TITLE, _HEADER = 4, 18, 20
_BACKGROUND, _INK, _FAINT = (17, 20, 26), (226, 230, 236), (130, 138, 150)
_NARROW, _WIDE = 0.6, 2.0  # a cell's width as a multiple of its height
_FAR = np.float32(np.inf)


@dataclass(frozen=True)
class Raster:
    """Pixels of a cell, and where the row's points lie: center (2) and scale in pixels per unit."""

    width: int
    height: int
    center: np.ndarray
    scale: float


def parse_view(text: str) -> np.ndarray:
    """Rows of a signed permutation, f32 (3,3), from axis names for right, down and away, such as `xyz` or `x-zy`."""
    axes = re.findall(r"-?[xyz]", text)
    if "".join(axes) != text or sorted(axis[-1] for axis in axes) != ["x", "y", "z"]:
        raise UsageError(f"--view {text}: expected the axes that point right, down and away, such as xyz or x-zy")
    matrix = np.zeros((3, 3), np.float32)
    for row, axis in enumerate(axes):
        matrix[row, "xyz".index(axis[-1])] = -1 if axis[0] == "-" else 1
    return matrix


def default_view(length_unit: str) -> str:
    """Image coordinates (row, column, ...) need another view than camera axes; the unit tells which a file has."""
    return IMAGE_VIEW if "row, column" in length_unit else CAMERA_VIEW


def spread_samples(labels: np.ndarray, count: int) -> list[int]:
    """At most `count` samples: the first of each class (or of evenly chosen classes), then the second of each, ..."""
    members: dict[int, list[int]] = defaultdict(list)
    for index, label in enumerate(np.asarray(labels).tolist()):
        members[label].append(index)
    classes = sorted(members)
    if len(classes) == 1:
        return sorted({int(i) for i in np.linspace(0, len(labels) - 1, min(count, len(labels))).round()})
    if count < len(classes):
        chosen = np.linspace(0, len(classes) - 1, count).round().astype(int)
        return [members[classes[i]][0] for i in chosen]
    turns = sorted((turn, label, index) for label in classes for turn, index in enumerate(members[label]))
    return [index for _, label, index in sorted(turns[:count], key=lambda item: (item[1], item[0]))]


def contact_sheet(reader: CloudsReader, path: Path, samples: int = 8, frames: int = 8, view: str | None = None) -> None:
    """Write the sheet to `path`. Color: the file's own, else the rigid part, else depth (bright = near).

    The scale is the same within a row. Reads only the frames it shows. DataError when the picture can't be written.
    """
    axes = parse_view(view or default_view(reader.length_unit))
    rows = []
    for index in spread_samples(reader.labels, samples):
        shown = np.unique(np.linspace(0, reader.frame_counts[index] - 1, frames).round().astype(int))
        sequence = reader.read(index, shown.tolist(), [f for f in ("color", "part") if f in reader.fields])
        rows.append((_row_title(reader, index), shown, sequence.points @ axes.T, sequence))
    if not rows:
        raise DataError(f"{reader.path}: no sequences to draw")
    width = _cell_width([points for _, _, points, _ in rows])
    pictures = [(title, shown, _draw_row(points, sequence, width)) for title, shown, points, sequence in rows]
    _assemble(pictures, width, path)


def _row_title(reader: CloudsReader, index: int) -> str:
    label = int(reader.labels[index])
    name = reader.class_names[label] if 0 <= label < len(reader.class_names) else ""
    known = f"{label} {name}".strip() if label >= 0 else ""
    return " · ".join(part for part in (known, reader.names[index], reader.splits[index]) if part)


def _box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Center and extent (2) of what is seen, without the farthest thousandth on each side (stray points)."""
    low, high = np.percentile(points[:, :2], [0.1, 99.9], axis=0)
    return (low + high) / 2, np.maximum((high - low) * 1.1, 1e-6)


def _cell_width(rows: list[np.ndarray]) -> int:
    """One width for all cells, such that the widest row fills its cells."""
    aspects = [extent[0] / extent[1] for extent in (_box(points)[1] for points in rows)]
    return int(_HEIGHT * np.clip(max(aspects), _NARROW, _WIDE))


def _draw_row(points: np.ndarray, sequence: CloudSequence, width: int) -> list[np.ndarray]:
    center, extent = _box(points)
    raster = Raster(width, _HEIGHT, center, float(min(width / extent[0], _HEIGHT / extent[1])))
    colors = _colors(points, sequence)
    offsets = sequence.frame_offsets
    spans = [slice(int(a), int(b)) for a, b in zip(offsets[:-1], offsets[1:], strict=True)]
    return [draw_frame(points[span], colors[span], raster) for span in spans]


def _colors(points: np.ndarray, sequence: CloudSequence) -> np.ndarray:
    """Color of each point, u8 (P,3)."""
    if sequence.color is not None:
        return sequence.color
    from matplotlib import colormaps

    if sequence.part is not None and len(np.unique(sequence.part)) > 1:
        palette = (np.array(colormaps["tab20"].colors) * 255).astype(np.uint8)
        return palette[sequence.part % len(palette)]
    near, far = np.percentile(points[:, 2], [1, 99])
    depth = np.clip((points[:, 2] - near) / max(far - near, 1e-6), 0, 1)
    table = (colormaps["turbo"](np.linspace(0.92, 0.12, 256))[:, :3] * 255).astype(np.uint8)
    return table[(depth * 255).astype(int)]


def draw_frame(points: np.ndarray, colors: np.ndarray, raster: Raster) -> np.ndarray:
    """Image u8 (H,W,3) of points f32 (N,3) (right, down, away) with colors u8 (N,3).

    Each point is a small square, the nearest wins, and relief is shaded.
    """
    height, width = raster.height, raster.width
    image = np.empty((height, width, 3), np.uint8)
    image[:] = _BACKGROUND
    pixels = np.floor((points[:, :2] - raster.center) * raster.scale + np.array([width, height]) / 2).astype(np.int64)
    size = _dot_size(pixels)
    order = np.argsort(-points[:, 2], kind="stable")  # far to near: of several writes to a pixel the last one stays
    offsets = np.stack(np.meshgrid(np.arange(size), np.arange(size)), -1).reshape(-1, 2) - size // 2
    spread = (pixels[order, None] + offsets).reshape(-1, 2)
    source = np.repeat(order, len(offsets))
    inside = ((spread >= 0) & (spread < [width, height])).all(axis=1)
    columns, rows, source = spread[inside, 0], spread[inside, 1], source[inside]
    image[rows, columns] = colors[source]
    depth = np.full((height, width), _FAR, np.float32)
    depth[rows, columns] = points[source, 2] * np.float32(raster.scale)
    return _relief(*_fill_gaps(image, depth))


def _dot_size(pixels: np.ndarray) -> int:
    """Side of a point's square in pixels: larger when the points lie apart. 1..4."""
    if len(pixels) < 2:
        return 3
    low, high = np.percentile(pixels, [5, 95], axis=0)
    area = float(np.prod(np.maximum(high - low, 1)))
    return int(np.clip(np.round(np.sqrt(0.5 * area / len(pixels)) + 0.6), 1, 4))


def _fill_gaps(image: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Close gaps one pixel wide, left where points on a grid are drawn a little apart."""
    for _ in range(2):  # rows, then columns
        left, right = depth[:, :-2], depth[:, 2:]
        gap = ~np.isfinite(depth[:, 1:-1]) & np.isfinite(left) & np.isfinite(right)
        rows, columns = np.nonzero(gap)
        image[rows, columns + 1], depth[rows, columns + 1] = image[rows, columns], depth[rows, columns]
        image, depth = image.transpose(1, 0, 2), depth.T
    return image, depth


def _relief(image: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Darken pixels that lie behind their neighbors (eye-dome lighting, Boucheny 2009), so that shape shows."""
    padded = np.pad(depth, 1, constant_values=_FAR)
    drop = np.zeros_like(depth)
    drawn = np.isfinite(depth)
    for dy, dx in ((0, 1), (2, 1), (1, 0), (1, 2)):
        beside = padded[dy : dy + depth.shape[0], dx : dx + depth.shape[1]]
        step = np.where(drawn & np.isfinite(beside), depth, 0) - np.where(drawn & np.isfinite(beside), beside, 0)
        drop += np.clip(step, 0, 8)
    shade = np.exp(-0.05 * drop)[..., None]
    return np.where(drawn[..., None], (image * shade).astype(np.uint8), image)


def _assemble(rows: list[tuple[str, np.ndarray, list[np.ndarray]]], width: int, path: Path) -> None:
    from PIL import Image, ImageDraw

    columns = max(len(cells) for _, _, cells in rows)
    size = (columns * (width + _GAP) + _GAP, len(rows) * (_HEIGHT + _TITLE + _GAP) + _GAP)
    sheet = Image.new("RGB", size, tuple(c + 10 for c in _BACKGROUND))
    draw = ImageDraw.Draw(sheet)
    for place, (title, shown, cells) in enumerate(rows):
        top = _GAP + place * (_HEIGHT + _TITLE + _GAP)
        _write(draw, (_GAP + 2, top + 1), title, size[0] - 2 * _GAP)
        for column, (number, cell) in enumerate(zip(shown, cells, strict=True)):
            left = _GAP + column * (width + _GAP)
            sheet.paste(Image.fromarray(cell), (left, top + _TITLE))
            draw.text((left + 4, top + _TITLE + 2), str(number), fill=_FAINT, font=text_font(10))
    save_sheet(sheet, path)


def _write(draw: Any, place: tuple[int, int], text: str, room: int) -> None:
    """Text in one line, shortened to the room (pixels) there is."""
    font = text_font(13)
    while draw.textlength(text, font=font) > room and len(text) > 2:
        text = text[:-2] + "…"
    draw.text(place, text, fill=_INK, font=font)


def text_font(size: int) -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(size=size)


def save_sheet(sheet: Any, path: Path) -> None:
    try:
        sheet.save(path)
    except (ValueError, OSError) as error:
        raise DataError(f"--picture {path}: cannot be written ({error}); name a .png in an existing folder") from None
