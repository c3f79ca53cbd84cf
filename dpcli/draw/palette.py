"""The colors of all pictures: backgrounds and letters, one color per rigid part, color tables for values."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

RGB = tuple[int, int, int]  # 0 to 255


class Theme(NamedTuple):
    """Holds the colors of a picture's ground, of its titles, and of small marks."""

    background: RGB
    ink: RGB
    faint: RGB

    @property
    def page(self) -> RGB:
        """Returns the color between the cells of a sheet: a little lighter than a dark cell, white beside a white one."""
        red, green, blue = (min(channel + 10, 255) for channel in self.background)
        return red, green, blue


DARK = Theme((17, 20, 26), (226, 230, 236), (130, 138, 150))
LIGHT = Theme((255, 255, 255), (40, 44, 52), (130, 138, 150))

# Okabe & Ito's colors without black (Color Universal Design, 2008), then Tol's muted ones that differ from them
PALETTE = np.array(
    [
        [0, 114, 178],
        [230, 159, 0],
        [0, 158, 115],
        [204, 121, 167],
        [86, 180, 233],
        [213, 94, 0],
        [240, 228, 66],
        [136, 34, 85],
        [51, 34, 136],
        [153, 153, 51],
        [68, 170, 153],
        [170, 68, 153],
        [17, 119, 51],
        [221, 204, 119],
    ],
    np.uint8,
)
UNKNOWN = (128, 128, 128)  # of part -1


def part_colors(part: np.ndarray) -> np.ndarray:  # [...] -> [..., 3]
    """Returns the color u8 of each part id: the same id has the same color everywhere; -1 is gray, others repeat after 14.

    >>> part_colors(np.array([0, 14, -1])).tolist()
    [[0, 114, 178], [0, 114, 178], [128, 128, 128]]
    """
    colors = PALETTE[np.maximum(part, 0) % len(PALETTE)]
    colors[np.asarray(part) < 0] = UNKNOWN
    return colors


def heat_colors(values: np.ndarray, low: float = 0.06, high: float = 0.94) -> np.ndarray:  # [N] -> [N, 3]
    """Returns the color u8 of values 0..1 (clamped), blue to red: turbo (Mikhailov 2019) between two of its places.

    >>> heat_colors(np.array([0.0, 1.0])).tolist()
    [[63, 61, 156], [169, 21, 1]]
    """
    from matplotlib import colormaps

    table = (colormaps["turbo"](np.linspace(low, high, 256))[:, :3] * 255).astype(np.uint8)
    return table[np.clip(np.round(values * 255), 0, 255).astype(int)]
