"""Colors of pictures of a scene: parts, weights, depths, backgrounds."""

from __future__ import annotations

import numpy as np

from dpcli.errors import UsageError

_BACKGROUNDS = {"white": (255, 255, 255), "black": (0, 0, 0)}
# viridis at nine places (van der Walt & Smith, CC0): free motion dark, rigid motion bright
WEIGHTS = np.array(
    [
        [68, 1, 84],
        [71, 45, 123],
        [59, 82, 139],
        [44, 114, 142],
        [33, 145, 140],
        [40, 174, 128],
        [94, 201, 98],
        [173, 220, 48],
        [253, 231, 37],
    ],
    np.uint8,
)


def weight_colors(weight: np.ndarray) -> np.ndarray:
    """Returns the colors u8 (...,3) of values 0..1 (clamped): viridis, dark to bright.

    >>> weight_colors(np.array([-1.0, 0.5, 1.0])).tolist()
    [[68, 1, 84], [33, 145, 140], [253, 231, 37]]
    """
    stops = np.linspace(0, 1, len(WEIGHTS))
    channels = [np.interp(weight, stops, WEIGHTS[:, channel]) for channel in range(3)]
    return np.stack(channels, -1).round().astype(np.uint8)


def parse_background(text: str) -> tuple[int, int, int] | None:
    """Returns red, green and blue (0..255) of `white`, `black` or `r,g,b`; None, transparent, of `none`.

    Raises UsageError for any other text.

    >>> parse_background("white"), parse_background("17,20,26"), parse_background("none")
    ((255, 255, 255), (17, 20, 26), None)
    """
    if text == "none":
        return None
    if text in _BACKGROUNDS:
        return _BACKGROUNDS[text]
    try:
        red, green, blue = (int(word) for word in text.split(","))
    except ValueError:
        raise UsageError(f"--background {text}: expected white, black, none or r,g,b such as 17,20,26") from None
    if not all(0 <= value <= 255 for value in (red, green, blue)):
        raise UsageError(f"--background {text}: red, green and blue are 0..255")
    return red, green, blue
