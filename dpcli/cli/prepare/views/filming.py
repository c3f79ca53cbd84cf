"""Options of the commands that film an animated mesh with virtual cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from dpcli.cli.options import Seed
from dpcli.cli.prepare.conversion import require_output
from dpcli.cli.prepare.lists import degrees
from dpcli.cli.prepare.options import FileOrPipe, PictureSize

if TYPE_CHECKING:
    from dpcli.prepare.meshes.filming import Filming

TRUTH = "Ground truth"  # heading in the help


@dataclass(frozen=True)
class FilmingOptions:
    """Holds the options that say how an animated mesh is filmed."""

    output: FileOrPipe = ""
    size: PictureSize = 512
    azimuths: Annotated[
        str, typer.Option("--azimuths", help="Azimuths of the test views, degrees; the input view is at 0.")
    ] = "15,-75,105,195"
    train_azimuths: Annotated[
        str, typer.Option("--train-azimuths", help="Azimuths of further views to fit to, degrees, such as 90,180.")
    ] = ""
    elevation: Annotated[float, typer.Option("--elevation", help="Elevation of all cameras, degrees, up = +.")] = 0.0
    yaw: Annotated[
        float | None,
        typer.Option(
            "--yaw", help="Rotation of the object about the vertical, degrees; at 0 it faces the input camera."
        ),
    ] = None
    travel: Annotated[
        bool,
        typer.Option(
            "--travel/--no-travel",
            help="Keep the object's travel; without it, the object stays in place as on a treadmill.",
        ),
    ] = True
    samples: Annotated[int, typer.Option("--samples", min=1, max=8, help="N x N rays per pixel.")] = 2
    shading: Annotated[float, typer.Option("--shading", help="From 0 (plain colors) to 1 (full light and shade).")] = (
        0.5
    )
    tracks: Annotated[
        int,
        typer.Option(
            "--tracks", min=0, max=1_000_000, rich_help_panel=TRUTH, help="Surface points of ground truth; 0: none."
        ),
    ] = 4096
    part_tolerance: Annotated[
        float,
        typer.Option(
            "--part-tolerance",
            rich_help_panel=TRUTH,
            help="Bones that differ from their parent by less than this are one part with it, in object radii.",
        ),
    ] = 0.01
    min_part: Annotated[
        float,
        typer.Option("--min-part", rich_help_panel=TRUTH, help="Parts of a smaller share of the points join another."),
    ] = 0.01
    seed: Seed = 0

    def filming(self, yaw: float) -> Filming:
        """Returns these options as `dpcli.prepare` takes them. yaw: the angle, degrees, where none was given.

        Raises UsageError when no output was named.
        """
        from dpcli.prepare.meshes.filming import Filming

        require_output(self.output)
        values = {key: value for key, value in vars(self).items() if key not in ("output", "azimuths")}
        values["train_azimuths"] = degrees(self.train_azimuths, "--train-azimuths")
        values["yaw"] = yaw if self.yaw is None else self.yaw
        return Filming(test_azimuths=degrees(self.azimuths, "--azimuths"), **values)
