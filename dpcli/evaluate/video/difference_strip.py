"""Draws truth, prediction and their difference side by side, some instants of each view, as one picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.video.sources.source import Picture, View

_INSTANTS, _MOST_VIEWS = 6, 8
_SIDE, _GAP, _TITLE = 160, 4, 18  # pixels


class DifferenceStrip:
    """Collects small cells while a video is scored (`evaluate_video`'s `watch`), and writes them as one picture.

    For each of the first eight views three rows: truth, prediction, and four times the absolute difference.
    """

    def __init__(self, background: tuple[float, float, float]) -> None:
        self.background = background
        self.rows: dict[str, list[tuple[int, np.ndarray]]] = {}

    def __call__(self, view: View, frame: int, frames: int, predicted: Picture, truth: Picture) -> None:
        shown = np.unique(np.linspace(0, frames - 1, _INSTANTS).round().astype(int))
        title = f"view {view.title} ({view.role}): truth, prediction, 4 x difference"
        if frame not in shown or (title not in self.rows and len(self.rows) == _MOST_VIEWS):
            return
        theirs, ours = (_small(picture.over(self.background)) for picture in (truth, predicted))
        apart = np.clip(4 * np.abs(ours - theirs), 0, 1)
        self.rows.setdefault(title, []).append((frame, np.concatenate([theirs, ours, apart])))

    def save(self, path: Path) -> None:
        """Writes the picture. DataError when there is nothing to show, or it can't be written."""
        from PIL import Image, ImageDraw

        if not self.rows:
            raise DataError(f"--picture {path}: no pictures were compared")
        columns = max(len(cells) for cells in self.rows.values())
        height = _TITLE + 3 * _SIDE + _GAP
        sheet = Image.new("RGB", (columns * (_SIDE + _GAP) + _GAP, len(self.rows) * height), (40, 44, 52))
        draw = ImageDraw.Draw(sheet)
        for place, (title, cells) in enumerate(self.rows.items()):
            draw.text((_GAP, place * height + 3), title, fill=(226, 230, 236))
            for column, (frame, cell) in enumerate(cells):
                corner = (_GAP + column * (_SIDE + _GAP), place * height + _TITLE)
                sheet.paste(Image.fromarray((cell * 255 + 0.5).astype(np.uint8)), corner)
                draw.text((corner[0] + 3, corner[1] + 2), str(frame), fill=(110, 110, 110))
        try:
            sheet.save(path)
        except (ValueError, OSError) as error:
            raise DataError(
                f"--picture {path}: cannot be written ({error}); name a .png in an existing folder"
            ) from None


def _small(colors: np.ndarray) -> np.ndarray:
    """Returns a picture f32 (3,H,W) in 0..1 as f32 (S,S,3), the longer side filling the cell."""
    from PIL import Image

    image = Image.fromarray((np.nan_to_num(colors).transpose(1, 2, 0) * 255 + 0.5).astype(np.uint8))
    image.thumbnail((_SIDE, _SIDE))
    cell = np.full((_SIDE, _SIDE, 3), 0.5, np.float32)
    cell[: image.height, : image.width] = np.asarray(image, np.float32) / 255
    return cell
