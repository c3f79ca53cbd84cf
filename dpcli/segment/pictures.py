"""Parts in color: a contact sheet of sequences, and an object on a turntable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.draw.animation import write_pictures
from dpcli.draw.fonts import text_font
from dpcli.draw.palette import LIGHT, part_colors
from dpcli.draw.points import Raster, draw_balls
from dpcli.draw.sheet import save_picture, spread_evenly, write_line
from dpcli.draw.view import turntable_view, upright_axis
from dpcli.errors import DataError, UsageError
from dpcli.store import CloudSequence

_GAP, _TITLE = 8, 22
_AZIMUTH, _ELEVATION = np.deg2rad(-60.0), np.deg2rad(22.0)
_BESIDE_THE_CAMERA = np.deg2rad(-25.0)  # the side that a camera saw, and yet some depth
_MARGIN = 1.12  # of the picture around what is seen
_RATE = 15  # images per second of an animation


@dataclass(frozen=True)
class Look:
    """Holds how parts are drawn.

    cell: pixels of a picture's side. up: the axis that points upwards, such as z or -y. azimuth, elevation: of the
    camera, radians. gray: what the legend calls the points of part -1.
    """

    cell: int = 200
    up: str = "z"
    azimuth: float = _AZIMUTH
    elevation: float = _ELEVATION
    gray: str = "?"

    def __post_init__(self) -> None:
        if self.up not in ("x", "y", "z", "-x", "-y", "-z"):
            raise UsageError(f"up axis {self.up!r}: expected x, y, z, -x, -y or -z")


def usual_look(provenance: Sequence[Mapping[str, Any]], cell: int = 200) -> Look:
    """Returns how the parts of a file are drawn, upright by what its provenance tells of its axes."""
    up = upright_axis(provenance)
    return Look(cell, up, _BESIDE_THE_CAMERA if up == "-y" else _AZIMUTH)


def parts_picture(path: Path, sequences: Sequence[CloudSequence], *, frames: int = 4, look: Look | None = None) -> None:
    """Writes a contact sheet: a row per sequence, its frames as columns, points colored by `part`.

    At most `frames` frames are shown, spread over the sequence. Raises DataError on sequences without parts, or when the
    picture can't be written.
    """
    if not sequences:
        raise DataError(f"{path}: no sequences to draw")
    look = look or Look()
    rows = []
    for sequence in sequences:
        part = _parts_of(sequence)
        shown = spread_evenly(sequence.num_frames, frames)
        rows.append((sequence.name, part, _draw_row(sequence, part, shown, look)))
    save_picture(_assemble(rows, look), path)


def _parts_of(sequence: CloudSequence) -> np.ndarray:
    if sequence.part is None:
        raise DataError(f"sample {sequence.name!r} has no parts to draw; `dpc segment predict` finds them")
    return sequence.part


def _draw_row(sequence: CloudSequence, part: np.ndarray, shown: list[int], look: Look) -> list[np.ndarray]:
    """Returns the frames `shown` drawn as cells u8 (cell,cell,3), all of one scale."""
    matrix = turntable_view(look.azimuth, look.elevation, look.up)
    seen = sequence.points @ matrix.T
    low, high = np.percentile(seen, [0.1, 99.9], axis=0)
    scale = look.cell / (_MARGIN * max(float((high - low)[:2].max()), 1e-9))
    offsets, colors = sequence.frame_offsets, part_colors(part)
    spans = [slice(offsets[t], offsets[t + 1]) for t in shown]
    raster, depth = Raster(look.cell, look.cell, (low + high)[:2] / 2, scale), (float(low[2]), float(high[2]))
    return [draw_balls(seen[span], colors[span], raster, LIGHT.background, depth) for span in spans]


def _assemble(rows: list[tuple[str, np.ndarray, list[np.ndarray]]], look: Look) -> Any:
    from PIL import Image, ImageDraw

    columns = max(len(cells) for _, _, cells in rows)
    step = look.cell + _TITLE
    sheet = Image.new("RGB", (columns * look.cell + 2 * _GAP, len(rows) * step + 2 * _GAP), LIGHT.background)
    draw = ImageDraw.Draw(sheet)
    for place, (title, part, cells) in enumerate(rows):
        top = _GAP + place * step
        room = _legend(draw, top, sheet.width - _GAP, part, look.gray)
        write_line(draw, (_GAP, top + 3), title, room - 2 * _GAP, LIGHT.ink)
        for column, cell in enumerate(cells):
            sheet.paste(Image.fromarray(cell), (_GAP + column * look.cell, top + _TITLE))
    return sheet


def _legend(draw: Any, top: int, right: int, part: np.ndarray, gray: str) -> int:
    """Draws swatches of the parts with their share of the points, right-aligned, on half the row; returns where they start."""
    ids, counts = np.unique(part, return_counts=True)
    font, start, left = text_font(11), right // 2, right
    for own, count in reversed(list(zip(ids.tolist(), counts.tolist(), strict=True))):
        percent = round(100 * count / len(part)) or "<1"
        text = f"{gray if own < 0 else own}: {'>99' if percent == 100 and len(ids) > 1 else percent} %"
        width = int(draw.textlength(text, font=font)) + 20
        if left - width < start:
            draw.text((left - 14, top + 4), "…", fill=LIGHT.ink, font=font)
            return left - 14
        left -= width
        color = tuple(part_colors(np.array([own]))[0].tolist())
        draw.ellipse((left, top + 6, left + 9, top + 15), fill=color)
        draw.text((left + 13, top + 4), text, fill=LIGHT.ink, font=font)
    return left


def turntable(path: Path, sequence: CloudSequence, *, seconds: float = 6.0, look: Look | None = None) -> None:
    """Writes an animation (.gif): one turn about the upright axis, while the frames pass to the last one and back.

    Points are colored by `part`. Raises DataError on a sequence without parts or when the file can't be written.
    """
    if path.suffix.lower() != ".gif":
        raise UsageError(f"{path}: unknown kind of animation {path.suffix!r}; expected .gif")
    look = look or Look(cell=320)
    colors, offsets = part_colors(_parts_of(sequence)), sequence.frame_offsets
    low, high = np.percentile(sequence.points, [0.1, 99.9], axis=0)
    centered = sequence.points - (low + high) / 2
    radius = max(float(np.percentile(np.linalg.norm(centered, axis=1), 99.9)), 1e-9)
    raster = Raster(look.cell, look.cell, np.zeros(2), look.cell / (2 * radius * _MARGIN))
    count = max(int(seconds * _RATE), 1)
    images = []
    for image, t in enumerate(there_and_back(sequence.num_frames, count)):
        matrix = turntable_view(look.azimuth + 2 * np.pi * image / count, look.elevation, look.up)
        span = slice(offsets[t], offsets[t + 1])
        seen = centered[span] @ matrix.T
        images.append(draw_balls(seen, colors[span], raster, LIGHT.background, (-radius, radius)))
    write_pictures(path, images, _RATE, force=True)


def there_and_back(frames: int, count: int) -> list[int]:
    """Returns which of the frames each of `count` images shows: from the first to the last and back, resting at both ends."""
    phase = np.arange(count) / count
    swing = (1 - np.cos(2 * np.pi * phase)) / 2
    return np.minimum((swing.round(9) * frames).astype(int), frames - 1).tolist()
