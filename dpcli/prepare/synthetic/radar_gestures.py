"""Gestures seen by a virtual radar: a few points a frame, mostly of what moves, with Doppler speed, noise and clutter.

People differ in speed, size, place, turn, handedness and sway, so that a classifier of some people says little of others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from dpcli.prepare.reader import Item, Sample, sample_of_frames
from dpcli.prepare.synthetic.gestures import FRAME_RATE, SyntheticGestures, direction, time_warp, to_camera, wrist_path
from dpcli.prepare.synthetic.human_figure import PARTS, Figure, capsules
from dpcli.runtime.seeds import PrepareStream, generator
from dpcli.store.schema import kept_name

MOST_POINTS = 64  # of a frame, as the firmware of common chips sends at most
_CANDIDATES = 180  # scattering points of a body in a frame
_FARTHEST = 30.0  # meters
_RANGE_STEP, _DOPPLER_STEP = 0.045, 0.1  # meters, meters per second: what the chip resolves
_AT_REST = direction(0.9, -1.35) * 0.95  # where a right wrist hangs, in arm lengths from its shoulder
_ANGLES = np.array([0.09, 0.16])  # standard deviation of azimuth and elevation, radians
_MIRRORED = (2, 3, 6, 7)  # classes with a side: a left hand does them as the mirror image of the opposite one
DOPPLER, INTENSITY = kept_name("doppler"), kept_name("intensity")


@dataclass(frozen=True)
class RadarSubject:
    """Holds what stays the same in all videos of a person; lengths in meters, angles in radians."""

    figure: Figure
    left_handed: bool
    tempo: float  # length of a gesture over the usual one
    size: float  # of the movement, 1 as large as the arm allows
    pause: float
    yaw: float
    place: tuple[float, float, float]  # sideways, height of the radar, distance
    sway: float


def draw_radar_subject(seed: int, subject: int) -> RadarSubject:
    """Draws the person of this number; the same in every video and every run with the seed."""
    rng = generator(seed, PrepareStream.MADE, subject)
    figure = Figure(rng.uniform(1.5, 1.95), rng.uniform(0.85, 1.2), rng.uniform(0.31, 0.35), rng.uniform(0.095, 0.115))
    return RadarSubject(
        figure,
        bool(rng.random() < 0.3),
        float(np.exp(rng.uniform(-0.5, 0.5))),
        rng.uniform(0.4, 1.0),
        rng.uniform(0.05, 0.35),
        rng.uniform(-0.5, 0.5),
        (rng.uniform(-0.7, 0.7), rng.uniform(0.8, 1.4), rng.uniform(1.2, 3.2)),
        rng.uniform(0.0, 0.08),
    )


@dataclass(frozen=True)
class RadarGestures(SyntheticGestures):
    """Makes gestures as `SyntheticGestures`, of `frames` frames on average, seen by a radar; `size` counts nothing here."""

    fields: ClassVar[tuple[str, ...]] = ("time", DOPPLER, INTENSITY)

    @property
    def config(self) -> dict[str, Any]:
        return {**super().config, "sensor": "radar"}

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        """Returns one video. A frame in which nothing is detected is dropped and counted."""
        subject = draw_radar_subject(self.seed, item.subject)
        starts, ends = animate(subject, item.label, self.frames, rng)
        fan = rng.uniform([-2, -0.5, 2], [2, 1, 6])  # something in the room that moves in its place
        frames = [self._frame(subject, starts, ends, t, fan, rng) for t in range(len(starts))]
        counts = np.array([len(frame) for frame in frames], np.int64)
        rows = np.concatenate(frames).astype(np.float32)
        extra = {DOPPLER: rows[:, 3].copy(), INTENSITY: rows[:, 4].copy()}
        time = np.arange(len(frames)) / FRAME_RATE
        return sample_of_frames(item, rows[:, :3].copy(), counts, {}, time=time, extra=extra)

    def _frame(
        self,
        subject: RadarSubject,
        starts: np.ndarray,
        ends: np.ndarray,
        t: int,
        fan: np.ndarray,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """Returns the detections of a frame: x y z, Doppler speed, intensity, f64 (N,5), at most `MOST_POINTS`."""
        seen = detect(subject.figure.radii, starts, ends, t, rng)
        rows = np.concatenate([seen, clutter(fan, rng)])
        return measure(rng.permutation(rows)[:MOST_POINTS], self.noise, rng)


def animate(subject: RadarSubject, label: int, frames: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Returns the axes of all capsules in the radar's axes, f64 (T,parts,3) each; the gesture lasts `frames` by the person's
    tempo, and before and after it a part of the way from and to rest is seen."""
    count = max(2, round(frames * subject.tempo * np.exp(rng.normal(0, 0.12))))
    mirrored = subject.left_handed and label // 2 != 4
    movement = label ^ 1 if mirrored and label in _MIRRORED else label
    phase = time_warp(count, subject.pause, rng)
    right, left = wrist_path(movement // 2, 1 - phase if movement % 2 else phase, rng)
    middle = right.mean(0)
    right = middle + subject.size * rng.uniform(0.85, 1.1) * (right - middle)
    right = reach_and_return(right, rng)
    left = np.broadcast_to(_AT_REST * [-1, 1, 1], right.shape) if left is None else right * [-1, 1, 1]
    count = len(right)
    wrists = [at + subject.figure.reach * w for at, w in zip(subject.figure.shoulders(), (right, left), strict=True)]
    axes = np.stack(capsules(subject.figure, *wrists))
    if mirrored:
        axes = axes * [-1, 1, 1]
    beat = 2 * np.pi * (np.arange(count) / FRAME_RATE * rng.uniform(0.3, 0.6) + rng.random())
    height = axes[..., 1:2] / subject.figure.height
    axes = axes + subject.sway * height * np.stack([np.cos(beat), 0 * beat, np.sin(beat)], 1)[:, None]
    place = np.array(subject.place) + rng.normal(0, [0.1, 0.03, 0.12])
    starts, ends = to_camera(axes, subject.yaw + rng.normal(0, 0.1), place)
    return starts, ends


def reach_and_return(path: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Returns the path f64 (T,3) of a wrist with the end of its way from rest before it, and of its way back behind."""
    ways = []
    for end in (path[0], path[-1]):
        shown = rng.uniform(0, 0.7)
        steps = 1 - shown * np.linspace(1, 0, round(0.4 * shown * len(path)), endpoint=False)
        steps = steps * steps * (3 - 2 * steps)
        ways.append(_AT_REST + steps[:, None] * (end - _AT_REST))
    return np.concatenate([ways[0], path, ways[1][::-1]])


def detect(radii: np.ndarray, starts: np.ndarray, ends: np.ndarray, t: int, rng: np.random.Generator) -> np.ndarray:
    """Returns what is detected of the body in frame t: x y z, radial speed, intensity in dB, f64 (N,5).

    Candidates fall on the parts by their area. One is detected the likelier the faster it comes or goes, as what stands
    still is taken for the room.
    """
    last = len(starts) - 1
    before, after = max(t - 1, 0), min(t + 1, last)
    area = radii * (np.linalg.norm(ends[t] - starts[t], axis=1) + radii)
    part = rng.choice(len(PARTS), _CANDIDATES, p=area / area.sum())
    along = rng.random((len(part), 1))
    at = [starts[f, part] + along * (ends[f, part] - starts[f, part]) for f in (before, t, after)]
    surface = rng.normal(size=(len(part), 3))
    surface *= radii[part, None] / np.linalg.norm(surface, axis=1, keepdims=True)
    surface[:, 2] = -np.abs(surface[:, 2])  # the side that faces the radar
    points = at[1] + surface
    distance = np.linalg.norm(points, axis=1)
    velocity = (at[2] - at[0]) * FRAME_RATE / max(after - before, 1)
    speed = np.sum(velocity * points, axis=1) / distance
    moving = 1 - np.exp(-((speed / 0.35) ** 2))
    seen = rng.random(len(part)) < (0.02 + 0.45 * moving) * np.clip(2.0 / distance, 0.3, 1.2)
    intensity = 32 - 40 * np.log10(distance) + 10 * np.log10(area[part] / area.mean()) + rng.normal(0, 3, len(part))
    return np.column_stack([points, speed, intensity])[seen]


def clutter(fan: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Returns a frame's false detections, f64 (N,5): of a moving thing at `fan`, ghosts nearby, and some very far away."""
    still = fan + rng.normal(0, 0.1, (rng.poisson(0.8), 3))
    ghosts = rng.uniform([-2, -1, 0.3], [2, 1, 6], (rng.poisson(1.5), 3))
    far = rng.uniform(8, _FARTHEST, (rng.poisson(0.15), 1)) * direction(rng.uniform(-0.8, 0.8), rng.uniform(-0.3, 0.3))
    points = np.concatenate([still, ghosts, far])
    return np.column_stack([points, rng.normal(0, 0.6, len(points)), rng.normal(12, 5, len(points))])


def measure(rows: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Returns detections f64 (N,5) as the chip measures them: range and speed in its steps, angles with noise."""
    distance = np.linalg.norm(rows[:, :3], axis=1)
    away = rng.normal(0, 0.03 * noise, len(rows)) + distance
    angles = np.column_stack([np.arctan2(rows[:, 0], rows[:, 2]), np.arcsin(rows[:, 1] / np.maximum(distance, 1e-9))])
    angles += rng.normal(0, 1, angles.shape) * _ANGLES * noise
    away = np.maximum(np.round(away / _RANGE_STEP), 1) * _RANGE_STEP
    speed = np.round((rows[:, 3] + rng.normal(0, 0.05 * noise, len(rows))) / _DOPPLER_STEP) * _DOPPLER_STEP
    return np.column_stack([away[:, None] * direction(angles[:, 0], angles[:, 1]), speed, rows[:, 4]])
