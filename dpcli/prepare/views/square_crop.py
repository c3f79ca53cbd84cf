"""One square crop for a whole clip, so that what moves keeps moving; alpha-correct resizing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.decode.cv2_import import load_cv2

_LARGEST = 12_000  # pixels of a square's side, above 8K video; more take gigabytes to make smaller
VISIBLE = 26  # alpha from which a pixel counts as the object: a tenth
_OUTLINE = 3  # pixels within which an outline is soft
_MOST = 0.8  # of the frames, and of the pixels of something that stands still in them
_SPECK = 1e-4  # of a picture: smaller things are noise
_FILLED = 0.9  # of a side: corners may be round
Box = tuple[int, int, int, int]  # left, top, right, bottom; right and bottom are the first pixel outside


@dataclass(frozen=True)
class Piece:
    """Holds what can be seen of a picture u8 (height,width,4) that is black and see-through around it."""

    rgba: np.ndarray
    left: int
    top: int
    width: int
    height: int

    @classmethod
    def of(cls, rgba: np.ndarray) -> Piece:
        """Returns a copy of what can be seen of a picture."""
        left, top, right, bottom = _box_of(rgba[..., 3] > 0) or (0, 0, 0, 0)
        return cls(rgba[top:bottom, left:right].copy(), left, top, *rgba.shape[1::-1])

    def whole(self) -> np.ndarray:
        """Returns the whole picture."""
        picture = np.zeros((self.height, self.width, 4), np.uint8)
        height, width = self.rgba.shape[:2]
        picture[self.top : self.top + height, self.left : self.left + width] = self.rgba
        return picture


@dataclass(frozen=True)
class Crop:
    """Holds a square of the source picture: left, top (may be negative) and side, in whole pixels."""

    left: int
    top: int
    side: int

    def apply(self, rgba: np.ndarray, size: int) -> np.ndarray:
        """Cuts u8 (H,W,4) to u8 (size,size,4); transparent where the square reaches over the picture.

        Raises DataError for a square that no camera takes, as a damaged picture's size asks for.
        """
        if self.side > _LARGEST:
            raise DataError(
                f"a square of {self.side:,} pixels would be cut out; expected at most {_LARGEST:,}: make the pictures smaller first"
            )
        square = np.zeros((self.side, self.side, 4), np.uint8)
        part = self.part_of(rgba)
        left, top = max(-self.left, 0), max(-self.top, 0)
        square[top : top + part.shape[0], left : left + part.shape[1]] = part
        return resize(square, size)

    def part_of(self, picture: np.ndarray) -> np.ndarray:
        """Returns what of a picture (H,W,...) lies in the square."""
        rows, columns = (slice(max(start, 0), max(start + self.side, 0)) for start in (self.top, self.left))
        return picture[rows, columns]

    def intrinsics(self, camera: np.ndarray, size: int) -> np.ndarray:
        """Returns f64 (3,3) of the cropped and resized picture: u' = (u - left) size / side; pixel centers at +0.5."""
        scale = size / self.side
        move = np.array([[scale, 0, -scale * self.left], [0, scale, -scale * self.top], [0, 0, 1]])
        return move @ camera


def resize(rgba: np.ndarray, size: int) -> np.ndarray:
    """Resizes u8 (S,S,4) to (size,size,4) on premultiplied colors: transparent pixels don't bleed into the outline."""
    if rgba.shape[:2] == (size, size):
        return rgba
    cv2 = load_cv2()
    alpha = rgba[..., 3:].astype(np.float32) / 255
    colors = np.dstack([rgba[..., :3] * alpha, alpha])
    method = cv2.INTER_AREA if size < len(rgba) else cv2.INTER_LINEAR
    colors = cv2.resize(colors, (size, size), interpolation=method)
    colors[..., :3] /= np.maximum(colors[..., 3:], 1e-6)
    colors[..., 3] *= 255
    result = np.clip(np.round(colors), 0, 255).astype(np.uint8)
    result[result[..., 3] == 0] = 0
    return result


def visible_box(alpha: np.ndarray, island: float = 0.0) -> Box | None:
    """Returns the smallest box around the object in u8 (H,W), None when the picture is empty.

    island: pieces apart that are smaller than this share of the object don't count (leftovers of a segmentation).
    """
    seen = alpha >= VISIBLE
    if island > 0 and seen.any():
        cv2 = load_cv2()
        _, label, stats, _ = cv2.connectedComponentsWithStats(seen.astype(np.uint8), connectivity=8)
        large = stats[:, cv2.CC_STAT_AREA] >= island * seen.sum()
        large[0] = False
        seen = large[label] if large.any() else seen
    return _box_of(seen)


def _box_of(seen: np.ndarray) -> Box | None:
    columns, rows = np.flatnonzero(seen.any(axis=0)), np.flatnonzero(seen.any(axis=1))
    if len(columns) == 0:
        return None
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def pieces(alpha: np.ndarray, share: float) -> tuple[int, np.ndarray]:
    """Returns how many pieces of the object in u8 (H,W) lie apart, none smaller than this share of the largest, and bool (H,W):
    all of it but the largest.
    """
    cv2 = load_cv2()
    _, label, stats, _ = cv2.connectedComponentsWithStats((alpha >= VISIBLE).astype(np.uint8), connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]  # row 0 is the background
    rest = (label > 0) & (label != 1 + (areas.argmax() if len(areas) else 0))
    return int((areas >= share * areas.max(initial=1)).sum()), rest


def still_box(seen: np.ndarray, frames: int) -> Box | None:
    """Returns the smallest box around what keeps its shape and place in nearly all frames, of the numbers of them in which a
    pixel (H,W) was seen; None where nothing does.
    """
    cv2 = load_cv2()
    _, label = cv2.connectedComponents((seen > 0).astype(np.uint8), connectivity=8)
    ever = np.bincount(label.ravel())
    still = np.bincount(label.ravel(), weights=(seen >= _MOST * frames).ravel()) >= _MOST * ever
    still &= ever >= max(4, _SPECK * label.size)
    still[0] = False
    return _box_of(still[label])


def touches_border(alpha: np.ndarray) -> bool:
    """Returns whether the object in u8 (H,W) runs into the picture's border, along at least a hundredth of a side."""
    solid = alpha > 127
    runs = [solid[0].sum(), solid[-1].sum(), solid[:, 0].sum(), solid[:, -1].sum()]
    return max(runs) >= max(2, min(solid.shape) // 100)


def fills_sides(alpha: np.ndarray, box: Box) -> bool:
    """Returns whether the object in u8 (H,W) fills all four sides of its box, as a picture between bars does."""
    left, top, right, bottom = box
    solid = alpha[top:bottom, left:right] > 127
    at = min(_OUTLINE, min(solid.shape) // 2)
    sides = (solid[at], solid[-1 - at], solid[:, at], solid[:, -1 - at]) if at else ()
    return bool(sides) and min(side.mean() for side in sides) > _FILLED


def union(boxes: list[Box]) -> Box:
    """Returns the smallest box that holds all of these, of which there is at least one."""
    left, top, right, bottom = np.array(boxes).T
    return int(left.min()), int(top.min()), int(right.max()), int(bottom.max())


def crop_around(box: Box, border: float) -> Crop:
    """Returns the square around a box that leaves the share `border` of the picture empty along the box's longer side."""
    left, top, right, bottom = box
    side = max(int(round(max(right - left, bottom - top) / (1 - border))), 2)
    return Crop(round((left + right - side) / 2), round((top + bottom - side) / 2), side)


def whole_picture(width: int, height: int) -> Crop:
    """Returns the square that holds the whole picture, centered."""
    side = max(width, height)
    return Crop(-((side - width) // 2), -((side - height) // 2), side)
