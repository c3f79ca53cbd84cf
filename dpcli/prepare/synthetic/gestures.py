"""Gestures of an animated figure seen by a virtual depth camera: data with ground truth when there are none.

Classes come in pairs that are one movement played forwards and backwards. Both show the same poses, so a model that
ignores the order of frames cannot tell them apart: what it gains over chance is measured against the pairs.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from dpcli.counted import counted
from dpcli.prepare.decode.pinhole_camera import Intrinsics, pixel_rays
from dpcli.prepare.reader import Item, Reader, Sample, require_least, sample_of_frames
from dpcli.prepare.synthetic.human_figure import Figure, capsules
from dpcli.prepare.synthetic.virtual_depth_camera import add_noise, render
from dpcli.runtime.seeds import PrepareStream, generator

CLASS_NAMES = (
    "raise arm",
    "lower arm",
    "swipe to left",
    "swipe to right",
    "push",
    "pull",
    "circle clockwise",
    "circle counter-clockwise",
    "open arms",
    "close arms",
)
FRAME_RATE = 15.0  # frames per second
_FIELD_OF_VIEW = 57.0  # degrees, horizontal: Kinect v1


def wrist_path(movement: int, s: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray | None]:
    """Returns where the wrists are at phase s (T) of 0..1: right, left f64 (T,3) from their shoulders, in arm lengths.

    movement: index of a pair of classes. None for a left wrist that rests. Size, height and direction vary with rng.
    """
    reach, tilt = rng.uniform(0.85, 0.97), rng.uniform(-0.15, 0.15)
    if movement == 0:  # up through an upright plane, from the hip to above the head
        elevation = np.interp(s, [0, 1], [-1.3 + tilt, 1.2 + tilt])
        return direction(rng.uniform(0.1, 1.0), elevation) * reach, None
    if movement == 1:  # across the chest, from the right to the left
        return direction(np.interp(s, [0, 1], [1.1 + tilt, -0.7 + tilt]), rng.uniform(-0.25, 0.35)) * reach, None
    if movement == 2:  # away from the chest
        ahead = np.interp(s, [0, 1], [rng.uniform(0.3, 0.4), reach])
        return direction(rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.3) + 0 * s) * ahead[:, None], None
    if movement == 3:  # clockwise as the figure itself sees it
        angle, radius = rng.uniform(0, 2 * np.pi) + 2 * np.pi * s, rng.uniform(0.3, 0.45)
        center = np.array([tilt, rng.uniform(-0.1, 0.2), 0.65])
        return center + radius * np.stack([np.sin(angle), np.cos(angle), 0 * s], axis=1), None
    azimuth = np.interp(s, [0, 1], [-0.1 + tilt / 2, 1.4 + tilt / 2])
    right = direction(azimuth, rng.uniform(-0.3, 0.3)) * reach
    return right, right * [-1, 1, 1]


def direction(azimuth: np.ndarray | float, elevation: np.ndarray | float) -> np.ndarray:
    """Returns unit vectors (T,3); azimuth from straight ahead toward the right, elevation from the horizon, radians."""
    azimuth, elevation = np.broadcast_arrays(azimuth, elevation)
    return np.stack(
        [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)], axis=-1
    )


@dataclass(frozen=True)
class _Subject:
    """Holds what stays the same in all videos of a person."""

    figure: Figure
    pause: float  # longest rest before and after the movement, as a fraction of the video
    yaw: float  # how far the figure turns from the camera, radians
    distance: float  # meters
    camera_height: float  # meters


def draw_subject(seed: int, subject: int) -> _Subject:
    """Draws the person of this number; the same in every video and every run with the seed."""
    rng = generator(seed, PrepareStream.MADE, subject)
    figure = Figure(rng.uniform(1.5, 1.95), rng.uniform(0.85, 1.2), rng.uniform(0.31, 0.35), rng.uniform(0.095, 0.115))
    return _Subject(
        figure, rng.uniform(0.05, 0.3), rng.uniform(-0.4, 0.4), rng.uniform(2.2, 2.9), rng.uniform(0.8, 1.3)
    )


def time_warp(frames: int, pause: float, rng: np.random.Generator) -> np.ndarray:
    """Returns phase f64 (T) from 0 to 1: a rest, a smooth movement, a rest. Its law is the same when played backwards."""
    before, after = rng.uniform(0, pause, 2)
    t = (np.linspace(0, 1, frames) - before) / (1 - before - after)
    t = np.clip(t, 0, 1)
    return t * t * (3 - 2 * t)


@dataclass(frozen=True)
class SyntheticGestures(Reader):
    """Makes gestures. ``size``: image width in pixels (the height is 3/4 of it)."""

    videos_per_class: int = 20
    frames: int = 24
    subjects: int = 10
    size: int = 160
    noise: float = 1.0
    seed: int = 0
    length_unit: ClassVar[str] = "m"
    class_names: ClassVar[tuple[str, ...]] = CLASS_NAMES
    fields: ClassVar[tuple[str, ...]] = ("time", "part")

    def __post_init__(self) -> None:
        require_least(self, videos_per_class=1, frames=2, subjects=2, size=16)

    @property
    def seen_subjects(self) -> int:
        """Returns how many subjects there are videos of: with few videos of a class not all of them."""
        return min(self.subjects, self.videos_per_class)

    @property
    def train_subjects(self) -> int:
        """Returns the number of subjects, from 1 on, whose videos are for training: six of ten of those seen; the others test."""
        return max(1, min(self.seen_subjects - 1, round(0.6 * self.seen_subjects)))

    def items(self) -> list[Item]:
        return [
            self._item(label, 1 + number % self.subjects, number)
            for number in range(self.videos_per_class)
            for label in range(len(CLASS_NAMES))
        ]

    def _item(self, label: int, subject: int, number: int) -> Item:
        split = "train" if subject <= self.train_subjects else "test"
        name = f"g{label + 1:02}_s{subject:02}_v{number + 1:04}"
        return Item(name, Path(name), split=split, label=label, subject=subject)

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        subject = draw_subject(self.seed, item.subject)
        starts, ends = self._animate(subject, item.label, rng)
        height, width = self.size * 3 // 4, self.size
        intrinsics = Intrinsics.from_field_of_view(_FIELD_OF_VIEW, width, height)
        rays = pixel_rays(height, width, intrinsics)
        points, parts = [], []
        for a, b in zip(starts, ends, strict=True):
            depth, part = render(a, b, subject.figure.radii, intrinsics, height, width)
            seen = np.flatnonzero(np.isfinite(depth))
            z = add_noise(depth.reshape(-1)[seen], rng, self.noise, 0.02 * self.noise)
            seen, z = seen[z > 0], z[z > 0]
            points.append(rays[seen] * z[:, None])
            parts.append(part.reshape(-1)[seen])
        counts = np.array([len(p) for p in points], np.int64)
        time = np.arange(len(counts)) / FRAME_RATE
        return sample_of_frames(item, np.concatenate(points), counts, {}, time=time, part=np.concatenate(parts))

    def _animate(self, subject: _Subject, label: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Returns axes of all capsules in camera axes, f64 (T,parts,3) each."""
        figure, phase = subject.figure, time_warp(self.frames, subject.pause, rng)
        right, left = wrist_path(label // 2, 1 - phase if label % 2 else phase, rng)
        if left is None:
            left = np.broadcast_to(direction(-0.9, -1.35) * 0.95, right.shape)
        tremor = 0.01 * rng.standard_normal((2, self.frames, 3))
        wrists = [s + figure.reach * w + t for s, w, t in zip(figure.shoulders(), (right, left), tremor, strict=True)]
        yaw = subject.yaw + rng.normal(0, 0.08)
        place = np.array([rng.normal(0, 0.08), subject.camera_height, subject.distance + rng.normal(0, 0.08)])
        starts, ends = capsules(figure, *wrists)
        return to_camera(starts, yaw, place), to_camera(ends, yaw, place)

    def summary(self, items: list[Item]) -> list[str]:
        seen, train = self.seen_subjects, self.train_subjects
        split = f"subjects 1-{train} of {seen} train, the others test"
        if seen == 1:
            split = "all are of subject 1 and train; with --videos-per-class 2 or more, another subject tests"
        return [f"{counted(len(items), 'video')} of {len(CLASS_NAMES)} gestures; {split}"]


def to_camera(points: np.ndarray, yaw: float, place: np.ndarray) -> np.ndarray:
    """Turns body axes (...,3) into camera axes (OpenCV): the figure faces the camera, turned by ``yaw`` about the
    upright.

    place: (sideways shift, height of the camera above the floor, distance), meters.
    """
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    sideways, ahead = np.cos(yaw) * x + np.sin(yaw) * z, np.cos(yaw) * z - np.sin(yaw) * x
    return np.stack([place[0] - sideways, place[1] - y, place[2] - ahead], axis=-1)
