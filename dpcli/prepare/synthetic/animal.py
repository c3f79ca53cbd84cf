"""A made-up animal that moves, filmed like any animated model: data with ground truth when there are none."""

from __future__ import annotations

from typing import Any

import numpy as np

from dpcli.errors import UsageError
from dpcli.prepare.meshes.animated_mesh import AnimatedMesh
from dpcli.prepare.meshes.filming import Filming, film
from dpcli.prepare.synthetic import creature
from dpcli.prepare.synthetic.creature_mesh import animated_creature, make_skin
from dpcli.prepare.synthetic.gait import MOTIONS, bone_motion, turn_bones
from dpcli.prepare.views.views_pipeline import Clip
from dpcli.runtime.seeds import PrepareStream, generator

_CELLS = 120  # along the longest side of the grid that the skin is cut from


def make_animal(motion: str, frames: int, cycles: float = 0.0, seed: int = 0, cells: int = _CELLS) -> AnimatedMesh:
    """Makes the animal of this seed over `frames` frames; cycles 0: as many as the motion has as a rule.

    Unit: about the length of the body. Raises UsageError on an unknown motion.
    """
    if motion not in MOTIONS:
        raise UsageError(f"--motion {motion}: expected one of {', '.join(MOTIONS)}")
    if not 0 <= cycles <= 100:
        raise UsageError(f"--cycles {cycles:g}: expected 0 (the motion's own) to 100")
    kind, cycles = MOTIONS[motion], cycles or MOTIONS[motion].cycles
    animal = getattr(creature, kind.kind)(generator(seed, PrepareStream.ANIMAL_SHAPE))
    body = make_skin(animal, generator(seed, PrepareStream.ANIMAL_COAT), cells)
    phase = cycles * np.arange(frames) / frames
    turned = bone_motion(animal, *turn_bones(animal, motion, phase))
    return animated_creature(animal, body, turned, name=f"{kind.kind} {seed} {motion}", time=phase * kind.period)


def animal_clip(motion: str, frames: int, cycles: float, filming: Filming, jobs: int = 1) -> Clip:
    """Returns a Clip of the animal of `filming.seed`, as `film` makes it."""
    return film(make_animal(motion, frames, cycles, filming.seed), filming, jobs)


def animal_config(motion: str, frames: int, cycles: float, filming: Filming) -> dict[str, Any]:
    """Returns what decides the content, for the file's provenance."""
    return {"motion": motion, "frames": frames, "cycles": cycles, **filming.config}
