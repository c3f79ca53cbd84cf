"""Random changes of a training clip that don't change what is done in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Augmentation:
    """Ranges of the random changes; 0 switches one off. One draw a clip, so motion within it stays as it is.

    The defaults are ours (chosen on a validation subject: docs/experiments.md). `PEERS` scales the axes only,
    `RELEASE` is what the published Kinet does (facts section 3).
    """

    scale: float = 0.2  # factor U(1-s, 1+s)
    per_axis: bool = True  # a factor for each axis
    turn: float = 0.4  # rad, U(-t, t) about the camera's vertical axis y
    tilt: float = 0.1  # rad, standard deviation of small rotations about all axes, clipped at 3 of them
    shift: float = 0.1  # length units, U(-s, s) for each axis
    jitter: float = 0.002  # length units, standard deviation for each point
    dropout: float = 0.2  # largest share of points replaced by their predecessor
    crop: float = 0.2  # largest share of a video's frames left out at its ends, with --timing uniform

    def __call__(self, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """points f32 (T,P,3) -> the same shape, a new array."""
        linear = np.diag(rng.uniform(1 - self.scale, 1 + self.scale, 3 if self.per_axis else 1) * np.ones(3))
        angles = np.clip(rng.normal(0, 1, 3), -3, 3) * self.tilt
        angles[1] += rng.uniform(-self.turn, self.turn)
        center = points.mean((0, 1))
        moved = (points - center) @ (linear @ _rotation(angles).T).astype(np.float32)
        moved += center + rng.uniform(-self.shift, self.shift, 3).astype(np.float32)
        if self.jitter:
            moved += (rng.standard_normal(moved.shape, np.float32) * self.jitter).clip(
                -3 * self.jitter, 3 * self.jitter
            )
        return self._drop(moved, rng)

    def _drop(self, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        if not self.dropout:
            return points
        lost = rng.random(points.shape[:2]) < rng.uniform(0, self.dropout)
        lost[:, 0] = False
        source = np.maximum.accumulate(np.where(lost, 0, np.arange(points.shape[1])), axis=1)
        return np.take_along_axis(points, source[..., None], 1)


NONE = Augmentation(0, False, 0, 0, 0, 0, 0, 0)
PEERS = Augmentation(0.1, True, 0, 0, 0, 0, 0, 0)
RELEASE = Augmentation(0.1, False, 0, 0.06, 0, 0, 0.2, 0)
PRESETS = {"ours": Augmentation(), "peers": PEERS, "release": RELEASE, "none": NONE}


def _rotation(angles: np.ndarray) -> np.ndarray:
    """Rz @ Ry @ Rx for three angles in radians."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(angles), np.sin(angles)
    x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return z @ y @ x
