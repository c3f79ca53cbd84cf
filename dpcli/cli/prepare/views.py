"""`dpc prepare video | artemis`: clips of an object into files of views."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from dpcli.cli.options import Force, Seed
from dpcli.errors import UsageError

_Output = Annotated[str, typer.Option("-o", "--output", help="File to write, or - for a pipe.")]
_Check = Annotated[bool, typer.Option("--check", help="Only look whether all is there; list what is missing.")]
_BadFrame = Annotated[str, typer.Option("--on-error", help="A bad frame: stop, or skip (leave it out).")]
_Size = Annotated[int, typer.Option("--size", min=16, max=4096, help="Side of the square pictures, pixels.")]
_Frames = Annotated[int, typer.Option("--frames", min=0, help="At most this many, evenly sampled; 0 keeps all.")]
_Border = Annotated[
    float, typer.Option("--border", help="Share of the picture left empty along the object's longer side.")
]


def register(app: typer.Typer) -> None:
    """Add the commands to `dpc prepare`."""
    app.command("video")(video)
    app.command("artemis")(artemis)


def video(
    clip: Annotated[Path, typer.Argument(help="Folder of frames (.png .jpg .webp ...), or .mp4 .mov .avi .webm .gif.")],
    output: _Output = "",
    frames: _Frames = 32,
    size: _Size = 512,
    recenter: Annotated[
        bool, typer.Option("--recenter/--no-recenter", help="One crop around the object for the whole clip.")
    ] = True,
    border: _Border = 0.2,
    background: Annotated[
        str,
        typer.Option("--background", help="Of frames without alpha: auto, white, black, r,g,b, or keep (no cut-out)."),
    ] = "auto",
    tolerance: Annotated[
        float, typer.Option("--tolerance", help="Of the background's color, as a share of the value range.")
    ] = 0.06,
    holes: Annotated[
        str,
        typer.Option("--holes", help="Enclosed regions of the background's color: auto, keep (filled), cut (gaps)."),
    ] = "auto",
    mask: Annotated[Path | None, typer.Option("--mask", help="Folder of a mask per frame, object white.")] = None,
    fps: Annotated[float | None, typer.Option("--fps", help="Frames per second. Default: the file's, else 16.")] = None,
    elevation: Annotated[float, typer.Option("--elevation", help="Of the filming camera, degrees, up = +.")] = 0.0,
    radius: Annotated[float, typer.Option("--radius", help="Distance of the cameras.")] = 2.0,
    fovy: Annotated[float, typer.Option("--fovy", help="Vertical field of view of the cameras, degrees.")] = 49.1,
    views: Annotated[
        Path | None,
        typer.Option("--views", help="Folder of other views, FRAME/VIEW.png (six, as STAG4D) or VIEW/FRAME.png."),
    ] = None,
    views_cameras: Annotated[
        Path | None, typer.Option("--views-cameras", help="JSON list of their azimuth, elevation (degrees), radius.")
    ] = None,
    name: Annotated[str, typer.Option("--name", help="Of the object. Default: the input's.")] = "",
    on_error: _BadFrame = "stop",
    check: _Check = False,
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """A clip of one object: frames with alpha, masks or a plain background; optionally further views."""
    from dpcli.prepare.views.transforms_json import is_transforms, transforms_clip, transforms_config
    from dpcli.prepare.views.video import VideoOptions, video_clip, video_config

    options = VideoOptions(
        frames,
        size,
        recenter,
        border,
        background,
        tolerance,
        holes,
        mask,
        fps,
        on_error,
        name,
        elevation,
        radius,
        fovy,
        views,
        views_cameras,
    )
    options.check()
    if check:
        from dpcli.prepare.views.views_check import ClipIndex

        _check("video", clip, lambda: ClipIndex(clip, options), file=True)
        return
    read, describe = (transforms_clip, transforms_config) if is_transforms(clip) else (video_clip, video_config)
    config = describe(clip, options)
    write_views(lambda: read(clip, options), output, config=config, source="video", seed=seed, force=force)


def artemis(
    animal: Annotated[Path, typer.Argument(help="Folder of an animal: img/, bones/, CamPose.inf, Intrinsic.inf, ...")],
    output: _Output = "",
    motion: Annotated[str, typer.Option("--motion", help="Which; without it the motions are listed.")] = "",
    frames: _Frames = 32,
    size: _Size = 512,
    border: _Border = 0.2,
    reference: Annotated[
        int | None, typer.Option("--reference", min=0, help="Camera of the input view. Default: the lowest number.")
    ] = None,
    cameras: Annotated[
        str, typer.Option("--cameras", help="Test cameras, as 1,7,13. Default: nearest to azimuths 15,-75,105,195.")
    ] = "",
    train_cameras: Annotated[str, typer.Option("--train-cameras", help="Further cameras, to fit to.")] = "",
    tracks: Annotated[
        int, typer.Option("--tracks", min=0, help="Points of the volume tracked as ground truth; 0: none.")
    ] = 4096,
    fps: Annotated[float, typer.Option("--fps", help="Frames per second.")] = 30.0,
    on_error: _BadFrame = "stop",
    check: _Check = False,
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """ARTEMIS (DFA): animals filmed by 36 cameras, with bones and skinned voxels as ground truth."""
    if check:
        from dpcli.prepare.views.views_check import ArtemisIndex

        _check("artemis", animal, lambda: ArtemisIndex(animal, motion))
        return
    from dpcli.prepare.views.artemis import ArtemisOptions, artemis_clip, artemis_config

    options = ArtemisOptions(
        motion,
        frames,
        size,
        border,
        reference,
        _numbers(cameras, "--cameras"),
        _numbers(train_cameras, "--train-cameras"),
        tracks,
        fps,
        on_error,
        seed,
    )
    config = artemis_config(animal, options)
    write_views(lambda: artemis_clip(animal, options), output, config=config, source="artemis", seed=seed, force=force)


def write_views(make_clip: Any, output: str, *, source: str, **options: Any) -> None:
    """Convert one clip into `output` (a path, or - for a pipe) and say what it holds."""
    if not output:
        raise UsageError("-o/--output FILE is missing: the file to write, or - for a pipe")
    from dpcli.prepare.views.views_pipeline import convert_clip
    from dpcli.store.pipes import output_file

    with output_file(output) as path:
        header = convert_clip(make_clip, path, source=source, task=f"prepare {source}", **options)
    if output != "-":
        size = f"{header.size[0]}x{header.size[1]}"
        typer.echo(f"{output}: {header.name}, {header.num_views} views, {header.num_frames} frames, {size}")


def _check(name: str, raw: Path, make_index: Any, **options: Any) -> None:
    from dpcli.prepare.recipe_check import check_folder

    for line in check_folder(name, raw, make_index, **options):
        typer.echo(line)


def _numbers(text: str, option: str) -> tuple[int, ...]:
    try:
        return tuple(int(word) for word in text.split(",") if word.strip())
    except ValueError:
        raise UsageError(f"{option} {text}: expected whole numbers with commas, such as 1,2,3") from None
