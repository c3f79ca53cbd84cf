"""`dpc prepare synthetic articulated`."""

from __future__ import annotations

from typing import Annotated

import typer

from dpcli.cli.prepare.articulation import ArticulatedConversion, ArticulationOptions, split_rule
from dpcli.cli.prepare.conversion import run_conversion
from dpcli.cli.prepare.lists import words
from dpcli.cli.prepare.options import CategoryFractions, SequencesPerObject, TestCategories, ValidationCategories


def articulated(
    motion: ArticulationOptions,
    *,
    objects: Annotated[
        int, typer.Option("--objects", min=1, max=100_000, help="Different objects, the kinds in turn.")
    ] = 260,
    sequences_per_object: SequencesPerObject = 4,
    kinds: Annotated[
        str, typer.Option("--kinds", help="Make only these kinds, such as laptop,scissors,lamp. Default: all 26.")
    ] = "",
    test_categories: TestCategories = "",
    validation_categories: ValidationCategories = "",
    fractions: CategoryFractions = "",
    conversion: ArticulatedConversion,
) -> None:
    """Make procedural articulated objects: furniture, appliances, tools, lamps, ... with exact parts and poses.

    Lengths are diameters of the object in frame 0. Categories are kinds.
    """
    from dpcli.prepare.articulated.synthetic_articulated import SyntheticArticulated

    rule = split_rule(test_categories, validation_categories, fractions)
    run_conversion(
        "articulated",
        lambda: SyntheticArticulated(
            objects=objects,
            sequences_per_object=sequences_per_object,
            kinds=words(kinds),
            articulation=motion.articulation(conversion),
            split=rule,
            seed=conversion.seed,
        ),
        conversion,
    )
