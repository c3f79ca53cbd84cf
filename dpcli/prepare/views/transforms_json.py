"""Clips with known cameras as D-NeRF and Blender exporters write them: transforms_{train,test,val}.json beside images."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.ops.cameras import orbit_of
from dpcli.path_names import first_names
from dpcli.prepare.decode.color_frames import FOLDER_FPS, read_rgba
from dpcli.prepare.views import matting
from dpcli.prepare.views.masks import read_mask
from dpcli.prepare.views.orbit_world import into_orbit, shares_of_boxes, sphere_of_silhouettes, up_of_cameras
from dpcli.prepare.views.square_crop import Box, union, visible_box, whole_picture
from dpcli.prepare.views.transforms_cameras import View, named_up, read_views, transforms_files
from dpcli.prepare.views.video import VideoOptions, spread_frames
from dpcli.prepare.views.views_pipeline import Clip, digest_of
from dpcli.runtime.progress import log
from dpcli.store.views import ViewsHeader

_SHARED = 0.95  # of a box around the object, at least, is possible where all cameras are right


def is_transforms(path: Path) -> bool:
    """Returns whether a path is a folder of this kind, or a file of its cameras."""
    return bool(transforms_files(path))


def transforms_config(path: Path, options: VideoOptions, *, quiet: bool = True) -> dict[str, Any]:
    """Returns options and digests of everything read, for provenance; quiet: what is left out isn't told."""
    _check(options)
    views, times = read_views(path, quiet=quiet)
    pictures = (view.paths[time] for view in views for time in times)
    config = {**options.config, "input_digest": digest_of([*transforms_files(path), *pictures])}
    masks = [view.masks[time] for view in views for time in times if time in view.masks]
    return {**config, "mask_digest": digest_of(masks)} if masks else config


def _check(options: VideoOptions) -> None:
    if options.views or options.mask or options.pattern:
        raise UsageError(
            "--views, --mask and --pattern belong to clips without cameras; transforms_*.json lists all views itself"
        )
    usual = VideoOptions()
    if other := [
        name
        for name in ("elevation", "radius", "fovy", "border")
        if not np.isclose(getattr(options, name), getattr(usual, name))
    ]:
        raise UsageError(
            f"--{other[0]} {getattr(options, other[0]):g}: belongs to clips without cameras; transforms_*.json says where its"
            " cameras stand and what they see, and its pictures are not cropped"
        )


def transforms_clip(path: Path, options: VideoOptions) -> Clip:
    """Reads all still cameras of the folder over the times they share; the first training camera is the reference.

    The world is turned (its upright, z as in Blender unless the file or the cameras tell another, becomes y, the
    reference goes to azimuth 0) and scaled so that the object's silhouettes fit a sphere of radius 0.75 around the
    origin; cameras follow exactly. No crop: only padded to a square and resized.
    """
    _check(options)
    views, times = read_views(path)
    seconds, chosen = _seconds(path, times, options.fps), spread_frames(len(times), options.frames)
    times = [times[index] for index in chosen]
    boxes, sizes, always = zip(*(_look(view, times, options) for view in views))
    intrinsics = np.stack([view.intrinsics(*size) for view, size in zip(views, sizes, strict=True)])
    if any(high > wide and view.has_angle_across_alone for view, (wide, high) in zip(views, sizes)):
        log.warn(
            f"{path}: pictures higher than wide: camera_angle_x is taken for the angle across them; Blender's angle_x is that of"
            " the longer side, so if it was written from there, give fl_x (pixels) in its place"
        )
    poses = np.stack([view.pose for view in views])
    up = up_of_cameras(str(path), poses) if (named := named_up(path)) is None else named
    try:
        world = into_orbit(up, poses[0], *sphere_of_silhouettes(intrinsics, poses, list(boxes)))
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
    poses = np.stack([world.pose(pose) for pose in poses])
    doubts = [view.doubts(*size) for view, size in zip(views, sizes, strict=True)]
    for kind in {kind: None for one in doubts for kind in one}:
        said = [one[kind] for one in doubts if kind in one]
        log.warn(f"{path}: {counted(len(said), 'camera')}: {said[0]}")
    # where it is out of sight at times, its box isn't all of its way
    if asked := [k for k in range(len(views)) if always[k]]:
        names = [next(iter(views[k].paths.values())).name for k in asked]
        _tell_contradiction(
            path, names, intrinsics[asked], poses[asked], [boxes[k] for k in asked], [sizes[k] for k in asked]
        )
    crops = [whole_picture(*size) for size in sizes]
    header = ViewsHeader(
        options.name or (path if path.is_dir() else path.parent).resolve().name,
        np.stack([crop.intrinsics(camera, options.size) for crop, camera in zip(crops, intrinsics, strict=True)]),
        poses,
        seconds[chosen] - seconds[chosen[0]],
        ["reference", *(view.role for view in views[1:])],
        0,
        (options.size, options.size),
    )
    azimuths = [str(round(float(np.rad2deg(orbit_of(pose)[0])))) for pose in poses]  # no "-0"
    log.info(f"{path}: {len(views)} still cameras, azimuths in degrees: {first_names(azimuths, 12)}")

    def pictures() -> Iterator[tuple[int, int, np.ndarray]]:
        for number, view in enumerate(views):
            for row, time in enumerate(times):
                yield number, row, crops[number].apply(_cut(view, time, options), options.size)

    return Clip(header, pictures)


def _tell_contradiction(
    path: Path,
    names: list[str],
    intrinsics: np.ndarray,
    poses: np.ndarray,
    boxes: list[Box],
    sizes: list[tuple[int, int]],
) -> None:
    """Warns of cameras that can't all be those of the boxes around the object; names: of a picture of each."""
    shares = shares_of_boxes(intrinsics, poses, boxes, sizes)
    if shares.min() < _SHARED:
        worst = int(shares.argmin())
        log.warn(
            f"{path}: the cameras contradict one another: of the box around the object in {names[worst]} the other views leave"
            f" {shares[worst]:.0%} possible, expected nearly 100%. Check the poses (camera to world, axes as in OpenGL? mirrored?"
            " in another order?), the lenses, and that nothing but the object is left in the pictures"
        )


def _cut(view: View, time: float, options: VideoOptions) -> np.ndarray:
    path, mask = view.paths[time], view.masks.get(time)
    if mask:
        return matting.with_alpha(read_rgba(path), read_mask(mask), str(mask), path.name)
    return matting.cut_alone(read_rgba(path), str(path), options.background, options.tolerance, options.holes)


def _look(view: View, times: list[float], options: VideoOptions) -> tuple[Box, tuple[int, int], bool]:
    """Returns the box of the object over all times, the (width, height) of a view, and whether it is seen at every time."""
    boxes: list[Box] = []
    sizes: dict[tuple[int, int], Path] = {}
    for time in times:
        rgba = _cut(view, time, options)
        sizes.setdefault((rgba.shape[1], rgba.shape[0]), view.paths[time])
        if len(sizes) > 1:
            (a, first), (b, second) = sizes.items()
            raise DataError(f"{second} is {b[0]}x{b[1]}, {first} is {a[0]}x{a[1]}; one camera has one size")
        box = visible_box(rgba[..., 3])
        if box is not None:
            boxes.append(box)
    if not boxes:
        raise DataError(f"{view.paths[times[0]].parent}: no object in any frame of a camera (all empty)")
    return union(boxes), next(iter(sizes)), len(boxes) == len(times)


def _seconds(path: Path, times: list[float], fps: float | None) -> np.ndarray:
    """Returns seconds f64 (T) of the files' times: frame numbers where they are whole and pass 1, in steps of their greatest
    common divisor; seconds where they pass 1; else shares of the clip. The log says which.

    fps: frames per second, of numbers and shares; it goes before the seconds of the files.
    """
    values, rate = np.array(times) - times[0], fps or FOLDER_FPS
    if len(values) == 1:
        return values
    ends = f"{path}: times {times[0]:.10g} to {times[-1]:.10g} are taken for"
    if max(times) > 1 and (values == np.floor(values)).all():
        step = int(np.gcd.reduce(values.astype(np.int64)))
        steps = f" in steps of {step}, {rate:g} steps" if step > 1 else f", {rate:g}"
        log.info(f"{ends} numbers of frames{steps} per second (--fps)")
        return values / step / rate
    if max(times) > 1 and not fps:
        log.info(f"{ends} seconds (--fps N: shares of a clip of N frames per second)")
        return values
    log.info(f"{ends} shares of a clip of {rate:g} frames per second (--fps)")
    return values / values[-1] * (len(values) - 1) / rate
