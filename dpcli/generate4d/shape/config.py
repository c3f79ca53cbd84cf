"""The sizes of the shape network; nothing here needs torch."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

from dpcli.runtime.settings.fields import WIDEST, check, setting
from dpcli.runtime.settings.stored import from_json


@dataclass(frozen=True)
class ShapeConfig:
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

    def __post_init__(self) -> None:
        check(self)

    def to_json(self) -> str:
        """Returns the text that a weights file keeps."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> ShapeConfig:
        """Returns the sizes that `to_json` wrote. Raises DataError as `stored.from_json`."""
        return from_json(cls, text)
