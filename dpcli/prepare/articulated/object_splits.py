"""Splits of objects: each trains, validates or tests by its category, or by a draw with given shares."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from dpcli.errors import UsageError
from dpcli.prepare.reader import SPLITS
from dpcli.runtime.seeds import PrepareStream, generator


def counts_of_splits(splits: Iterable[str]) -> str:
    """Returns how many train, validate and test, in words: "8 train, 2 test"."""
    counts = Counter(splits)
    return ", ".join(f"{counts[split]} {split}" for split in SPLITS if counts[split])


@dataclass(frozen=True)
class SplitRule:
    """Assigns splits: objects of the named categories validate or test; the others are divided by ``fractions`` (of
    SPLITS).

    Without fractions: all others train when categories are named, else 80, 10 and 10 %. One object is in one split.
    """

    test_categories: tuple[str, ...] = ()
    validation_categories: tuple[str, ...] = ()
    fractions: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        both = sorted(set(self.test_categories) & set(self.validation_categories))
        if both:
            raise UsageError(f"{', '.join(both)}: in --test-categories and in --validation-categories; choose one")
        good = len(self.fractions) == 3 and min(self.fractions) >= 0 and abs(sum(self.fractions) - 1) < 1e-6
        if self.fractions and not good:
            given = ",".join(map(str, self.fractions))
            raise UsageError(f"--fractions {given}: expected train,validation,test that sum to 1, such as 0.8,0.1,0.1")

    def assign(self, categories: list[str], seed: int) -> list[str]:
        """Returns the split of every object, whose ``categories`` are given in the order of the objects."""
        known = set(categories)
        for option, named in (("test", self.test_categories), ("validation", self.validation_categories)):
            unknown = sorted(set(named) - known)
            if unknown:
                found = ", ".join(sorted(known - {""})) or "none"
                raise UsageError(f"--{option}-categories {', '.join(unknown)}: no such category; found: {found}")
        by_category = dict.fromkeys(self.validation_categories, "validation") | dict.fromkeys(
            self.test_categories, "test"
        )
        splits = [by_category.get(category, "") for category in categories]
        rest = [index for index, split in enumerate(splits) if not split]
        fractions = self.fractions or ((1.0, 0.0, 0.0) if by_category else (0.8, 0.1, 0.1))
        ends = [round(len(rest) * sum(fractions[: k + 1])) for k in range(3)]
        for place, which in enumerate(generator(seed, PrepareStream.OBJECT_SPLIT).permutation(len(rest))):
            splits[rest[which]] = SPLITS[next(k for k, end in enumerate(ends) if place < end)]
        return splits
