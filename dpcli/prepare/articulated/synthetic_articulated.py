"""Procedural articulated objects: as many shapes as one likes from a seed, with the exact parts and poses."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dpcli.counted import counted
from dpcli.errors import UsageError
from dpcli.prepare.articulated.articulated_object import ArticulatedObject
from dpcli.prepare.articulated.articulated_sequence import Articulation, Study, draw_sequence, study
from dpcli.prepare.articulated.object_splits import SplitRule, counts_of_splits
from dpcli.prepare.articulated.procedural.kinds import KINDS
from dpcli.prepare.articulated.procedural.solids import Builder
from dpcli.prepare.reader import Item, Reader, Sample, describe, require_least
from dpcli.runtime.seeds import PrepareStream, generator


def build_object(seed: int, number: int, kinds: tuple[str, ...]) -> ArticulatedObject:
    """Builds object ``number`` of a seed; its kind is the next in the circle of ``kinds``, its shape is drawn."""
    kind = kinds[number % len(kinds)]
    builder = Builder()
    KINDS[kind](builder, generator(seed, PrepareStream.MADE, number))
    return builder.build(f"{kind} {number}")


@lru_cache(maxsize=8)
def _studied(seed: int, number: int, kinds: tuple[str, ...], options: Articulation) -> Study:
    return study(build_object(seed, number, kinds), options)


@dataclass(frozen=True)
class SyntheticArticulated(Reader):
    """Makes procedural objects. ``kinds``: those to make; empty for all."""

    objects: int = 260
    sequences_per_object: int = 4
    kinds: tuple[str, ...] = ()
    articulation: Articulation = Articulation()
    split: SplitRule = SplitRule()
    seed: int = 0
    length_unit: ClassVar[str] = "object diameter"
    fields: ClassVar[tuple[str, ...]] = ("part", "pose", "joint")

    def __post_init__(self) -> None:
        require_least(self, objects=1, sequences_per_object=1)
        if len(set(self.kinds)) < len(self.kinds):
            raise UsageError(
                f"--kinds {','.join(self.kinds)}: a kind is named twice; each is made as often as the others"
            )
        unknown = sorted(set(self.kinds) - set(KINDS))
        if unknown:
            raise UsageError(f"--kinds {', '.join(unknown)}: not known; expected some of {', '.join(KINDS)}")

    @property
    def class_names(self) -> list[str]:
        return sorted(self.kinds or KINDS)

    @property
    def config(self) -> dict[str, Any]:
        own = asdict(self)
        articulation = own.pop("articulation")
        return own | articulation

    def items(self) -> list[Item]:
        names = tuple(self.class_names)
        kinds = [names[number % len(names)] for number in range(self.objects)]
        splits = self.split.assign(kinds, self.seed)
        joints = max(len(build_object(self.seed, number, names).joints) for number in range(self.objects))
        extra = {"parts": min(self.articulation.max_parts, 1 + joints)}
        return [
            Item(
                f"{kind}_{number:05}_{k:03}",
                Path(kind),
                split=split,
                label=names.index(kind),
                extra={**extra, "object": number},
            )
            for number, (kind, split) in enumerate(zip(kinds, splits))
            for k in range(self.sequences_per_object)
        ]

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        studied = _studied(self.seed, item.extra["object"], tuple(self.class_names), self.articulation)
        return draw_sequence(item.name, studied, self.articulation, item.extra["parts"], rng, **describe(item))

    def summary(self, items: list[Item]) -> list[str]:
        shares = counts_of_splits({item.extra["object"]: item.split for item in items}.values())
        kinds = min(self.objects, len(self.class_names))  # they take turns
        return [
            f"{counted(self.objects, 'object')} of {counted(kinds, 'kind')} ({shares}), {counted(len(items), 'sequence')}"
        ]
