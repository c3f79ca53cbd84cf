"""The legal words of `dpc generate4d export`; they stand apart from the code that writes so that --help is quick."""

from __future__ import annotations

from typing import Literal

Format = Literal["ply", "ply-sequence", "splat", "splat-sequence", "clouds", "cameras", "metrics"]
Axes = Literal["player", "keep"]  # x right, y down, z forward; or as in the scene, y up
