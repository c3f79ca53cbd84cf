"""Draws truth, prediction and their difference side by side, some instants of each view, as one picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dpcli.draw.palette import DARK
from dpcli.draw.sheet import SheetRow, contact_sheet, save_picture, spread_evenly
from dpcli.errors import DataError
from dpcli.evaluate.video.sources.source import Picture, View

_INSTANTS, _MOST_VIEWS = 6, 8
_SIDE = 160  # pixels of the longer side of a picture
_LOWEST = 16  # pixels that a frame's number takes


class DifferenceStrip:
    """Collects small cells while a video is scored (`evaluate_video`'s `watch`), and writes them as one picture.

    For each of the first eight views three rows: truth, prediction, and four times the absolute difference.
    """

    def __init__(self, background: tuple[float, float, float]) -> None:
        self.background = background
        self.rows: dict[str, list[tuple[int, list[np.ndarray]]]] = {}

    def __call__(self, view: View, frame: int, frames: int, predicted: Picture, truth: Picture) -> None:
        shown = spread_evenly(frames, _INSTANTS)
        title = f"view {view.title} ({view.role}): truth, prediction, 4 x difference"
        if frame not in shown or (title not in self.rows and len(self.rows) == _MOST_VIEWS):
            return
        theirs, ours = (_small(picture.over(self.background)) for picture in (truth, predicted))
        apart = np.clip(4 * np.abs(ours - theirs), 0, 1)
        pictures = [(picture * 255 + 0.5).astype(np.uint8) for picture in (theirs, ours, apart)]
        self.rows.setdefault(title, []).append((frame, pictures))

    def cells(self) -> dict[str, list[tuple[int, np.ndarray]]]:
        """Returns for each view's title the frames' numbers and cells u8 (3H,W,3), all of one size."""
        shapes = [pictures[0].shape for drawn in self.rows.values() for _, pictures in drawn]
        height, width = (max([_LOWEST, *(shape[axis] for shape in shapes)]) for axis in (0, 1))
        return {
            title: [(frame, _stacked(pictures, height, width)) for frame, pictures in drawn]
            for title, drawn in self.rows.items()
        }

    def save(self, path: Path) -> None:
        """Writes the picture. Raises DataError when there is nothing to show, or it can't be written."""
        if not self.rows:
            raise DataError(f"--picture {path}: no pictures were compared")
        rows = [
            SheetRow(title, [str(frame) for frame, _ in cells], [cell for _, cell in cells])
            for title, cells in self.cells().items()
        ]
        save_picture(contact_sheet(rows), path)


def _small(colors: np.ndarray) -> np.ndarray:
    """Returns a picture f32 (3,H,W) in 0..1 as f32 (h,w,3), as large as fits into a square of _SIDE pixels."""
    from PIL import Image

    image = Image.fromarray((np.nan_to_num(colors).transpose(1, 2, 0) * 255 + 0.5).astype(np.uint8))
    if max(image.size) < _SIDE:  # whole pixels
        image = image.resize([side * (_SIDE // max(image.size)) for side in image.size], Image.Resampling.NEAREST)
    image.thumbnail((_SIDE, _SIDE))
    return np.asarray(image, np.float32) / 255


def _stacked(pictures: Sequence[np.ndarray], height: int, width: int) -> np.ndarray:
    """Returns pictures u8 (h,w,3) one below the other, each in a cell of this size whose rest is the page."""
    cells = np.full((len(pictures), height, width, 3), DARK.page, np.uint8)
    for cell, picture in zip(cells, pictures):
        cell[: picture.shape[0], : picture.shape[1]] = picture
    return cells.reshape(-1, width, 3)
