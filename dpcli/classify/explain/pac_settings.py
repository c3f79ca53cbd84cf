"""The settings of `dpc classify explain pac`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dpcli.errors import UsageError
from dpcli.runtime.settings.catalog import Catalog
from dpcli.runtime.settings.fields import Settings, setting


@dataclass(frozen=True)
class PacSettings(Settings):
    """Holds what is asked of each clip and how pictures show it. Raises UsageError for a class that no rule asks for."""

    rule: Literal["activation", "gradient"] = setting(
        "activation", "activation (A.1.4: the largest activation, independent of the class) or gradient (Grad-CAM)."
    )
    target: str | None = setting(
        None, "With rule = gradient: a class's name or number, predicted (also for none), or label.", name="class"
    )
    stage: int | None = setting(
        None, "Stage of the network, from 1; none: 1 for rule = activation, the last for gradient.", least=1
    )
    frames: int = setting(8, "Columns of the picture: frames of the clip.", least=1, most=60)
    view: str | None = setting(
        None, "Axes that point right, down and away in pictures, such as xyz or x-zy (z up); none: the camera's."
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.target is not None and self.rule == "activation":
            raise UsageError(
                "class: the rule activation (thesis A.1.4) doesn't depend on a class; add --set rule=gradient"
            )


PAC = Catalog(pac=PacSettings)
