"""One color per rigid part, the same in every picture."""

from __future__ import annotations

import numpy as np

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


def part_colors(part: np.ndarray) -> np.ndarray:
    """Color u8 (N,3) of part ids (N): the same id has the same color everywhere; -1 is gray, others repeat after 14."""
    colors = PALETTE[np.maximum(part, 0) % len(PALETTE)]
    colors[np.asarray(part) < 0] = UNKNOWN
    return colors
