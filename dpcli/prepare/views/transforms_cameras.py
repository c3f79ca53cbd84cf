"""Cameras and pictures that transforms_*.json lists, as D-NeRF, Blender exporters, nerfstudio and instant-ngp write them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.path_names import path_inside
from dpcli.runtime.clips.images import IMAGE_SUFFIXES
from dpcli.runtime.progress import log
from dpcli.text_files import read_json

FILES = {
    "transforms.json": "train",
    "transforms_train.json": "train",
    "transforms_val.json": "test",
    "transforms_test.json": "test",
}
_LENS = ("camera_angle_x", "camera_angle_y", "fl_x", "fl_y", "cx", "cy", "w", "h")
_POSITIVE = ("camera_angle_x", "camera_angle_y", "fl_x", "fl_y", "w", "h")
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4")
_DISTORTION += (*(f"ftheta_p{place}" for place in range(5)), "latlong", "rolling_shutter", "orthographic")
_DISTORTION += ("distortion_params", "distortion", "distortion_coefficients", "dist_coeffs", "k", "p")
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "RADIAL", "SIMPLE_RADIAL", "FULL_OPENCV", "PERSPECTIVE")
_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL axes: y up, z back
_START = 1 << 16  # bytes of a file in which the first frame stands
_NOISE, _MOST = 2e-5, 4000  # of poses that are equal, of their largest number; and so many are compared
_LAST_TIME = 1e10  # in any unit; seconds since 1970 are fewer
_WIDEST = 0.1  # of a picture's side: a lens of 157 degrees, which no pinhole has
_LONGEST = 1000  # times the width of the picture: no lens for objects is that long
_OFF_CENTER = 0.2  # of the picture: what a principal point lies off its middle if the camera isn't of this picture
_DISAGREE = 0.02  # of a focal length: by how much its angle may make another
_SHAPE = 0.01  # how much two shapes of pictures may differ and still be one picture at two sizes


@dataclass
class View:
    """Holds a still camera: pose world_to_camera f64 (4,4), OpenCV axes, in Blender's world; and its pictures by their time.

    lens: focal lengths, angles, principal point and size, as the file has them. masks: where the file names them.
    """

    pose: np.ndarray
    role: str
    lens: dict[str, float]
    paths: dict[float, Path] = field(default_factory=dict)
    masks: dict[float, Path] = field(default_factory=dict)

    @property
    def has_angle_across_alone(self) -> bool:
        """Returns whether the file says nothing of the lens but the angle across the pictures."""
        return {"camera_angle_x"} == {key for key in self.lens if key.startswith(("camera_angle", "fl_"))}

    def intrinsics(self, width: int, height: int) -> np.ndarray:
        """Returns f64 (3,3) for pictures of this size, also where they were resized after the file was written.

        Raises DataError when the file says nothing of the lens, or is of pictures of another shape.
        """
        lens, place = self.lens, next(iter(self.paths.values()))
        across, down = width / lens.get("w", width), height / lens.get("h", height)
        if abs(across / down - 1) > _SHAPE:
            raise DataError(
                f"{place}: is {width}x{height}, its camera is of {lens.get('w', width):g}x{lens.get('h', height):g}, which is"
                " another shape (turned by EXIF?); expected the camera of these pictures"
            )
        focal = [_focal(lens, "x", width / across), _focal(lens, "y", height / down)]
        fx, fy = (own or other for own, other in (focal, focal[::-1]))
        if not fx:
            raise DataError(f"{place.parent}: views without cameras: no camera_angle_x and no fl_x")
        if fx < _WIDEST * (width / across) or fy < _WIDEST * (height / down):
            raise DataError(
                f"{place.parent}: a focal length of {min(fx, fy):g} pixels for pictures of {width / across:g}x{height / down:g}; "
                "expected pixels, not shares of the picture or millimeters"
            )
        if fx > _LONGEST * (width / across) or fy > _LONGEST * (height / down):
            raise DataError(
                f"{place.parent}: a focal length of {max(fx, fy):g} pixels for pictures of {width / across:g}x{height / down:g}; "
                "no camera sees so little (is camera_angle_x in radians?)"
            )
        cx, cy = lens.get("cx", 0.5 * width / across), lens.get("cy", 0.5 * height / down)
        if 0 < cx <= 1 and 0 < cy <= 1 and min(width / across, height / down) > 2:
            raise DataError(
                f"{place.parent}: a principal point at {cx:g}, {cy:g}; expected pixels, not shares of the picture"
            )
        return np.array([[fx * across, 0, cx * across], [0, fy * down, cy * down], [0, 0, 1.0]])

    def doubts(self, width: int, height: int) -> dict[str, str]:
        """Returns what makes a lens doubtful for pictures of this size, by its kind, in words for the log."""
        found, matrix = {}, self.intrinsics(width, height)
        for number, (axis, extent) in enumerate((("x", width), ("y", height))):
            if abs(matrix[number, 2] / extent - 0.5) > _OFF_CENTER:
                found["center"] = (
                    f"a principal point at {matrix[0, 2]:.4g}, {matrix[1, 2]:.4g} in pictures of {width}x{height}, far from their"
                    " middle: right for cut-outs only; of pictures that were resized, w and h must be the size that cx, cy, fl_x"
                    " belong to"
                )
            angle, focal = self.lens.get(f"camera_angle_{axis}"), self.lens.get(f"fl_{axis}")
            if angle and focal:
                own = 0.5 * self.lens.get("wh"[number], extent) / float(np.tan(0.5 * angle))
                if abs(own / focal - 1) > _DISAGREE:
                    found["angle"] = (
                        f"fl_{axis} {focal:.4g} is taken, though camera_angle_{axis} {angle:.4g} makes it {own:.4g} pixels; leave"
                        " out the wrong one"
                    )
        return found


def _focal(lens: dict[str, float], axis: str, extent: float) -> float:
    """Returns the focal length along an axis in pixels, 0 where the file doesn't say it."""
    angle = lens.get(f"camera_angle_{axis}")
    return lens.get(f"fl_{axis}") or (0.5 * extent / float(np.tan(0.5 * angle)) if angle else 0.0)


def transforms_files(path: Path) -> list[Path]:
    """Returns the files of this kind in a folder, or the one that was named, whatever it is called; [] where there are none."""
    if path.is_dir():
        return [path / name for name in FILES if (path / name).is_file()]
    return [path] if path.is_file() and (path.name in FILES or _lists_poses(path)) else []


def _lists_poses(path: Path) -> bool:
    if path.suffix.lower() != ".json":
        return False
    with path.open("rb") as file:
        return b'"transform_matrix"' in file.read(_START)


def read_views(path: Path, *, quiet: bool = False) -> tuple[list[View], list[float]]:
    """Returns still cameras that have a picture at every time, training ones first, and the times, rising.

    quiet: what is left out isn't told. Raises DataError when there is none, or at what of the files can't be used.
    """
    views: dict[bytes, View] = {}
    for file in transforms_files(path):
        _collect(file, FILES.get(file.name, "train"), views)
    times = {time for view in views.values() for time in view.paths}
    found = list(views.values())
    if any(view.paths.keys() != times for view in found) and len(found) <= _MOST:
        found = _joined(found)
    whole = [view for view in found if view.paths.keys() == times]
    if not whole:
        raise DataError(
            f"{path}: the camera moves or zooms ({len(found)} poses and lenses for {len(times)} times); a file of views holds "
            "still cameras with a picture at every time\nRender or select at least one camera over all times"
        )
    if len(whole) < len(found) and not quiet:
        log.warn(
            f"{path}: {len(found) - len(whole)} of {len(found)} cameras without a picture at some of the {len(times)} times; left out"
        )
    whole.sort(key=lambda view: view.role != "train")
    return _each_once(path, whole, quiet), sorted(times)


def _joined(views: list[View]) -> list[View]:
    """Returns the views with those joined that are one still camera whose pose was written with noise, such as of float32."""
    kept: list[View] = []
    poses = np.empty((len(views), 4, 4))
    for view in views:
        apart = np.abs(poses[: len(kept)] - view.pose).max(axis=(1, 2))
        for near in np.flatnonzero(apart <= _NOISE * max(1.0, np.abs(view.pose).max())):
            own = kept[near]
            if (own.role, own.lens) == (view.role, view.lens) and own.paths.keys().isdisjoint(view.paths):
                own.paths.update(view.paths)
                own.masks.update(view.masks)
                break
        else:
            poses[len(kept)] = view.pose
            kept.append(view)
    return kept


def _each_once(path: Path, views: list[View], quiet: bool) -> list[View]:
    """Returns the views without those whose pictures another one has, too: a list of all pictures beside one of the tests.

    They are for testing, unless that leaves none to train on, as where the list of training is copied to please a loader.
    """
    shown = {
        role: {p for view in views if view.role == role for p in view.paths.values()} for role in ("train", "test")
    }
    both = shown["train"] & shown["test"]
    left = "test" if shown["train"] <= shown["test"] else "train"
    kept = [view for view in views if view.role != left or both.isdisjoint(view.paths.values())]
    if len(kept) < len(views) and not quiet:
        log.warn(
            f"{path}: {len(views) - len(kept)} of {len(views)} cameras listed for training and for testing; taken for"
            f" {'testing' if left == 'train' else 'training'} alone"
        )
    return kept


def named_up(path: Path) -> np.ndarray | None:
    """Returns the unit vector (3) that a file calls up, as those of instant-ngp may; None where none does.

    Raises DataError where that is no direction.
    """
    for file in transforms_files(path):
        if (told := read_json(file).get("up")) is None:
            continue
        try:
            up = np.array(told, np.float64)
        except (TypeError, ValueError, OverflowError):
            up = np.zeros(0)
        length = float(np.linalg.norm(up))
        if up.shape != (3,) or not 1e-9 < length < np.inf:
            raise DataError(f"{file}: up {told!r}; expected a direction, three numbers")
        return up / length
    return None


def _collect(path: Path, role: str, views: dict[bytes, View]) -> None:
    try:
        found = read_json(path)
        frames = found["frames"]
        if not frames or not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
            raise ValueError("no frames")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}: not a readable list of frames ({error!r})") from None
    tested = {str(name) for key in ("val_filenames", "test_filenames") for name in _values(found.get(key))}
    for number, frame in enumerate(frames):
        own_role = "test" if str(frame.get("file_path")) in tested else role
        try:
            _add(path.parent, {**found, **frame}, own_role, views)
        except DataError as error:
            raise DataError(f"{path}: frame {number}: {error}") from None


def _add(folder: Path, frame: dict[str, Any], role: str, views: dict[bytes, View]) -> None:
    """Adds one frame, with what the file says of all of them, to the view of its camera."""
    for key in ("transform_matrix", "file_path", "time"):
        if frame.get(key) is None:
            raise DataError(f"no {key!r}" + " (a still scene? 4D needs the time of every frame)" * (key == "time"))
    _check_lens(frame)
    pose, lens = _pose(frame["transform_matrix"]), {key: _number(frame, key) for key in _LENS if key in frame}
    if abs(_number(frame, "time")) > _LAST_TIME:
        raise DataError(f"time {frame['time']}; expected shares of the clip, frame numbers or seconds")
    if wrong := [key for key in _POSITIVE if lens.get(key, 1) <= 0]:
        raise DataError(f"{wrong[0]} {lens[wrong[0]]:g}; expected more than 0")
    if wrong := [key for key in _POSITIVE[:2] if lens.get(key, 0) >= np.pi]:
        raise DataError(f"{wrong[0]} {lens[wrong[0]]:g}; expected radians, below pi (degrees?)")
    time, image = _number(frame, "time"), _image(folder, str(frame["file_path"]))
    key = np.round(pose, 5).tobytes() + repr((role, sorted(lens.items()))).encode()
    view = views.setdefault(key, View(pose, role, lens))
    if view.paths.setdefault(time, image) != image:
        raise DataError(f"{image.name} and {view.paths[time].name} are of one camera at one time, {time:g}")
    if frame.get("mask_path"):
        view.masks[time] = _image(folder, str(frame["mask_path"]))


def _number(frame: dict[str, Any], key: str) -> float:
    try:
        value = float(frame[key])
    except (TypeError, ValueError):
        value = np.nan
    if not np.isfinite(value):
        raise DataError(f"{key} {frame[key]!r}; expected a number")
    return value


def _check_lens(camera: dict[str, Any]) -> None:
    """Raises DataError at a lens that no pinhole camera describes: a fisheye or panorama, or distortion that isn't 0."""
    model = str(camera.get("camera_model") or "PINHOLE").upper()
    bent = [f"{key} {camera[key]}" for key in _DISTORTION if np.any(_values(camera.get(key)))]
    if camera.get("is_fisheye"):
        model = "fisheye"
    if model not in _PINHOLES or bent:
        found = f"camera_model {model}" if model not in _PINHOLES else ", ".join(bent)
        raise DataError(
            f"{found}; expected pictures without lens distortion\n"
            "Undistort them first (colmap image_undistorter, or cv2.undistort), and write the cameras of the result"
        )


def _values(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _pose(matrix: Any) -> np.ndarray:
    try:
        pose = np.array(matrix, np.float64)
        pose = np.vstack([pose.reshape(-1, 4), [[0, 0, 0, 1.0]]])[:4] if pose.size == 12 else pose.reshape(4, 4)
    except (ValueError, TypeError):
        raise DataError("transform_matrix is not 4 x 4 numbers, nor 3 x 4") from None
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > 1e-3:
        raise DataError(
            f"transform_matrix has the last row {pose[3].tolist()}; expected 0, 0, 0, 1 (is it transposed?)"
        )
    pose = pose @ _TO_OPENCV
    lengths = np.linalg.norm(pose[:3, :3], axis=0)
    rotation = pose[:3, :3] / np.maximum(lengths, 1e-12)
    if (
        not np.isfinite(pose).all()
        or np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3
        or np.linalg.det(rotation) < 0
    ):
        raise DataError("transform_matrix is not a camera-to-world pose (rotation, shift)")
    u, _, v = np.linalg.svd(rotation)
    pose[:3, :3] = u @ v
    pose[3] = 0, 0, 0, 1
    return np.linalg.inv(pose) + 0.0  # no negative zeros: equal poses have equal bytes


def _image(folder: Path, name: str) -> Path:
    suffixes: Sequence[str] = ("", *IMAGE_SUFFIXES, *(suffix.upper() for suffix in IMAGE_SUFFIXES))
    for suffix in suffixes:
        path = path_inside(folder, folder, name + suffix)
        if path.is_file():
            return path
    raise DataError(f"{folder / name}: named by transforms_*.json, but there is no such image")
