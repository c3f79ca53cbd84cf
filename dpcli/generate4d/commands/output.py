"""What `dpc generate4d render`, `export` and `view` do; the options come from `cli/generate4d_output.py`."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.draw.animation import output_kind, write_pictures
from dpcli.errors import UsageError
from dpcli.generate4d.out.camera_paths import PATHS, Lens, Shot, default_rate, plan
from dpcli.generate4d.out.export import (
    AXES,
    FORMATS,
    as_sequence,
    export_file,
    export_sequence,
    thinned,
    write_clouds,
    write_json,
)
from dpcli.generate4d.out.splat_files import camera_list
from dpcli.generate4d.viewer import write_page
from dpcli.runtime import provenance
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.seeds import generator
from dpcli.runtime.whole_file import check_target
from dpcli.store import ViewsReader, input_file, output_file
from dpcli.store.gaussians import GaussianScene, read_scene, scene_origin

_SHEET_AROUND = (0, 90, 180, 270)  # degrees from the reference view
_SHEET_SIDE = 160  # pixels of its pictures
_SPLATS = ("ply", "splat")  # one file for a file's name, one a frame for a folder's


def run_render(
    scene_file: str,
    output: str | None,
    *,
    path: str,
    lens: Lens,
    color: str,
    background: str,
    trajectories: bool,
    frames: int | None,
    fps: float | None,
    time: float | None,
    picture: Path | None,
    columns: int,
    cameras: Path | None,
    device: str,
    force: bool,
) -> None:
    """`dpc generate4d render`: pictures along a path, a contact sheet, or a `views` file seen by given cameras."""
    from dpcli.generate4d.out.picture_colors import parse_background
    from dpcli.generate4d.out.render import Look, Renderer
    from dpcli.runtime.device import choose_device

    look = Look(color, parse_background(background), trajectories)
    if output is None and picture is None:
        raise UsageError("nothing to write: -o FILE for a video, a picture or a folder, --picture FILE for a sheet")
    if picture is not None:
        check_target(picture, "--picture", (".png",))
    if cameras is not None:
        _check_views(output, {"--path": path != PATHS[0], "--frames": frames, "--fps": fps})
        if picture is None:  # a sheet has use for these
            own = {f"--{name}": value for name, value in vars(lens).items()}
            _check_views(
                output, {**own, "--time": time, "--background": look.background not in (None, (255, 255, 255))}
            )
    with input_file(scene_file) as place:
        scene, (root, history) = read_scene(place), scene_origin(place)
        config = {"cameras": bool(cameras), "color": color, "trajectories": trajectories}
        digest = provenance.record(config, int(root["seed"]), {"gaussians": place})
    renderer = Renderer(scene, choose_device(device))
    if cameras is not None:
        _render_views(renderer, look, cameras, str(output), [*history, digest], root, force)
    elif output is not None:
        _render_path(
            renderer,
            look,
            Path(output),
            plan(scene, path, lens, frames=frames, fps=fps, time=time),
            fps or default_rate(scene, path),
            force,
        )
    if picture is not None:
        _render_sheet(renderer, look, picture, lens, columns, time)


def _render_path(renderer, look, output: Path, shots: list[Shot], fps: float, force: bool) -> None:
    kind = output_kind(output)
    if look.background is None and kind in (".mp4", ".gif"):
        raise UsageError(f"-o {output}: {kind} has no transparency; use a .png or a folder, or another --background")
    shots = shots[:1] if kind == ".png" else shots
    with Progress("render", len(shots), "picture") as progress:

        def drawn():
            for picture in renderer.pictures(shots, look):
                yield picture
                progress.advance()

        write_pictures(output, drawn(), fps, force=force)
    log.info(f"{output}: {len(shots)} picture(s) of {shots[0].size[0]} x {shots[0].size[1]}")


def _check_views(output: str | None, options: dict[str, Any]) -> None:
    """UsageError where `output` can't be the views file of --cameras, or it has no use for an option that was given."""
    if output is None or (output != "-" and Path(output).suffix not in (".h5", ".hdf5")):
        raise UsageError("--cameras renders a views file: name it with -o FILE.h5, or - for a pipe")
    unused = [name for name, value in options.items() if value is not None and value is not False]
    if unused:
        raise UsageError(
            f"{', '.join(unused)}: not with --cameras, whose file says from where, how large and when every picture"
            " is, with a transparent background; leave out one or the other"
        )


def _render_views(renderer, look, cameras: Path, output: str, history: list[dict], root: dict, force: bool) -> None:
    from dpcli.generate4d.out.render import render_views

    with ViewsReader(cameras) as reader:
        header = reader.header
    with output_file(output) as place:
        render_views(
            renderer,
            header,
            place,
            look,
            provenance=history,
            source=str(root["source"]),
            seed=int(root["seed"]),
            force=force,
        )
    log.info(f"{output}: {header.num_views} views x {header.num_frames} frames")


def _render_sheet(renderer, look, picture: Path, lens: Lens, columns: int, time: float | None) -> None:
    """Rows: the reference camera, then around the object; columns: instants of the clip."""
    from dpcli.generate4d.out.render import sheet

    look = replace(look, background=look.background or (255, 255, 255))
    scene, small = renderer.scene, replace(lens, size=lens.size or _SHEET_SIDE)
    span = np.linspace(scene.time[0], scene.time[-1], min(columns, scene.num_frames)) if time is None else [time]
    azimuth = small.place(scene)[0]
    rows = []
    for degrees in _SHEET_AROUND:
        own = replace(small, azimuth=azimuth + math.radians(degrees))
        shots = [plan(scene, "fixed", own, time=float(instant), frames=1)[0] for instant in span]
        rows.append((f"{math.degrees(own.azimuth):+.0f}°", list(renderer.pictures(shots, look))))
    write_pictures(picture, [sheet(rows, [f"{instant:.2f} s" for instant in span])], 1, force=True)


def run_export(
    scene_file: str,
    output: str,
    *,
    form: str,
    time: float | None,
    axes: str,
    least: float | None,
    points: int | None,
    seed: int,
    force: bool,
) -> None:
    """`dpc generate4d export`: what the name and `form` say."""
    if form not in FORMATS:
        raise UsageError(f"--as {form}: expected one of {', '.join(FORMATS)}")
    if axes not in AXES:
        raise UsageError(f"--axes {axes}: expected one of {', '.join(AXES)}")
    if output == "-" and form != "clouds":
        raise UsageError(f"-o -: only --as clouds goes through a pipe; name a file or folder for {form}")
    if time is not None and not _one_splat(form, Path(output)):
        kind = form.partition("-")[0] if form.startswith(_SPLATS) else _SPLATS[0]
        raise UsageError(f"--time is of one file: name it with --as {kind} -o FILE.{kind}")
    if points is not None and form != "clouds":
        raise UsageError(f"--points is of --as clouds; leave it out for {form}")
    with input_file(scene_file) as place:
        scene, (root, history) = read_scene(place), scene_origin(place)
        if form == "clouds":
            config = {"as": form, "axes": axes, "min_opacity": least, "points": points}
            history = [*history, provenance.record(config, seed, {"gaussians": place})]
            sequence = as_sequence(
                scene,
                str(root["source"]) or "scene",
                least=0.3 if least is None else least,
                points=points,
                rng=generator(seed),
                axes=axes,
            )
            with output_file(output) as target:
                write_clouds(
                    target,
                    sequence,
                    provenance=history,
                    source=str(root["source"]),
                    seed=seed,
                    length_unit=str(root["length_unit"]),
                    force=force,
                )
            log.info(f"{sequence.num_frames} frames of {len(sequence.frame(0))} points")
            return
    _export_others(thinned(scene, least or 0.0), Path(output), form, time, axes, force)


def _one_splat(form: str, output: Path) -> bool:
    """Whether that is one .ply or .splat, or was meant to be: such a suffix makes no folder."""
    return form in _SPLATS and output.suffix.lower() in (".ply", ".splat", ".json")


def _export_others(scene: GaussianScene, output: Path, form: str, time: float | None, axes: str, force: bool) -> None:
    kind, single, table = form.partition("-")[0], _one_splat(form, output), form in ("cameras", "metrics")
    if table and output.suffix.lower() != ".json":
        raise UsageError(f"-o {output}: expected a name that ends in .json")
    if single and output.suffix.lower() != f".{kind}":
        raise UsageError(f"-o {output}: expected a name that ends in .{kind}, or a folder for one file a frame")
    if (table or single) and output.exists() and not force:
        raise UsageError(f"{output}: exists already; --force replaces it")
    if table:
        write_json(output, camera_list(scene, axes) if form == "cameras" else scene.metrics)
    elif single:
        export_file(scene, output, kind, time=time, axes=axes)
    else:
        paths = export_sequence(scene, output, kind, axes=axes, force=force)
        log.info(f"{output}: {paths[0].name} to {paths[-1].name}, cameras.json, metrics.json")


def run_view(scene_file: str, output: Path, *, title: str | None, least: float, fps: float | None, force: bool) -> None:
    """`dpc generate4d view`: one self-contained HTML file."""
    if output.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"-o {output}: expected a name that ends in .html")
    if output.exists() and not force:
        raise UsageError(f"{output}: exists already; --force replaces it")
    with input_file(scene_file) as place:
        scene, (root, history) = read_scene(place), scene_origin(place)
    scene = thinned(scene, least)
    size = write_page(scene, output, title=title or str(root["source"]) or "scene", history=history, fps=fps)
    log.info(f"{output}: {scene.num_gaussians} Gaussians, {scene.num_frames} frames, {size / 2**20:.1f} MiB")
