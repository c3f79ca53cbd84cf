"""Options of the commands that draw sequences from articulated objects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import typer

from dpcli.cli.prepare.conversion import ConversionOptions
from dpcli.cli.prepare.lists import three_shares, words

if TYPE_CHECKING:
    from dpcli.prepare.articulated.articulated_sequence import Articulation
    from dpcli.prepare.articulated.object_splits import SplitRule


@dataclass(frozen=True)
class ArticulatedConversion(ConversionOptions):
    """Holds the options of every conversion; points are drawn on surfaces here, not chosen among those of a frame."""

    points: Annotated[int, typer.Option("--points", min=1, help="Points per frame.")] = 512
    sampling: Annotated[
        Literal["random", "fps", "voxel"],
        typer.Option("--sampling", help="random: drawn by area. fps, voxel: chosen among 4 times as many."),
    ] = "random"


@dataclass(frozen=True)
class ArticulationOptions:
    """Holds the options that say how an articulated object moves and how it is seen."""

    HEADING: ClassVar[str] = "Motion and view"
    frames: Annotated[int, typer.Option("--frames", min=1, max=10_000, help="Frames per sequence.")] = 4
    view: Annotated[
        Literal["full", "single"],
        typer.Option("--view", help="full: the whole surface. single: what one camera sees of it."),
    ] = "full"
    orientation: Annotated[
        Literal["random", "upright"],
        typer.Option("--orientation", help="Orientation of a sequence: any, or turned about z alone, which is up."),
    ] = "random"
    rotation: Annotated[
        float,
        typer.Option("--rotation", min=0.0, max=180.0, help="Additional rotation of each frame, up to this, degrees."),
    ] = 15.0
    translation: Annotated[
        float, typer.Option("--translation", min=0.0, help="Shift of each frame, up to this per axis, in diameters.")
    ] = 0.05
    joint_step: Annotated[
        float,
        typer.Option(
            "--joint-step",
            help="Share of its range by which a joint changes at most between frames; 1: independent values.",
        ),
    ] = 0.3
    max_parts: Annotated[
        int,
        typer.Option(
            "--max-parts", min=2, help="Parts of an object at most; to keep to it, randomly chosen joints stay still."
        ),
    ] = 8
    min_part: Annotated[
        int,
        typer.Option("--min-part", min=0, help="Points that even a small part gets; tiny parts are joined to others."),
    ] = 8
    min_motion: Annotated[
        float,
        typer.Option(
            "--min-motion", min=0.0, help="Joints that move no point by at least this, in diameters, stay still."
        ),
    ] = 0.02
    visible_only: Annotated[
        bool, typer.Option("--visible-only", help="Joints that change no shape (a spinning wheel) stay still, too.")
    ] = False

    def articulation(self, conversion: ConversionOptions) -> Articulation:
        """Returns these options, with the number of points, as `dpcli.prepare` takes them."""
        from dpcli.prepare.articulated.articulated_sequence import Articulation

        return Articulation(points_per_frame=conversion.points, sampling=conversion.sampling, **vars(self))


def split_rule(test: str, validation: str, fractions: str) -> SplitRule:
    """Returns the rule that the options --test-categories, --validation-categories and --fractions make."""
    from dpcli.prepare.articulated.object_splits import SplitRule

    return SplitRule(words(test), words(validation), three_shares(fractions) if words(fractions) else ())
