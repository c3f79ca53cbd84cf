"""`dpc prepare sapien`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.prepare.articulation import ArticulatedConversion, ArticulationOptions, split_rule
from dpcli.cli.prepare.conversion import run_conversion
from dpcli.cli.prepare.options import CategoryFractions, SequencesPerObject, TestCategories, ValidationCategories


def sapien(
    raw: Annotated[Path, typer.Argument(help="Folder of CATEGORY/ID/mobility.urdf, of ID/..., or any .urdf file.")],
    motion: ArticulationOptions,
    *,
    pairs_per_object: SequencesPerObject = 8,
    test_categories: TestCategories = "",
    validation_categories: ValidationCategories = "",
    fractions: CategoryFractions = "",
    allow_outside: Annotated[
        bool, typer.Option("--allow-outside", help="Meshes may be outside RAW: through links, .. or absolute paths.")
    ] = False,
    conversion: ArticulatedConversion,
) -> None:
    """Read articulated objects, PartNet-Mobility (SAPIEN) or any URDF: moving parts with exact poses.

    Lengths are diameters of the object in frame 0.
    """
    from dpcli.prepare.articulated.sapien import Sapien

    rule = split_rule(test_categories, validation_categories, fractions)
    run_conversion(
        "sapien",
        lambda: Sapien(
            raw=raw,
            pairs_per_object=pairs_per_object,
            articulation=motion.articulation(conversion),
            split=rule,
            seed=conversion.seed,
            allow_outside=allow_outside,
        ),
        conversion,
        raw,
    )
