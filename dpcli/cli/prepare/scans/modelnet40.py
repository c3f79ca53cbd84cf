"""`dpc prepare modelnet40`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.prepare.conversion import ConversionOptions, run_conversion


def modelnet40(
    raw: Annotated[Path, typer.Argument(help="Folder modelnet40_ply_hdf5_2048: ply_data_train0.h5 ... and the lists.")],
    conversion: ConversionOptions,
) -> None:
    """Read ModelNet40: 12,308 shapes of 40 kinds, one frame each, to pretrain a static stream."""
    from dpcli.prepare.scans.modelnet40 import ModelNet40

    run_conversion("modelnet40", lambda: ModelNet40(raw), conversion, raw)
