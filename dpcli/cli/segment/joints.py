"""`dpc segment joints`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.options import Force, Picture


def joints(
    parts: Annotated[str, typer.Argument(help="Parts file that `dpc segment predict` wrote, or - for a pipe.")],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            help="object.urdf (one object, meshes beside it), joints.json, joints.h5 (the parts file with its joints, for "
            "`dpc evaluate joints`; - for a pipe), or a folder for a URDF of each sequence.",
        ),
    ],
    sequence: Annotated[str | None, typer.Option("--sequence", help="Use this sequence only. Default: all.")] = None,
    picture: Picture = None,
    force: Force = False,
) -> None:
    """Find the joints between rigid parts: a tree of hinges and slides with axes, ranges and values, as URDF, JSON or HDF5."""
    from dpcli.segment.commands.joints import find_joints

    counts = find_joints(parts, output, sequence=sequence, picture=picture, force=force)
    found = ", ".join(f"{count} {kind}" for kind, count in counts.items()) or "no joint: one part only"
    if str(output) != "-":
        typer.echo(f"{output}: {found}")
