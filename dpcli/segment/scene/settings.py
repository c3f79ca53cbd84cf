"""The settings of `dpc segment predict --scene`; nothing here needs torch, since `--help` reads it."""

from __future__ import annotations

from dataclasses import dataclass

from dpcli.runtime.settings.fields import Settings, setting


@dataclass(frozen=True)
class SceneSettings(Settings):
    """Holds how far things move, and what counts as evidence that one does. Lengths are meters."""

    max_objects: int = setting(31, "--scene: most moving objects of a sequence; the largest are kept.", least=1)
    travel: float = setting(4.0, "--scene: farthest that an object moves between two frames, meters.", above=0)
    ground: float = setting(0.2, "--scene: height above the ground below which points belong to it, meters.", above=0)
    window: int = setting(3, "--scene: frames before and after a frame that it is compared with.", least=1)
    evidence: float = setting(
        8.0, "--scene: points that a motion of its own must explain better before an object counts as moving.", above=0
    )
