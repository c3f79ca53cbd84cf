"""`dpc prepare`: raw data of many kinds into one kind of file."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import typer

from dpcli.cli.options import Force, Jobs, OnError, Seed
from dpcli.cli.prepare import animation as prepare_animation
from dpcli.cli.prepare import files as prepare_files
from dpcli.cli.prepare import gestures as prepare_gestures
from dpcli.cli.prepare import scenes as prepare_scenes
from dpcli.cli.prepare import views as prepare_views
from dpcli.errors import UsageError

app = typer.Typer(no_args_is_help=True)
synthetic = typer.Typer(no_args_is_help=True, help="Make data out of nothing, with ground truth.")
app.add_typer(synthetic, name="synthetic")


def _common(
    output: Annotated[str, typer.Option("-o", "--output", help="File to write, or - for a pipe.")] = "",
    points: Annotated[
        int, typer.Option("--points", min=0, help="At most this many points per frame; 0 keeps all.")
    ] = 0,
    sampling: Annotated[str, typer.Option("--sampling", help="How --points chooses: random, fps or voxel.")] = "random",
    limit: Annotated[int | None, typer.Option("--limit", min=1, help="Only the first N samples, for a trial.")] = None,
    compression: Annotated[str, typer.Option("--compression", help="Of the coordinates: none, lzf or gzip.")] = "none",
    on_error: OnError = "skip",
    jobs: Jobs = None,
    shard: Annotated[
        str, typer.Option("--shard", metavar="I/N", help="Only every N-th sample from I = 0 ... N-1, for merge.")
    ] = "",
    dask: Annotated[
        str, typer.Option("--dask", metavar="ADDRESS", help="Read on a Dask cluster: tcp://HOST:PORT, or local.")
    ] = "",
    check: Annotated[
        bool, typer.Option("--check", help="Only compare the folder with its recipe; list what is missing.")
    ] = False,
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """The options that every reader shares; only the signature matters."""


def _articulated(
    frames: Annotated[int, typer.Option("--frames", min=1, help="Frames per sequence.")] = 4,
    points: Annotated[int, typer.Option("--points", min=1, help="Points per frame.")] = 512,
    sampling: Annotated[
        str, typer.Option("--sampling", help="random: by area; fps or voxel: chosen among 4x as many.")
    ] = "random",
    view: Annotated[str, typer.Option("--view", help="full surface, or single: what one camera sees of it.")] = "full",
    orientation: Annotated[
        str, typer.Option("--orientation", help="Of a sequence: random, or upright (turned about z, which is up).")
    ] = "random",
    rotation: Annotated[
        float, typer.Option("--rotation", min=0.0, max=180.0, help="Most that each frame is turned besides, degrees.")
    ] = 15.0,
    translation: Annotated[
        float, typer.Option("--translation", min=0.0, help="Most that each frame is shifted, per axis, in diameters.")
    ] = 0.05,
    joint_step: Annotated[
        float,
        typer.Option("--joint-step", help="Most that a joint changes between frames, of its range; 1: independent."),
    ] = 0.3,
    max_parts: Annotated[
        int, typer.Option("--max-parts", min=2, help="Joints drawn at random stay still where there are more.")
    ] = 8,
    min_part: Annotated[
        int, typer.Option("--min-part", min=0, help="Points that even a small part gets; tiny ones are glued on.")
    ] = 8,
    min_motion: Annotated[
        float, typer.Option("--min-motion", min=0.0, help="Joints that move nothing by this, in diameters, stay still.")
    ] = 0.02,
    visible_only: Annotated[
        bool, typer.Option("--visible-only", help="Joints that change no shape (a spinning wheel) stay still, too.")
    ] = False,
) -> None:
    """The options of articulated objects; the fields of Articulation."""


@cache
def _parameters(function: Callable[..., None]) -> Mapping[str, inspect.Parameter]:
    return inspect.signature(function, eval_str=True).parameters


def _split_rule(test: str, validation: str, fractions: str) -> Any:
    from dpcli.prepare.articulated.object_splits import SplitRule

    try:
        shares = tuple(float(word) for word in fractions.split(",") if word.strip())
    except ValueError:
        raise UsageError(f"--fractions {fractions}: expected three numbers, such as 0.8,0.1,0.1") from None
    named = (tuple(word.strip() for word in text.split(",") if word.strip()) for text in (test, validation))
    return SplitRule(*named, shares)


def _reads(
    group: typer.Typer, name: str | None = None, more: Callable[..., None] | None = None
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register a function that turns its own options into a Reader as a command that has the common options too.

    ``more``: a signature like ``_common`` whose options reach the function as the dict ``articulation``.
    """

    def register(make_reader: Callable[..., Any]) -> Callable[..., Any]:
        own = {k: p for k, p in inspect.signature(make_reader, eval_str=True).parameters.items() if k != "articulation"}
        shared = _parameters(_common)
        extra = _parameters(more) if more else {}

        def run(**options: Any) -> None:
            given = {key: options[key] for key in own}
            if more:
                given["articulation"] = {key: options[key] for key in extra}
            common = {key: options[key] for key in shared}
            command = name or make_reader.__name__
            if common.pop("check"):
                _check(command, partial(make_reader, **given), given)
                return
            if not common["output"]:
                raise UsageError("-o/--output FILE is missing: the file to write, or - for a pipe")
            _convert(make_reader(**given), command, **common)

        parameters = {**own, **shared, **extra}
        # a parameter without default may not follow one with: arguments first, then -o, then the rest
        ordered = sorted(parameters.values(), key=lambda p: p.default is not inspect.Parameter.empty)
        run.__signature__ = inspect.Signature([p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in ordered])  # type: ignore[attr-defined]
        run.__annotations__ = {p.name: p.annotation for p in ordered}
        run.__doc__ = make_reader.__doc__
        group.command(name or make_reader.__name__)(run)
        return make_reader

    return register


def _check(name: str, make_reader: Callable[[], Any], given: dict[str, Any]) -> None:
    from dpcli.prepare.recipe_check import check_folder

    raw = next((value for value in given.values() if isinstance(value, Path)), None)
    for line in check_folder(name, raw, make_reader):
        typer.echo(line)


def _convert(reader: Any, name: str, *, output: str, jobs: int | None, shard: str, dask: str, **options: Any) -> None:
    from dpcli.prepare.pipeline import convert
    from dpcli.prepare.shards import Shard
    from dpcli.runtime.device import cpu_count
    from dpcli.runtime.progress import log
    from dpcli.store.pipes import output_file

    options |= {"shard": Shard.parse(shard) if shard else None, "task": f"prepare {name}", "resume": output != "-"}
    jobs = jobs or cpu_count()
    with output_file(output) as path:
        if dask:
            from dpcli.prepare.cluster import cluster_executor

            with cluster_executor(dask, jobs) as (executor, slots):
                report = convert(reader, path, jobs=slots, executor=executor, **options)
        else:
            report = convert(reader, path, jobs=jobs, **options)
    for line in report.lines():
        log.warn(line)
    if output != "-":
        counts = (
            f"{report.written} sequences, {report.frames} frames, {report.points} points, {len(report.skipped)} skipped"
        )
        typer.echo(f"{output}: {counts}")


def _numbers(text: str, option: str) -> tuple[int, ...]:
    try:
        return tuple(int(word) for word in text.split(",") if word.strip())
    except ValueError:
        raise UsageError(f"{option} {text}: expected whole numbers with commas, such as 1,2,3") from None


@_reads(app)
def msraction3d(
    raw: Annotated[Path, typer.Argument(help="Folder of aAA_sSS_eEE_sdepth.bin (official) or .mat files.")],
    focal: Annotated[float, typer.Option("--focal", help="Focal length, pixels (as the published protocols).")] = 280.0,
    scale: Annotated[float, typer.Option("--scale", help="Raw depth units per unit of length in the output.")] = 300.0,
    train_subjects: Annotated[
        str, typer.Option("--train-subjects", help="Their videos are split train.")
    ] = "1,2,3,4,5",
) -> Any:
    """MSR-Action3D: 20 actions in Kinect depth, 567 videos of 10 subjects."""
    from dpcli.prepare.actions.msraction3d import MSRAction3D

    return MSRAction3D(raw, focal, scale, _numbers(train_subjects, "--train-subjects"))


@_reads(app)
def nvgesture(
    raw: Annotated[Path, typer.Argument(help="Folder of the official list files and Video_data/.")],
    foreground: Annotated[str, typer.Option("--foreground", help="otsu (the hand, as the peers) or none.")] = "otsu",
    erode: Annotated[int, typer.Option("--erode", min=0, help="Passes of 3x3 erosion, pixels off the rim.")] = 1,
    coordinates: Annotated[
        str,
        typer.Option("--coordinates", help="image: row, column, gray level. camera: pinhole, depth 255 - gray level."),
    ] = "image",
) -> Any:
    """NvGesture: 25 hand gestures in 8-bit depth, 1,532 clips of 20 subjects."""
    from dpcli.prepare.actions.nvgesture import NvGesture

    return NvGesture(raw, foreground, erode, coordinates)


@_reads(app)
def depth(
    inputs: Annotated[
        list[Path], typer.Argument(help="Videos (.avi .mp4 .mkv .mov), .npy, folders of images, or folders of these.")
    ],
    intrinsics: Annotated[Path | None, typer.Option("--intrinsics", help="JSON with fx fy cx cy, pixels.")] = None,
    fx: Annotated[float | None, typer.Option("--fx", help="Focal length, pixels; with --cx --cy.")] = None,
    fy: Annotated[float | None, typer.Option("--fy", help="Focal length, pixels. Default: --fx.")] = None,
    cx: Annotated[float | None, typer.Option("--cx", help="Principal point, pixels from the left.")] = None,
    cy: Annotated[float | None, typer.Option("--cy", help="Principal point, pixels from the top.")] = None,
    fov: Annotated[float | None, typer.Option("--fov", help="Horizontal field of view, degrees. Default: 60.")] = None,
    depth_scale: Annotated[
        float | None,
        typer.Option("--depth-scale", help="Raw units per meter. Default: 1000 (integers; 8-bit 100), 1 (floats)."),
    ] = None,
    invert: Annotated[bool, typer.Option("--invert", help="Larger values are nearer.")] = False,
    near: Annotated[float, typer.Option("--near", help="Drop what is nearer, meters.")] = 0.0,
    far: Annotated[float, typer.Option("--far", help="Drop what is farther, meters.")] = float("inf"),
    background: Annotated[
        str, typer.Option("--background", help="Remove what stays still: none, median or first (frame).")
    ] = "none",
    margin: Annotated[
        float, typer.Option("--margin", help="Foreground is nearer than the background by this, meters.")
    ] = 0.05,
    fps: Annotated[
        float | None, typer.Option("--fps", help="Frames per second. Default: the video's, else 30.")
    ] = None,
    stride: Annotated[int, typer.Option("--stride", min=1, help="Keep every n-th frame.")] = 1,
    label_from_folder: Annotated[
        bool,
        typer.Option(
            "--label-from-folder", help="FOLDER/CLASS/VIDEO, or FOLDER/train/CLASS/VIDEO and FOLDER/test/CLASS/VIDEO."
        ),
    ] = False,
    labels: Annotated[Path | None, typer.Option("--labels", help="CSV: name,label[,subject][,split].")] = None,
) -> Any:
    """Any depth video, 8 or 16 bits, to points in meters."""
    from dpcli.prepare.actions.depth import DepthVideos
    from dpcli.prepare.decode.pinhole_camera import Intrinsics

    pixels = (fx, fx if fy is None else fy, cx, cy)
    if intrinsics and any(v is not None for v in pixels):
        raise UsageError("--intrinsics and --fx --fy --cx --cy were both given; use one")
    camera = Intrinsics.from_json(intrinsics) if intrinsics else None
    if any(v is not None for v in pixels):
        if any(v is None for v in pixels):
            raise UsageError("--fx, --cx and --cy belong together (--fy defaults to --fx); or use --fov")
        camera = Intrinsics(*(float(v) for v in pixels if v is not None))
    return DepthVideos(
        tuple(inputs),
        camera,
        fov,
        depth_scale,
        invert,
        near,
        far,
        background,
        margin,
        fps,
        stride,
        labels,
        label_from_folder,
    )


@_reads(app)
def clouds(
    raw: Annotated[
        Path, typer.Argument(help="Folder of .ply .pcd .npy .npz .bin .csv .las .xyz frames, or of such folders.")
    ],
    bin_columns: Annotated[
        int, typer.Option("--bin-columns", help="float32 values per point of a .bin; KITTI has 4.")
    ] = 4,
    scale: Annotated[float, typer.Option("--scale", help="Input units per unit of length in the output.")] = 1.0,
    unit: Annotated[str, typer.Option("--unit", help="Name of the output's unit of length.")] = "m",
    fps: Annotated[
        float | None, typer.Option("--fps", help="Frames per second; writes the time of every frame.")
    ] = None,
    stride: Annotated[int, typer.Option("--stride", min=1, help="Keep every n-th frame.")] = 1,
    label_from_folder: Annotated[
        bool,
        typer.Option(
            "--label-from-folder", help="RAW/CLASS/SEQUENCE/frames, or RAW/train/CLASS/... and RAW/test/CLASS/..."
        ),
    ] = False,
    labels: Annotated[Path | None, typer.Option("--labels", help="CSV: name,label[,subject][,split].")] = None,
) -> Any:
    """Point cloud files: a folder is a sequence, its files are the frames."""
    from dpcli.prepare.scans.clouds import CloudFolders

    return CloudFolders(raw, bin_columns, scale, unit, fps, stride, label_from_folder, labels)


@_reads(app, more=_articulated)
def sapien(
    raw: Annotated[Path, typer.Argument(help="Folder of CATEGORY/ID/mobility.urdf, of ID/..., or any .urdf file.")],
    articulation: dict[str, Any],
    pairs_per_object: Annotated[
        int,
        typer.Option(
            "--pairs-per-object", "--sequences-per-object", min=1, help="Sequences of --frames drawn of each object."
        ),
    ] = 8,
    test_categories: Annotated[str, typer.Option("--test-categories", help="Split test, as A,B,C.")] = "",
    validation_categories: Annotated[str, typer.Option("--validation-categories", help="Split validation.")] = "",
    fractions: Annotated[
        str, typer.Option("--fractions", help="Of the other objects: train,validation,test. Default: see below.")
    ] = "",
    seed: Seed = 0,
) -> Any:
    """Articulated objects, PartNet-Mobility (SAPIEN) or any URDF: moving parts with exact poses.

    Lengths are diameters of the object in frame 0. Without --fractions: 0.8,0.1,0.1, or all the others train when
    categories are named.
    """
    from dpcli.prepare.articulated.articulated_sequence import Articulation
    from dpcli.prepare.articulated.sapien import Sapien

    rule = _split_rule(test_categories, validation_categories, fractions)
    return Sapien(raw, pairs_per_object, Articulation.of_options(articulation), rule, seed)


@_reads(app)
def mbs(
    raw: Annotated[Path, typer.Argument(help="Folder of meta.json and data/000000.npz ..., as distributed.")],
) -> Any:
    """mbs-shapepart and mbs-sapien (MultiBodySync): four views of articulated objects, parts and poses."""
    from dpcli.prepare.scans.mbs import MultiBodySync

    return MultiBodySync(raw)


@_reads(synthetic)
def gestures(
    videos_per_class: Annotated[int, typer.Option("--videos-per-class", help="Videos of each of the 10 classes.")] = 20,
    frames: Annotated[int, typer.Option("--frames", help="Frames per video.")] = 24,
    subjects: Annotated[int, typer.Option("--subjects", help="People; the first 60 % are split train.")] = 10,
    size: Annotated[int, typer.Option("--size", help="Image width, pixels; the height is 3/4 of it.")] = 160,
    noise: Annotated[float, typer.Option("--noise", min=0.0, help="Sensor noise, 1 = like a Kinect.")] = 1.0,
    seed: Seed = 0,
) -> Any:
    """Arm gestures whose pairs differ only in the direction of time, seen by a virtual depth camera."""
    from dpcli.prepare.synthetic.gestures import SyntheticGestures

    return SyntheticGestures(videos_per_class, frames, subjects, size, noise, seed)


@_reads(synthetic, more=_articulated)
def articulated(
    articulation: dict[str, Any],
    objects: Annotated[int, typer.Option("--objects", min=1, help="Different objects, the kinds in turn.")] = 220,
    sequences_per_object: Annotated[
        int, typer.Option("--sequences-per-object", "--pairs-per-object", min=1, help="Sequences of --frames of each.")
    ] = 4,
    kinds: Annotated[
        str, typer.Option("--kinds", help="Only these, as laptop,scissors,lamp. Default: all 22, arm to window.")
    ] = "",
    test_categories: Annotated[str, typer.Option("--test-categories", help="Kinds that are split test.")] = "",
    validation_categories: Annotated[str, typer.Option("--validation-categories", help="Split validation.")] = "",
    fractions: Annotated[
        str, typer.Option("--fractions", help="Of the other objects: train,validation,test. Default: see below.")
    ] = "",
    seed: Seed = 0,
) -> Any:
    """Procedural articulated objects: furniture, appliances, tools, lamps, ... with exact parts and poses.

    Lengths are diameters of the object in frame 0. Without --fractions: 0.8,0.1,0.1, or all the others train when
    kinds are named.
    """
    from dpcli.prepare.articulated.articulated_sequence import Articulation
    from dpcli.prepare.articulated.synthetic_articulated import SyntheticArticulated

    names = tuple(word.strip() for word in kinds.split(",") if word.strip())
    rule = _split_rule(test_categories, validation_categories, fractions)
    return SyntheticArticulated(objects, sequences_per_object, names, Articulation.of_options(articulation), rule, seed)


prepare_views.register(app)
prepare_files.register(app)
prepare_gestures.register(app, _reads)
prepare_animation.register(app, synthetic)
prepare_scenes.register(app, _reads)
