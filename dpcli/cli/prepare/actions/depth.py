"""`dpc prepare depth`: anybody's depth videos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import typer

from dpcli.cli.help_groups import LABELS
from dpcli.cli.prepare.conversion import ConversionOptions, run_conversion
from dpcli.cli.prepare.options import LabelTable, Pattern, Stride, Topic
from dpcli.errors import UsageError

if TYPE_CHECKING:
    from dpcli.prepare.decode.pinhole_camera import Calibration


@dataclass(frozen=True)
class DepthCamera:
    """Holds the options that say which camera filmed."""

    HEADING: ClassVar[str] = "Camera"
    intrinsics: Annotated[
        Path | None, typer.Option("--intrinsics", help="File of RealSense, Open3D, ROS, COLMAP, or with fx fy cx cy.")
    ] = None
    fx: Annotated[float | None, typer.Option("--fx", help="Focal length, pixels; needs --cx and --cy, too.")] = None
    fy: Annotated[float | None, typer.Option("--fy", help="Vertical focal length, pixels. Default: --fx.")] = None
    cx: Annotated[float | None, typer.Option("--cx", help="Principal point, pixels from the left.")] = None
    cy: Annotated[float | None, typer.Option("--cy", help="Principal point, pixels from the top.")] = None
    fov: Annotated[float | None, typer.Option("--fov", help="Horizontal field of view, degrees. Default: 60.")] = None

    def read_calibration(self) -> Calibration | None:
        """Returns the calibration that was given, None when it follows from `--fov`. Raises UsageError on a mixture."""
        pixels = (self.fx, self.fx if self.fy is None else self.fy, self.cx, self.cy)
        if self.intrinsics and any(v is not None for v in pixels):
            raise UsageError("--intrinsics and --fx --fy --cx --cy were both given; use one")
        if not self.intrinsics and all(v is None for v in pixels):
            return None
        from dpcli.prepare.decode.calibration import read_calibration
        from dpcli.prepare.decode.pinhole_camera import Calibration, Intrinsics

        if self.intrinsics:
            return read_calibration(self.intrinsics)
        if any(v is None for v in pixels):
            raise UsageError("--fx, --cx and --cy belong together (--fy defaults to --fx); or use --fov")
        return Calibration(Intrinsics(*(float(v) for v in pixels if v is not None)))


@dataclass(frozen=True)
class DepthPixels:
    """Holds the options that say what a pixel of a depth video means, and which pixels are kept."""

    depth_scale: Annotated[
        float | None,
        typer.Option("--depth-scale", help="Raw units per meter. Default: 1000 (integers; 8-bit 100), 1 (floats)."),
    ] = None
    invert: Annotated[bool, typer.Option("--invert", help="Larger raw values are nearer, not farther.")] = False
    near: Annotated[float, typer.Option("--near", help="Drop what is nearer than this, meters.")] = 0.0
    far: Annotated[float, typer.Option("--far", help="Drop what is farther than this, meters.")] = float("inf")
    background: Annotated[
        Literal["none", "median", "first"],
        typer.Option("--background", help="Remove what stays still: by the median of all frames, or the first frame."),
    ] = "none"
    margin: Annotated[
        float, typer.Option("--margin", help="Foreground is nearer than the background by at least this, meters.")
    ] = 0.05


def depth(
    inputs: Annotated[
        list[Path],
        typer.Argument(help="Videos (.avi .mp4 .mkv .mov), .npy, folders of images, recordings, or folders of these."),
    ],
    camera: DepthCamera,
    pixels: DepthPixels,
    *,
    fps: Annotated[
        float | None, typer.Option("--fps", help="Frames per second. Default: the time stamps of videos.")
    ] = None,
    stride: Stride = 1,
    pattern: Pattern = "",
    topic: Topic = "",
    label_from_folder: Annotated[
        bool,
        typer.Option(
            "--label-from-folder",
            rich_help_panel=LABELS,
            help="Take labels from folders FOLDER/CLASS/VIDEO, or FOLDER/train/CLASS/VIDEO and FOLDER/test/CLASS/VIDEO.",
        ),
    ] = False,
    labels: LabelTable = None,
    conversion: ConversionOptions,
) -> None:
    """Turn any depth video, 8 or 16 bits, into points in meters.

    For example: dpc prepare depth my_videos --label-from-folder --fov 70 -o own.h5
    """
    from dpcli.prepare.actions.depth import DepthVideos

    calibration = camera.read_calibration()
    run_conversion(
        "depth",
        lambda: DepthVideos(
            inputs=tuple(inputs),
            calibration=calibration,
            fov=camera.fov,
            **vars(pixels),
            fps=fps,
            stride=stride,
            labels=labels,
            label_from_folder=label_from_folder,
            pattern=pattern,
            topic=topic,
        ),
        conversion,
        inputs[0],
    )
