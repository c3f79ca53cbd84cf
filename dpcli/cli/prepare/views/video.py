"""`dpc prepare video`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import typer

from dpcli.cli.options import Force, Seed
from dpcli.cli.prepare.conversion import print_check
from dpcli.cli.prepare.options import BadFrame, Border, Check, FileOrPipe, FramesAtMost, Pattern, PictureSize
from dpcli.cli.prepare.views.writing import write_views


@dataclass(frozen=True)
class PictureOptions:
    """Holds the options that say which frames are read and how each becomes a square picture."""

    frames: FramesAtMost = 32
    size: PictureSize = 512
    recenter: Annotated[
        bool,
        typer.Option(
            "--recenter/--no-recenter", help="One crop around the object for the whole clip; never with --views."
        ),
    ] = True
    border: Border = 0.2
    fps: Annotated[float | None, typer.Option("--fps", help="Frames per second. Default: the file's, else 16.")] = None
    on_error: BadFrame = "stop"
    name: Annotated[str, typer.Option("--name", help="Name of the object. Default: the input's.")] = ""
    pattern: Pattern = ""


@dataclass(frozen=True)
class CutOutOptions:
    """Holds the options that tell the object from its background."""

    HEADING: ClassVar[str] = "Cutting the object out"
    background: Annotated[
        str,
        typer.Option(
            "--background",
            help="Background of frames without alpha: auto, white, black, a color r,g,b, or keep (no cut-out).",
        ),
    ] = "auto"
    tolerance: Annotated[
        float,
        typer.Option(
            "--tolerance", help="Difference from the background's color, 0 to 0.5, up to which a pixel is background."
        ),
    ] = 0.06
    holes: Annotated[
        Literal["auto", "keep", "cut"],
        typer.Option("--holes", help="Enclosed regions of the background's color: keep (filled) or cut (gaps)."),
    ] = "auto"
    mask: Annotated[
        Path | None,
        typer.Option("--mask", help="Folder with a mask for each frame, or a video of them, the object white."),
    ] = None


@dataclass(frozen=True)
class OrbitOptions:
    """Holds the options of the filming camera and of further views."""

    HEADING: ClassVar[str] = "Cameras and further views"
    elevation: Annotated[float, typer.Option("--elevation", help="Elevation of the camera, degrees, up = +.")] = 0.0
    radius: Annotated[float, typer.Option("--radius", help="Distance of the cameras from the object's middle.")] = 2.0
    fovy: Annotated[float, typer.Option("--fovy", help="Vertical field of view of the cameras, degrees.")] = 49.1
    views: Annotated[
        Path | None,
        typer.Option("--views", help="Folder of other views, FRAME/VIEW.png (six, as STAG4D) or VIEW/FRAME.png."),
    ] = None
    views_cameras: Annotated[
        Path | None,
        typer.Option("--views-cameras", help="JSON list of the azimuth, elevation (degrees), radius of --views."),
    ] = None


def video(
    clip: Annotated[Path, typer.Argument(help="Folder of frames (.png .jpg .webp ...), or .mp4 .mov .avi .webm .gif.")],
    pictures: PictureOptions,
    cut_out: CutOutOptions,
    orbit: OrbitOptions,
    output: FileOrPipe = "",
    check: Check = False,
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Read a clip of one object: frames with alpha, masks or a plain background; optionally further views.

    For example: dpc prepare video fox.mp4 --background white -o fox.h5
    """
    from dpcli.prepare.views.transforms_json import is_transforms, transforms_clip, transforms_config
    from dpcli.prepare.views.video import VideoOptions, video_clip, video_config

    options = VideoOptions(**vars(pictures), **vars(cut_out), **vars(orbit))
    if check:
        from dpcli.prepare.views.views_check import ClipIndex

        print_check("video", clip, lambda: ClipIndex(clip, options), file=True)
        return
    read, describe = (transforms_clip, transforms_config) if is_transforms(clip) else (video_clip, video_config)
    config = describe(clip, options)
    write_views(lambda: read(clip, options), output, config=config, source="video", seed=seed, force=force)
