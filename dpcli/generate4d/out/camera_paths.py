"""Camera paths: the place of the camera and the time of the clip in each picture of a video."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dpcli.generate4d.render_settings import CameraPath
from dpcli.ops.cameras import orbit_of, orbit_pose, pinhole
from dpcli.store.gaussians import GaussianScene

_SMOOTH = 24.0  # pictures per second that a moving camera needs at least
_ROUND = 4.0  # seconds that the camera takes for its way, about: whole loops of the clip, so that the video loops, too
_STILL_RATE = 15.0  # pictures per second of a scene of one frame
SOLID, _ENDS = 0.3, (0.01, 0.99)  # opacity of the object's Gaussians; quantiles of their places at its ends
_MANY = 20_000  # places, about, that tell where these are
# of half a picture: an object in the documented sphere, before the camera of an unknown clip, stays within
_AWAY = 0.82
_SWING, _BOB = np.deg2rad(35.0), np.deg2rad(20.0)


@dataclass(frozen=True)
class Shot:
    """Describes one picture: time in seconds, world_to_camera f64 (4,4), intrinsics f64 (3,3) in pixels, size (width, height)."""

    time: float
    world_to_camera: np.ndarray
    intrinsics: np.ndarray
    size: tuple[int, int]


@dataclass(frozen=True)
class Lens:
    """Describes a camera as far as a user does: radians and scene units, about `pivot`; None stands for the reference camera's.

    size: pixels of the picture's longer side.
    """

    azimuth: float | None = None
    elevation: float | None = None
    radius: float | None = None
    fovy: float | None = None
    size: int | None = None

    def place(self, scene: GaussianScene) -> tuple[float, float, float]:
        """Returns azimuth, elevation and radius, the reference camera's where they are None."""
        reference = home(scene)
        asked = (self.azimuth, self.elevation, self.radius)
        return tuple(default if value is None else value for value, default in zip(asked, reference))

    def sensor(self, scene: GaussianScene) -> tuple[np.ndarray, tuple[int, int]]:
        """Returns intrinsics f64 (3,3) and size (width, height): the reference camera's, scaled to `size`, or with `fovy`.

        Cameras on an orbit look at its middle, which is to be in the middle of their pictures wherever the reference has it.
        """
        width, height = scene.size
        zoom = self.size / max(width, height) if self.size else 1.0
        size = (max(1, round(width * zoom)), max(1, round(height * zoom)))
        if self.fovy is not None:
            return pinhole(self.fovy, *size), size
        focal = scene.camera_intrinsics[scene.reference][[0, 1], [0, 1]] * size / scene.size
        return np.array([[focal[0], 0, 0.5 * size[0]], [0, focal[1], 0.5 * size[1]], [0, 0, 1.0]]), size

    def reference(self, scene: GaussianScene) -> tuple[np.ndarray, tuple[int, int]]:
        """Returns the reference camera's own intrinsics f64 (3,3), scaled to `size`, and the size (width, height)."""
        _, size = self.sensor(scene)
        return np.diag([size[0] / scene.size[0], size[1] / scene.size[1], 1.0]) @ scene.camera_intrinsics[
            scene.reference
        ], size


def pivot(scene: GaussianScene) -> np.ndarray:
    """Returns the point f64 (3) that cameras turn around: `turning_point` of what is solid in some frames."""
    solid, camera = scene.opacity >= min(SOLID, scene.opacity.max()), scene.reference
    places = scene.frame_mean[:: max(1, scene.num_frames // 8), solid]
    return turning_point(places, scene.camera_world_to_camera[camera], scene.camera_intrinsics[camera], scene.size)


def turning_point(
    places: np.ndarray, world_to_camera: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Returns the origin f64 (3), or the middle of an object's places (...,3) where that is far from it.

    Far is what a camera in the reference's place would have at its picture's border, or not at all, if it looked at the origin.
    """
    places = places.reshape(-1, 3).astype(np.float64)
    middle = np.quantile(places[:: max(1, len(places) // _MANY)], _ENDS, axis=0).mean(0)
    half = orbit_of(world_to_camera)[2] * (np.array(size) / intrinsics[[0, 1], [0, 1]]).min() / 2
    return np.zeros(3) if np.linalg.norm(middle) <= _AWAY * half else middle


def seen_from(middle: np.ndarray, world_to_camera: np.ndarray) -> tuple[float, float, float]:
    """Returns azimuth, elevation and distance of a camera, seen from a point (3)."""
    pose = world_to_camera.copy()
    pose[:3, 3] += pose[:3, :3] @ middle
    return orbit_of(pose)


def orbit_around(middle: np.ndarray, azimuth: float, elevation: float, radius: float) -> np.ndarray:
    """Returns world_to_camera f64 (4,4) of a camera that looks at a point (3), as `orbit_pose` at the origin."""
    pose = orbit_pose(azimuth, elevation, radius)
    pose[:3, 3] -= pose[:3, :3] @ middle
    return pose


def home(scene: GaussianScene) -> tuple[float, float, float]:
    """Returns azimuth, elevation and distance of the reference camera, seen from `pivot`; as far as all reaches where it stands there."""
    azimuth, elevation, distance = seen_from(pivot(scene), scene.camera_world_to_camera[scene.reference])
    return azimuth, elevation, distance if distance > scene.near else scene.reach


def own_rate(scene: GaussianScene) -> float:
    """Returns the frames per second at which the clip was filmed, 15 for a scene of one frame."""
    if scene.num_frames < 2:
        return _STILL_RATE
    return float((scene.num_frames - 1) / (scene.time[-1] - scene.time[0]))


def clip_rate(scene: GaussianScene) -> float:
    """Returns the frames of the clip per second of a video: those it was filmed at, but at least 1 and at most 60.

    A faster clip plays slower than real time, since no screen shows more; a slower one plays faster.
    """
    return float(np.clip(own_rate(scene), 1, 60))


def default_rate(scene: GaussianScene, path: CameraPath) -> float:
    """Returns the pictures per second of a video: `clip_rate`, or a whole multiple of at least 24 where the camera moves."""
    rate = clip_rate(scene)
    return rate if path in ("fixed", "reference") else rate * math.ceil(_SMOOTH / rate - 1e-6)


def plan_shots(
    scene: GaussianScene,
    path: CameraPath = "turntable",
    lens: Lens = Lens(),
    *,
    frames: int | None = None,
    fps: float | None = None,
    time: float | None = None,
) -> list[Shot]:
    """Returns the pictures of a video, in which the scene plays over and over, or stands still at `time` (seconds).

    The scene plays in real time where the clip has 1 to 60 frames per second, else at `clip_rate`, so that a loop has
    every frame. path: turntable goes once around, orbit also up and down, swing to and fro; fixed is a still camera,
    reference the input's own (only the size of `lens` counts). frames: number of pictures; fps: pictures per second.
    """
    rate = fps or default_rate(scene, path)
    count = frames or _usual_count(scene, path, rate, time is not None)
    intrinsics, size = lens.sensor(scene) if path != "reference" else lens.reference(scene)
    times = [time] * count if time is not None else instants(scene, count, rate)
    poses = _poses(scene, path, lens, count)
    return [Shot(float(instant), pose, intrinsics, size) for instant, pose in zip(times, poses, strict=True)]


def _loop(scene: GaussianScene) -> float:
    """Returns the seconds that the clip takes in a video, its last frame's interval included."""
    return scene.num_frames / clip_rate(scene)


def _usual_count(scene: GaussianScene, path: str, rate: float, still: bool) -> int:
    if path in ("fixed", "reference"):
        return 1 if still else max(1, round(_loop(scene) * rate))
    loops = max(1, round(_ROUND / _loop(scene)))
    return max(2, round((_ROUND if still or scene.num_frames < 2 else loops * _loop(scene)) * rate))


def instants(scene: GaussianScene, count: int, rate: float) -> np.ndarray:
    """Returns the times f64 (count), seconds of the clip, of a video of `rate` pictures per second, looped."""
    pace = clip_rate(scene) / own_rate(scene)  # seconds of the clip per second of the video
    return scene.time[0] + pace * np.mod(np.arange(count) / rate + 1e-9, _loop(scene))


def _poses(scene: GaussianScene, path: str, lens: Lens, count: int) -> list[np.ndarray]:
    if path == "reference":
        return [scene.camera_world_to_camera[scene.reference]] * count
    azimuth, elevation, radius = lens.place(scene)
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    azimuths, elevations = np.full(count, azimuth), np.full(count, elevation)
    if path in ("turntable", "orbit"):
        azimuths = azimuth + turn
    if path == "swing":
        azimuths = azimuth + _SWING * np.sin(turn)
    if path == "orbit":
        elevations = np.clip(elevation + _BOB * np.sin(turn), -np.pi / 2, np.pi / 2)
    middle = pivot(scene)
    return [orbit_around(middle, a, e, radius) for a, e in zip(azimuths, elevations, strict=True)]
