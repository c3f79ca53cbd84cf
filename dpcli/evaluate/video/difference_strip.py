"""Draws truth, prediction and their difference side by side, some instants of each view, as one picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.draw.sheet import SheetRow, contact_sheet, save_picture, spread_evenly
from dpcli.errors import DataError
from dpcli.evaluate.video.sources.source import Picture, View

_INSTANTS, _MOST_VIEWS = 6, 8
_SIDE = 160  # pixels of a cell


class DifferenceStrip:
    """Collects small cells while a video is scored (`evaluate_video`'s `watch`), and writes them as one picture.

    For each of the first eight views three rows: truth, prediction, and four times the absolute difference.
    """

    def __init__(self, background: tuple[float, float, float]) -> None:
        self.background = background
        self.rows: dict[str, list[tuple[int, np.ndarray]]] = {}

    def __call__(self, view: View, frame: int, frames: int, predicted: Picture, truth: Picture) -> None:
        shown = spread_evenly(frames, _INSTANTS)
        title = f"view {view.title} ({view.role}): truth, prediction, 4 x difference"
        if frame not in shown or (title not in self.rows and len(self.rows) == _MOST_VIEWS):
            return
        theirs, ours = (_small(picture.over(self.background)) for picture in (truth, predicted))
        apart = np.clip(4 * np.abs(ours - theirs), 0, 1)
        self.rows.setdefault(title, []).append((frame, np.concatenate([theirs, ours, apart])))

    def save(self, path: Path) -> None:
        """Writes the picture. Raises DataError when there is nothing to show, or it can't be written."""
        if not self.rows:
            raise DataError(f"--picture {path}: no pictures were compared")
        rows = [
            SheetRow(
                title, [str(frame) for frame, _ in cells], [(cell * 255 + 0.5).astype(np.uint8) for _, cell in cells]
            )
            for title, cells in self.rows.items()
        ]
        save_picture(contact_sheet(rows), path)


def _small(colors: np.ndarray) -> np.ndarray:
    """Returns a picture f32 (3,H,W) in 0..1 as f32 (S,S,3), the longer side filling the cell."""
    from PIL import Image

    image = Image.fromarray((np.nan_to_num(colors).transpose(1, 2, 0) * 255 + 0.5).astype(np.uint8))
    if max(image.size) < _SIDE:  # whole pixels
        image = image.resize([side * (_SIDE // max(image.size)) for side in image.size], Image.Resampling.NEAREST)
    image.thumbnail((_SIDE, _SIDE))
    cell = np.full((_SIDE, _SIDE, 3), 0.5, np.float32)
    cell[: image.height, : image.width] = np.asarray(image, np.float32) / 255
    return cell
