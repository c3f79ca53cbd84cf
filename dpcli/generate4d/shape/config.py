"""The sizes of the shape network; nothing here needs torch."""

from __future__ import annotations

from dataclasses import dataclass

from dpcli.runtime.settings.fields import WIDEST, Settings, setting
from dpcli.runtime.settings.stored import StoredConfig


@dataclass(frozen=True)
class ShapeConfig(StoredConfig, Settings):
    """Holds the sizes of a shape network."""

    widths: tuple[int, ...] = setting(
        (24, 64, 128, 192),
        "Channels of the levels; the first works at half of the pictures' size.",
        least=1,
        most=WIDEST,
    )
    hidden: int = setting(128, "Width of the layers that predict the angles.", least=1, most=WIDEST)
    bins: int = setting(15, "Bins of each angle.", least=2, most=360)
    lengths: bool = setting(False, "Whether the length along the line of sight is predicted, too, in as many bins.")
