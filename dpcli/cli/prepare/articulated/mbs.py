"""`dpc prepare mbs`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.prepare.conversion import ConversionOptions, run_conversion


def mbs(
    raw: Annotated[Path, typer.Argument(help="Folder of meta.json and data/000000.npz ..., as distributed.")],
    conversion: ConversionOptions,
) -> None:
    """Read mbs-shapepart and mbs-sapien (MultiBodySync): four views of articulated objects, parts and poses."""
    from dpcli.prepare.articulated.mbs import MultiBodySync

    run_conversion("mbs", lambda: MultiBodySync(raw), conversion, raw)
