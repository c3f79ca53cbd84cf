"""Does the work of `dpc generate4d render`; the options are in `cli/generate4d/render.py`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from dpcli.counted import counted
from dpcli.draw.animation import output_kind, write_pictures
from dpcli.draw.palette import LIGHT
from dpcli.draw.sheet import SheetRow, contact_sheet, save_picture
from dpcli.errors import UsageError
from dpcli.generate4d.out.camera_paths import Lens, default_rate, plan_shots
from dpcli.generate4d.out.picture_colors import parse_background
from dpcli.generate4d.out.render import Look, Renderer, render_views
from dpcli.generate4d.render_settings import RenderSettings
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.whole_file import check_target
from dpcli.store import ViewsReader, input_file, output_file
from dpcli.store.gaussians import read_scene, scene_origin

_SHEET_AROUND = (0, 90, 180, 270)  # degrees from the reference view
_CAMERA = ("azimuth", "elevation", "radius", "fovy")
_SHEET_SIDE = 160  # pixels of its pictures


def render_scene(
    scene_file: str,
    output: str | None,
    settings: RenderSettings,
    *,
    picture: Path | None,
    cameras: Path | None,
    device: str,
    force: bool,
) -> None:
    """Draws a scene along a path into `output`, as a contact sheet into `picture`, or as a views file seen by `cameras`."""
    look = Look(settings.color, parse_background(settings.background), settings.trajectories)
    if output is None and picture is None:
        raise UsageError("nothing to write: -o FILE for a video, a picture or a folder, --picture FILE for a sheet")
    if picture is not None:
        check_target(picture, "--picture", (".png",))
    if cameras is not None:
        _check_views(output, settings, look, has_sheet=picture is not None)
    with input_file(scene_file) as place:
        scene, (root, history) = read_scene(place), scene_origin(place)
        config = {"cameras": bool(cameras), "color": settings.color, "trajectories": settings.trajectories}
        entry = provenance.record(config, int(root["seed"]), {"gaussians": place})
    if settings.time is not None:
        scene.require_times(np.array([settings.time]), scene_file, f"--time is {settings.time:g}")
    renderer = Renderer(scene, choose_device(device))
    if cameras is not None:
        with ViewsReader(cameras) as reader:
            header = reader.header
        span = f"{header.time[0]:.4g} to {header.time[-1]:.4g} s; was it fitted to another clip?"
        scene.require_times(header.time, scene_file, f"{cameras} has frames from {span}")
        origin = {"source": str(root["source"]), "seed": int(root["seed"]), "provenance": [*history, entry]}
        with output_file(str(output)) as place:
            render_views(renderer, header, place, look, force=force, **origin)
        log.info(f"{output}: {counted(header.num_views, 'view')} x {counted(header.num_frames, 'frame')}")
    elif output is not None:
        _render_path(renderer, look, Path(output), settings, force, has_sheet=picture is not None)
    if picture is not None:
        _render_sheet(renderer, look, picture, settings)


def _lens(settings: RenderSettings) -> Lens:
    degrees = (settings.azimuth, settings.elevation, settings.fovy)
    azimuth, elevation, fovy = (None if angle is None else math.radians(angle) for angle in degrees)
    return Lens(azimuth, elevation, settings.radius, fovy, settings.size)


def _check_views(output: str | None, settings: RenderSettings, look: Look, *, has_sheet: bool) -> None:
    """Raises UsageError where `output` can't be the views file of --cameras, or has no use for a setting that was given."""
    if output is None or (output != "-" and Path(output).suffix.lower() not in (".h5", ".hdf5")):
        raise UsageError("--cameras renders a views file: name it with -o FILE.h5, or - for a pipe")
    unused = settings.changed("path", "frames", "fps")
    if not has_sheet:  # which has use for these
        unused += settings.changed(*_CAMERA, "size", "time")
        unused += ["background"] if look.background not in (None, LIGHT.background) else []
    if unused:
        raise UsageError(
            f"{', '.join(unused)}: cannot be used with --cameras, whose file says from where, how large and when every picture"
            " is, with a transparent background; leave out one or the other"
        )


def _render_path(
    renderer: Renderer, look: Look, output: Path, settings: RenderSettings, force: bool, *, has_sheet: bool
) -> None:
    kind, path = output_kind(output), settings.path
    if look.background is None and kind in (".mp4", ".gif"):
        raise UsageError(f"-o {output}: {kind} has no transparency; use a .png or a folder, or another --background")
    if kind == ".png" and (unused := settings.changed("frames", "fps")):
        raise UsageError(
            f"{', '.join(unused)}: -o {output} is one picture; name a .mp4, a .gif or a folder, or leave it out"
        )
    if path == "reference" and not has_sheet and (unused := settings.changed(*_CAMERA)):  # a sheet has use for them
        raise UsageError(
            f"{', '.join(unused)}: --path reference is the input's own camera; take --path fixed, or leave it out"
        )
    times = {"frames": settings.frames, "fps": settings.fps, "time": settings.time}
    shots = plan_shots(renderer.scene, path, _lens(settings), **times)
    shots = shots[:1] if kind == ".png" else shots
    with Progress("render", len(shots), "picture") as progress:

        def draw() -> Iterator[np.ndarray]:
            for picture in renderer.pictures(shots, look):
                progress.advance()  # before it is given away: who takes one picture doesn't come back for a second
                yield picture

        write_pictures(output, draw(), settings.fps or default_rate(renderer.scene, path), force=force)
    width, height = (side + side % 2 if kind == ".mp4" else side for side in shots[0].size)  # as H.264 needs them
    log.info(f"{output}: {counted(len(shots), 'picture')} of {width} x {height}")


def _render_sheet(renderer: Renderer, look: Look, picture: Path, settings: RenderSettings) -> None:
    """Writes the contact sheet: the reference camera and three more around the object as rows, instants as columns."""
    look = replace(look, background=look.background or LIGHT.background)
    scene, lens, time = renderer.scene, _lens(settings), settings.time
    lens = replace(lens, size=lens.size or _SHEET_SIDE)
    count = min(settings.columns, scene.num_frames)
    instants = np.linspace(scene.time[0], scene.time[-1], count) if time is None else [time]
    azimuth = lens.place(scene)[0]
    rows = []
    for degrees in _SHEET_AROUND:
        turned = replace(lens, azimuth=azimuth + math.radians(degrees))
        shots = [plan_shots(scene, "fixed", turned, time=float(instant), frames=1)[0] for instant in instants]
        title, marks = f"azimuth {math.degrees(turned.azimuth):+.0f}°", [f"{instant:.2f} s" for instant in instants]
        rows.append(SheetRow(title, marks, list(renderer.pictures(shots, look))))
    save_picture(contact_sheet(rows, LIGHT), picture)
