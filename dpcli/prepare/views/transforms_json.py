"""Clips with known cameras as D-NeRF and Blender exporters write them: transforms_{train,test,val}.json beside images."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.ops.cameras import orbit_of
from dpcli.path_names import path_inside
from dpcli.prepare.decode.color_frames import FOLDER_FPS, read_rgba
from dpcli.prepare.views import matting
from dpcli.prepare.views.orbit_world import into_orbit, sphere_of_silhouettes
from dpcli.prepare.views.square_crop import Box, union, visible_box, whole_picture
from dpcli.prepare.views.video import VideoOptions, spread_frames
from dpcli.prepare.views.views_pipeline import Clip, digest_of
from dpcli.runtime.progress import log
from dpcli.store.views import ViewsHeader
from dpcli.text_files import read_json

FILES = {
    "transforms.json": "train",
    "transforms_train.json": "train",
    "transforms_val.json": "test",
    "transforms_test.json": "test",
}
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4")
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "RADIAL", "SIMPLE_RADIAL", "FULL_OPENCV", "PERSPECTIVE")
_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL axes: y up, z back
_UP = np.array([0.0, 0.0, 1.0])  # Blender's world


@dataclass
class _View:
    pose: np.ndarray  # world_to_camera (4,4), OpenCV axes, Blender's world
    role: str
    focal: dict[str, float]
    paths: dict[float, Path] = field(default_factory=dict)  # by time
    masks: dict[float, Path] = field(default_factory=dict)  # by time, where the file names them


def is_transforms(path: Path) -> bool:
    """Returns whether a folder is one of this kind."""
    return path.is_dir() and any((path / name).is_file() for name in FILES)


def transforms_config(path: Path, options: VideoOptions) -> dict[str, Any]:
    """Returns options and digests of everything read, for provenance."""
    _check(options)
    views, times = _grid(path)
    config = {
        key: str(value) if isinstance(value, Path) else value
        for key, value in asdict(options).items()
        if key != "pattern"
    }
    config["input_digest"] = digest_of(view.paths[time] for view in views for time in times)
    masks = [view.masks[time] for view in views for time in times if time in view.masks]
    return {**config, "mask_digest": digest_of(masks)} if masks else config


def _check(options: VideoOptions) -> None:
    options.check()
    if options.views or options.mask or options.pattern:
        raise UsageError(
            "--views, --mask and --pattern belong to clips without cameras; transforms_*.json lists all views itself"
        )


def transforms_clip(path: Path, options: VideoOptions) -> Clip:
    """Reads all still cameras of the folder over the times they share; the first training camera is the reference.

    The world is turned (z up becomes y up, the reference to azimuth 0) and scaled so that the object's silhouettes fit
    a sphere of radius 0.75 around the origin; cameras follow exactly. No crop: only padded to a square and resized.
    """
    _check(options)
    views, times = _grid(path)
    seconds, chosen = _seconds(times, options.fps), spread_frames(len(times), options.frames)
    times = [times[index] for index in chosen]
    boxes, sizes = zip(*(_look(view, times, options) for view in views))
    intrinsics = np.stack([_intrinsics(view, *size) for view, size in zip(views, sizes, strict=True)])
    poses = np.stack([view.pose for view in views])
    world = into_orbit(_UP, poses[0], *sphere_of_silhouettes(intrinsics, poses, list(boxes)))
    poses = np.stack([world.pose(pose) for pose in poses])
    crops = [whole_picture(*size) for size in sizes]
    header = ViewsHeader(
        options.name or path.resolve().name,
        np.stack([crop.intrinsics(camera, options.size) for crop, camera in zip(crops, intrinsics, strict=True)]),
        poses,
        seconds[chosen] - seconds[chosen[0]],
        ["reference", *(view.role for view in views[1:])],
        0,
        (options.size, options.size),
    )
    azimuths = ", ".join(f"{np.rad2deg(orbit_of(pose)[0]):.0f}" for pose in poses[:12])
    log.info(f"{path}: {len(views)} still cameras at azimuths {azimuths}{' ...' if len(poses) > 12 else ''} degrees")

    def pictures() -> Iterator[tuple[int, int, np.ndarray]]:
        for number, view in enumerate(views):
            for row, time in enumerate(times):
                yield number, row, crops[number].apply(_cut(view, time, options), options.size)

    return Clip(header, pictures)


def _grid(folder: Path) -> tuple[list[_View], list[float]]:
    """Returns still cameras that have a picture at every time, training ones first, and the times, rising."""
    views: dict[bytes, _View] = {}
    times: set[float] = set()
    for name, role in FILES.items():
        if (folder / name).is_file():
            _collect(folder / name, role, views, times)
    whole = [view for view in views.values() if view.paths.keys() == times]
    if not whole:
        raise DataError(
            f"{folder}: the camera moves ({len(views)} poses for {len(times)} times); a file of views holds still "
            "cameras with a picture at every time\nRender or select at least one camera over all times"
        )
    if len(whole) < len(views):
        log.warn(
            f"{folder}: {len(views) - len(whole)} of {len(views)} cameras lack some of the {len(times)} times; left out"
        )
    whole.sort(key=lambda view: view.role != "train")
    return whole, sorted(times)


def _collect(path: Path, role: str, views: dict[bytes, _View], times: set[float]) -> None:
    try:
        found = read_json(path)
        frames = found["frames"]
        if not frames or not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
            raise ValueError("no frames")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}: not a readable list of frames ({error!r})") from None
    focal = {key: found[key] for key in ("camera_angle_x", "fl_x", "fl_y", "cx", "cy", "w", "h") if key in found}
    for number, frame in enumerate(frames):
        where = f"{path}: frame {number}"
        try:
            pose, image = _pose(where, frame["transform_matrix"]), _image(path.parent, str(frame["file_path"]))
            time = float(frame["time"])
        except DataError as error:
            raise DataError(f"{where}: {error}") from None
        except KeyError as error:
            hint = " (a still scene? 4D needs the time of every frame)" if error.args == ("time",) else ""
            raise DataError(f"{where}: no {error.args[0]!r}{hint}") from None
        _check_lens(where, {**found, **frame})
        own = focal | {key: frame[key] for key in ("camera_angle_x", "fl_x", "fl_y", "cx", "cy") if key in frame}
        key = np.round(pose, 5).tobytes() + role.encode()
        view = views.setdefault(key, _View(pose, role, own))
        view.paths[time] = image
        if frame.get("mask_path"):
            view.masks[time] = _image(path.parent, str(frame["mask_path"]))
        times.add(time)


def _check_lens(where: str, camera: dict[str, Any]) -> None:
    """Raises DataError at a lens that no pinhole camera describes: a fisheye or panorama, or distortion that isn't 0."""
    model = str(camera.get("camera_model") or "PINHOLE").upper()
    bent = [f"{key} {camera[key]}" for key in _DISTORTION if camera.get(key)]
    if camera.get("is_fisheye"):
        model = "fisheye"
    if model not in _PINHOLES or bent:
        found = f"camera_model {model}" if model not in _PINHOLES else ", ".join(bent)
        raise DataError(
            f"{where}: {found}; expected pictures without lens distortion\n"
            "Undistort them first (colmap image_undistorter, or cv2.undistort), and write the cameras of the result"
        )


def _pose(where: str, matrix: Any) -> np.ndarray:
    try:
        pose = np.array(matrix, np.float64).reshape(4, 4)
    except (ValueError, TypeError):
        raise DataError(f"{where}: transform_matrix is not 4 x 4 numbers") from None
    pose = pose @ _TO_OPENCV
    lengths = np.linalg.norm(pose[:3, :3], axis=0)
    rotation = pose[:3, :3] / np.maximum(lengths, 1e-12)
    if (
        not np.isfinite(pose).all()
        or np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3
        or np.linalg.det(rotation) < 0
    ):
        raise DataError(f"{where}: transform_matrix is not a camera-to-world pose (rotation, shift)")
    u, _, v = np.linalg.svd(rotation)
    pose[:3, :3] = u @ v
    pose[3] = 0, 0, 0, 1
    return np.linalg.inv(pose) + 0.0  # no negative zeros: equal poses have equal bytes


def _image(folder: Path, name: str) -> Path:
    for suffix in ("", ".png", ".jpg", ".webp"):
        path = path_inside(folder, folder, name + suffix)
        if path.is_file():
            return path
    raise DataError(f"{folder / name}: named by transforms_*.json, but there is no such image")


def _intrinsics(view: _View, width: int, height: int) -> np.ndarray:
    """Returns f64 (3,3) of the picture as stored, also where it was resized after `w`, `h` were noted."""
    known = view.focal
    if "fl_x" in known:
        across, down = width / float(known.get("w", width)), height / float(known.get("h", height))
        fx = float(known["fl_x"]) * across
        fy = float(known.get("fl_y", known["fl_x"])) * down
    elif "camera_angle_x" in known:
        across = down = 1.0
        fx = fy = 0.5 * width / np.tan(0.5 * float(known["camera_angle_x"]))
    else:
        raise DataError(
            f"{next(iter(view.paths.values())).parent}: views without cameras: no camera_angle_x and no fl_x"
        )
    cx, cy = float(known.get("cx", 0.5 * width / across)) * across, float(known.get("cy", 0.5 * height / down)) * down
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def _cut(view: _View, time: float, options: VideoOptions) -> np.ndarray:
    path = view.paths[time]
    if time in view.masks:
        return matting.with_mask(read_rgba(path), view.masks[time], path.name)
    return matting.cut_alone(read_rgba(path), str(path), options.background, options.tolerance, options.holes)


def _look(view: _View, times: list[float], options: VideoOptions) -> tuple[Box, tuple[int, int]]:
    """Returns the box of the object over all times, and the (width, height) of a view."""
    boxes: list[Box] = []
    sizes: dict[tuple[int, int], Path] = defaultdict()
    for time in times:
        rgba = _cut(view, time, options)
        sizes.setdefault((rgba.shape[1], rgba.shape[0]), view.paths[time])
        if len(sizes) > 1:
            (a, first), (b, second) = sizes.items()
            raise DataError(f"{second} is {b[0]}x{b[1]}, {first} is {a[0]}x{a[1]}; one camera has one size")
        box = visible_box(rgba)
        if box is not None:
            boxes.append(box)
    if not boxes:
        raise DataError(f"{view.paths[times[0]].parent}: no object in any frame of a camera (all empty)")
    return union(boxes), next(iter(sizes))


def _seconds(times: list[float], fps: float | None) -> np.ndarray:
    """Returns the files' times, which run from 0 to 1, stretched to as many frames per second as --fps says."""
    values = np.array(times) - times[0]
    return values / values[-1] * (len(values) - 1) / (fps or FOLDER_FPS) if len(values) > 1 else values
