"""Where the camera is and what time it is in each picture of a clip."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dpcli.errors import UsageError
from dpcli.ops.cameras import orbit_of, orbit_pose, pinhole
from dpcli.store.gaussians import GaussianScene

PATHS = ("turntable", "orbit", "swing", "fixed", "reference")
_SMOOTH = 24.0  # pictures per second that a moving camera needs at least
_ROUND = 4.0  # seconds that the camera takes for its way, about: whole loops of the clip, so that the video loops, too
_STILL_RATE = 15.0  # pictures per second of a scene of one frame
_SWING, _BOB = np.deg2rad(35.0), np.deg2rad(20.0)


@dataclass(frozen=True)
class Shot:
    """One picture: time in seconds, world_to_camera f64 (4,4), intrinsics f64 (3,3) in pixels, size (width, height)."""

    time: float
    world_to_camera: np.ndarray
    intrinsics: np.ndarray
    size: tuple[int, int]


@dataclass(frozen=True)
class Lens:
    """What the user says of the camera: radians and world units; None = as the scene's reference camera. size: pixels of
    the picture's longer side."""

    azimuth: float | None = None
    elevation: float | None = None
    radius: float | None = None
    fovy: float | None = None
    size: int | None = None

    def __post_init__(self) -> None:
        if self.radius is not None and not self.radius > 0:
            raise UsageError(f"--radius {self.radius:g}: expected more than 0")
        if self.fovy is not None and not 0 < self.fovy < math.pi:
            raise UsageError(f"--fovy {math.degrees(self.fovy):g}: expected degrees between 0 and 180")
        if self.elevation is not None and abs(self.elevation) > math.pi / 2 + 1e-9:
            raise UsageError(f"--elevation {math.degrees(self.elevation):g}: expected -90 to 90 degrees")
        if self.size is not None and not 8 <= self.size <= 8192:
            raise UsageError(f"--size {self.size}: expected 8 to 8192 pixels")

    def place(self, scene: GaussianScene) -> tuple[float, float, float]:
        """(azimuth, elevation, radius) with the reference camera's where nothing was said."""
        known = orbit_of(scene.camera_world_to_camera[scene.reference])
        return tuple(
            own if own is not None else default
            for own, default in zip((self.azimuth, self.elevation, self.radius), known)
        )

    def sensor(self, scene: GaussianScene) -> tuple[np.ndarray, tuple[int, int]]:
        """Intrinsics f64 (3,3) and size (width, height): the reference camera's, scaled to `size`; centered with `fovy`."""
        width, height = scene.size
        zoom = self.size / max(width, height) if self.size else 1.0
        size = (max(1, round(width * zoom)), max(1, round(height * zoom)))
        if self.fovy is not None:
            return pinhole(self.fovy, *size), size
        scaled = np.diag([size[0] / width, size[1] / height, 1.0]) @ scene.camera_intrinsics[scene.reference]
        return scaled, size


def own_rate(scene: GaussianScene) -> float:
    """Frames per second of the clip as it was filmed; a usual one for a scene of one frame."""
    if scene.num_frames < 2:
        return _STILL_RATE
    return float((scene.num_frames - 1) / (scene.time[-1] - scene.time[0]))


def clip_rate(scene: GaussianScene) -> float:
    """Frames of the clip per second of a video: its own rate, but 1..60. A faster clip plays slower than real time, a
    slower one faster: no screen shows more, and nobody waits longer."""
    return float(np.clip(own_rate(scene), 1, 60))


def default_rate(scene: GaussianScene, path: str) -> float:
    """The clip's own rate; a whole multiple of it, smooth to look at, where the camera moves."""
    rate = clip_rate(scene)
    return rate if path in ("fixed", "reference") else rate * math.ceil(_SMOOTH / rate - 1e-6)


def plan(
    scene: GaussianScene,
    path: str = "turntable",
    lens: Lens = Lens(),
    *,
    frames: int | None = None,
    fps: float | None = None,
    time: float | None = None,
) -> list[Shot]:
    """The pictures of a clip: the scene plays over and over, or stands still at `time`. It plays in real time where the
    clip has 1 to 60 frames per second, else at `clip_rate`: a loop has every frame, whatever the clip's own rate.

    turntable: once around; orbit: once around, up and down; swing: to and fro; fixed: a still camera; reference: the
    input's own camera (of `lens` only the size counts). UsageError for an unknown path or empty clip.
    """
    if path not in PATHS:
        raise UsageError(f"--path {path}: expected one of {', '.join(PATHS)}")
    rate = fps or default_rate(scene, path)
    count = frames or _usual_count(scene, path, rate, time is not None)
    intrinsics, size = lens.sensor(scene) if path != "reference" else Lens(size=lens.size).sensor(scene)
    times = [time] * count if time is not None else instants(scene, count, rate)
    poses = _poses(scene, path, lens, count)
    return [Shot(float(instant), pose, intrinsics, size) for instant, pose in zip(times, poses, strict=True)]


def _loop(scene: GaussianScene) -> float:
    """Seconds of a video for the clip, with its last frame's own interval."""
    return scene.num_frames / clip_rate(scene)


def _usual_count(scene: GaussianScene, path: str, rate: float, still: bool) -> int:
    if path in ("fixed", "reference"):
        return 1 if still else max(1, round(_loop(scene) * rate))
    loops = max(1, round(_ROUND / _loop(scene)))
    return max(2, round((_ROUND if still or scene.num_frames < 2 else loops * _loop(scene)) * rate))


def instants(scene: GaussianScene, count: int, rate: float) -> np.ndarray:
    """Times f64 (count) of a video of `rate` pictures per second; after the last frame the clip begins again."""
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
    return [orbit_pose(a, e, radius) for a, e in zip(azimuths, elevations, strict=True)]
