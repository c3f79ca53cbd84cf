"""The settings of `dpc segment predict`; nothing here needs torch, since `--help` reads it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple

from dpcli.errors import UsageError
from dpcli.runtime.settings.catalog import Catalog
from dpcli.runtime.settings.fields import Settings, setting, settings_of
from dpcli.segment.baselines.settings import METHODS, ClassicalSettings
from dpcli.segment.multibody.settings import MultibodySettings
from dpcli.segment.network.config import Precision
from dpcli.segment.scene.settings import SceneSettings


@dataclass(frozen=True)
class InputSettings(Settings):
    """Holds which sequences are divided, and how the flow between their frames is estimated."""

    flow: str = setting(
        "auto",
        "Flow between frames: icp (rigid bodies), nearest (point), the file or folder of a trained estimator (dpc segment"
        " flow), or tracks (the points' own identities, method multibody); auto: tracks where the file has them, else"
        " icp.",
    )
    split: str = setting("all", "Sequences of this split, or all.")


@dataclass(frozen=True)
class Refinement(Settings):
    """Holds what is done with the masks that a segmenter gives, and which motions are fitted to them."""

    points: int = setting(
        512, "Points of a frame that the segmenter sees; its answer is carried back to all points.", least=32
    )
    pairs: Literal["adjacent", "all"] = setting("adjacent", "Pairs of frames whose motions are found.")
    icp: int = setting(20, "Steps of object-aware ICP that refine the motions.", least=0, most=1000)
    vote: bool = setting(True, "Blend each frame's mask with its neighbors', carried along the flow.")
    split_bodies: bool = setting(True, "Divide a part of the network's whose points move as several rigid bodies.")
    smallest: float = setting(
        0.03,
        "Parts below this share of a sequence's points are given to each point's next best part; with --parts N at most"
        " 1 / 2N.",
        least=0,
    )
    normalize: bool = setting(True, "Scale each sequence to diameter 1 before it is looked at.")


class PredictSettings(NamedTuple):
    """Holds all settings of `dpc segment predict`, by group."""

    input: InputSettings = InputSettings()
    classical: ClassicalSettings = ClassicalSettings()
    refinement: Refinement = Refinement()
    precision: Precision = Precision()
    multibody: MultibodySettings = MultibodySettings()
    scene: SceneSettings = SceneSettings()

    def refuse_unread(self, names: Iterable[str]) -> None:
        """Raises UsageError for a setting among those given, by public name, that the chosen method doesn't read.

        Which classical method reads which of their own settings is checked by `ClassicalSettings`.
        """
        method = self.classical.method
        for name in names:
            owners = _OWNERS.get(name, (method,))
            if method not in owners:
                raise UsageError(
                    f"{name} belongs to --method {' or '.join(owners)}; {method} doesn't read it, leave it out"
                )


_BY_FRAMES = ("network", *METHODS)
_OWNERS = {  # settings that only some methods read -> which
    **{one.name: ("multibody",) for one in settings_of(MultibodySettings)},
    **{one.name: ("scene",) for one in settings_of(SceneSettings)},
    **dict.fromkeys(("points", "normalize"), ("multibody", *_BY_FRAMES)),
    **dict.fromkeys(("icp", "vote", "smallest"), _BY_FRAMES),
    "split_bodies": ("network",),
}
CATALOG = Catalog(
    input=InputSettings,
    classical=ClassicalSettings,
    refinement=Refinement,
    precision=Precision,
    multibody=MultibodySettings,
    scene=SceneSettings,
)
