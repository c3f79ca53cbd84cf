"""Random changes of a training clip that don't change what is done in it (data augmentation)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dpcli.runtime.settings.fields import Settings, setting

_WAVES, _FREQUENCY = 3, 4.0  # waves of a warp; standard deviation of their frequencies, radians per unit of length


@dataclass(frozen=True)
class Augmentation(Settings):
    """Holds the ranges of the random changes, 0 switches one off; called with a clip, changes it. One draw a clip, so that
    motion within it stays as it is.

    The defaults are ours (chosen on a validation subject: docs/experiments/classify.md). `PEERS` scales the axes only, from the
    camera, as the published loaders of MSR-Action3D do; `RELEASE` is what the published Kinet does. Raises UsageError for
    values out of range.
    """

    scale: float = setting(0.2, "Factor of the size, from 1-s to 1+s.", least=0, below=1, name="augment_scale")
    per_axis: bool = setting(True, "Scale each axis by a factor of its own.", name="augment_per_axis")
    turn: float = setting(
        0.4, "Largest rotation about the camera's vertical axis y, in radians.", least=0, name="augment_turn"
    )
    tilt: float = setting(
        0.1,
        "Standard deviation of small rotations about all axes, in radians; at most 3 deviations.",
        least=0,
        name="augment_tilt",
    )
    shift: float = setting(0.1, "Largest shift along each axis, in length units.", least=0, name="augment_shift")
    jitter: float = setting(
        0.002, "Standard deviation of each point's own shift, in length units.", least=0, name="augment_jitter"
    )
    dropout: float = setting(
        0.2, "Largest share of points replaced by their predecessor.", least=0, below=1, name="augment_dropout"
    )
    crop: float = setting(
        0.2,
        "Largest share of a video's frames left out at its ends, with timing = uniform.",
        least=0,
        below=1,
        name="augment_crop",
    )
    speed: float = setting(
        0.0,
        "0.3 shows random clips of consecutive frames up to 1.3 times as fast or slow, frames left out or repeated.",
        least=0,
        below=10,
        name="augment_speed",
    )
    origin: bool = setting(
        False,
        "Scale and rotate about the camera, so that a distant body moves by meters; false: about the clip's mean.",
        name="augment_origin",
    )
    warp: float = setting(
        0.0,
        "How far smooth waves bend and swell the space of a clip, so that its bodies have other proportions; 0.2 is moderate.",
        least=0,
        most=1,
        name="augment_warp",
    )
    still: float = setting(
        0.0,
        "Share of the clips in which one frame is held, and which are to be like no class: a network learns to be unsure where"
        " nobody moves. Not for data with a class of people who stand still; nothing with timing = slots.",
        least=0,
        below=1,
        name="augment_still",
    )

    def __call__(self, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Returns the clip f32 (T,P,3), changed as drawn from the generator, in a new array of the same shape.

        >>> clip = np.ones((2, 4, 3), np.float32)
        >>> bool((NONE(clip, np.random.default_rng(0)) == clip).all())
        True
        """
        return self._drop(self.moved(points, rng), rng)

    def moved(self, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Returns the points f32 (T,P,3) in other places, none of them dropped."""
        linear = np.diag(rng.uniform(1 - self.scale, 1 + self.scale, 3 if self.per_axis else 1) * np.ones(3))
        angles = np.clip(rng.normal(0, 1, 3), -3, 3) * self.tilt
        angles[1] += rng.uniform(-self.turn, self.turn)
        center = np.zeros(3, np.float32) if self.origin else points.mean((0, 1))
        moved = (points - center) @ (linear @ _rotation(angles).T).astype(np.float32)
        if self.warp:
            moved += _waves(moved, self.warp, rng)
        moved += center + rng.uniform(-self.shift, self.shift, 3).astype(np.float32)
        if self.jitter:
            moved += (rng.standard_normal(moved.shape, np.float32) * self.jitter).clip(
                -3 * self.jitter, 3 * self.jitter
            )
        return moved

    def frame_steps(self, frames: int, rng: np.random.Generator) -> np.ndarray:
        """Returns the numbers int (frames) of a clip's frames counted from its first, at a random speed; 0, 1, 2 ... without
        `speed`."""
        if not self.speed:
            return np.arange(frames)
        fastest = np.log1p(self.speed)
        factor = np.exp(rng.uniform(-fastest, fastest))
        return np.floor(np.arange(frames) * factor + rng.random()).astype(int)

    def _drop(self, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        if not self.dropout:
            return points
        lost = rng.random(points.shape[:2]) < rng.uniform(0, self.dropout)
        lost[:, 0] = False
        source = np.maximum.accumulate(np.where(lost, 0, np.arange(points.shape[1])), axis=1)
        return np.take_along_axis(points, source[..., None], 1)


NONE = Augmentation(0.0, False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
PEERS = replace(NONE, scale=0.1, per_axis=True, origin=True)
RELEASE = replace(NONE, scale=0.1, tilt=0.06, dropout=0.2)
SPARSE = Augmentation(scale=0.25, turn=0.4, tilt=0.1, shift=0.15, jitter=0.05, dropout=0.4, crop=0.15, speed=0.35)
AUGMENTATIONS = {"ours": Augmentation(), "sparse": SPARSE, "peers": PEERS, "release": RELEASE, "none": NONE}


def _waves(points: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    """Returns shifts f32 like points f32 (...,3) by three random waves in space, the same at all times.

    Their amplitude falls with their frequency, so that no wave folds space over.
    """
    total = np.zeros_like(points)
    for _ in range(_WAVES):
        frequency = rng.normal(0, _FREQUENCY, 3)
        amplitude = size * rng.normal(size=3) / (1 + np.linalg.norm(frequency))
        phase = points @ frequency.astype(np.float32) + np.float32(rng.uniform(0, 2 * np.pi))
        total += np.sin(phase)[..., None] * amplitude.astype(np.float32)
    return total


def _rotation(angles: np.ndarray) -> np.ndarray:
    """Returns the matrix f64 (3,3) of Rz @ Ry @ Rx for three angles in radians."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(angles), np.sin(angles)
    x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return z @ y @ x
