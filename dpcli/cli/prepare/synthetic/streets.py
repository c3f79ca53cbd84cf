"""`dpc prepare synthetic streets`."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from dpcli.cli.prepare.conversion import ConversionOptions, run_conversion


def streets(
    *,
    streets: Annotated[int, typer.Option("--streets", min=1, max=100_000, help="Streets, a sequence of each.")] = 10,
    frames: Annotated[int, typer.Option("--frames", min=1, max=10_000, help="Frames of a sequence.")] = 4,
    rows: Annotated[Literal["64", "32", "16"], typer.Option("--rows", help="Beams of the lidar.")] = "64",
    movers: Annotated[int, typer.Option("--movers", min=0, max=1000, help="The most bodies that move.")] = 6,
    fps: Annotated[float, typer.Option("--fps", help="Frames per second.")] = 10.0,
    speed: Annotated[float, typer.Option("--speed", help="The lidar's own highest speed, m/s.")] = 12.0,
    noise: Annotated[float, typer.Option("--noise", help="Noise of ranges (standard deviation), meters.")] = 0.02,
    dropout: Annotated[float, typer.Option("--dropout", help="Share of rays that are lost, at random.")] = 0.05,
    conversion: ConversionOptions,
) -> None:
    """Make streets with cars, buses, cyclists and people, scanned by a spinning lidar that drives along.

    Part 0 is everything that stands still. Poses give the true motion of every point.
    """
    from dpcli.prepare.synthetic.streets import SyntheticStreets

    run_conversion(
        "streets",
        lambda: SyntheticStreets(
            streets=streets,
            frames=frames,
            rows=int(rows),
            movers=movers,
            fps=fps,
            speed=speed,
            noise=noise,
            dropout=dropout,
            seed=conversion.seed,
        ),
        conversion,
    )
