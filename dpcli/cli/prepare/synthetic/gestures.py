"""`dpc prepare synthetic gestures`."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from dpcli.cli.prepare.conversion import ConversionOptions, run_conversion


def gestures(
    *,
    videos_per_class: Annotated[
        int, typer.Option("--videos-per-class", max=100_000, help="Videos of each of the 10 classes.")
    ] = 20,
    frames: Annotated[
        int, typer.Option("--frames", max=10_000, help="Frames per video; with a radar on average.")
    ] = 24,
    subjects: Annotated[
        int,
        typer.Option(
            "--subjects",
            max=100_000,
            help="People (at most as many as a class has videos); the first 60 % of them are for training.",
        ),
    ] = 10,
    size: Annotated[int, typer.Option("--size", max=4096, help="Image width, pixels; the height is 3/4 of it.")] = 160,
    noise: Annotated[float, typer.Option("--noise", min=0.0, help="Sensor noise; 1 is like a Kinect's.")] = 1.0,
    sensor: Annotated[
        Literal["depth", "radar"],
        typer.Option(
            "--sensor", help="A depth camera, or a radar: 1 to 64 points a frame, with Doppler and intensity."
        ),
    ] = "depth",
    conversion: ConversionOptions,
) -> None:
    """Make arm gestures whose pairs differ only in the direction of time, seen by a virtual depth camera or radar."""
    from dpcli.prepare.synthetic.gestures import SyntheticGestures
    from dpcli.prepare.synthetic.radar_gestures import RadarGestures

    reader = RadarGestures if sensor == "radar" else SyntheticGestures
    run_conversion(
        "gestures",
        lambda: reader(
            videos_per_class=videos_per_class,
            frames=frames,
            subjects=subjects,
            size=size,
            noise=noise,
            seed=conversion.seed,
        ),
        conversion,
    )
