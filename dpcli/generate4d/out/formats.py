"""The legal words of `dpc generate4d export`; they stand apart from the code that writes so that --help is quick."""

from __future__ import annotations

from typing import Literal

Format = Literal[
    "ply", "ply-sequence", "splat", "splat-sequence", "compressed.ply", "spz", "clouds", "cameras", "metrics"
]
# as players take it: x right, y down, z forward (spz: y up, z back); or as in the scene, y up
Axes = Literal["player", "keep"]
