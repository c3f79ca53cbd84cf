"""Random changes of a training clip that don't change what is done in it."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from dpcli.errors import UsageError

_LIMITS = {"scale": 1, "dropout": 1, "crop": 1, "speed": 10}  # what a range must stay below


@dataclass(frozen=True)
class Augmentation:
    """Ranges of the random changes; 0 switches one off. One draw a clip, so motion within it stays as it is.

    The defaults are ours (chosen on a validation subject: docs/experiments/classify.md). `PEERS` scales the axes only, from the
    camera, as the published loaders of MSR-Action3D do; `RELEASE` is what the published Kinet does.
    """

    scale: float = 0.2  # factor U(1-s, 1+s)
    per_axis: bool = True  # a factor for each axis
    turn: float = 0.4  # rad, U(-t, t) about the camera's vertical axis y
    tilt: float = 0.1  # rad, standard deviation of small rotations about all axes, clipped at 3 of them
    shift: float = 0.1  # length units, U(-s, s) for each axis
    jitter: float = 0.002  # length units, standard deviation for each point
    dropout: float = 0.2  # largest share of points replaced by their predecessor
    crop: float = 0.2  # largest share of a video's frames left out at its ends, with --timing uniform
    speed: float = (
        0.0  # with --timing clips, random clips: up to 1+s times as fast or slow (frames left out or repeated)
    )
    origin: bool = (
        False  # scale and turn about the camera, so that a far body moves by meters; else about the clip's mean
    )

    def __post_init__(self) -> None:
        for field in fields(self):
            value, limit = getattr(self, field.name), _LIMITS.get(field.name, np.inf)
            if not 0 <= value < limit:
                up = f"to below {limit}" if field.name in _LIMITS else "up"
                raise UsageError(f"--augment {field.name}={value}: expected a finite number from 0 {up}")

    def __call__(self, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """points f32 (T,P,3) -> the same shape, a new array."""
        linear = np.diag(rng.uniform(1 - self.scale, 1 + self.scale, 3 if self.per_axis else 1) * np.ones(3))
        angles = np.clip(rng.normal(0, 1, 3), -3, 3) * self.tilt
        angles[1] += rng.uniform(-self.turn, self.turn)
        center = np.zeros(3, np.float32) if self.origin else points.mean((0, 1))
        moved = (points - center) @ (linear @ _rotation(angles).T).astype(np.float32)
        moved += center + rng.uniform(-self.shift, self.shift, 3).astype(np.float32)
        if self.jitter:
            moved += (rng.standard_normal(moved.shape, np.float32) * self.jitter).clip(
                -3 * self.jitter, 3 * self.jitter
            )
        return self._drop(moved, rng)

    def frame_steps(self, frames: int, rng: np.random.Generator) -> np.ndarray:
        """int (frames): a clip's frames counted from its first, at a random speed; 0, 1, 2, … without `speed`."""
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


NONE = Augmentation(0, False, 0, 0, 0, 0, 0, 0)
PEERS = Augmentation(0.1, True, 0, 0, 0, 0, 0, 0, origin=True)
RELEASE = Augmentation(0.1, False, 0, 0.06, 0, 0, 0.2, 0)
PRESETS = {"ours": Augmentation(), "peers": PEERS, "release": RELEASE, "none": NONE}


def find_augmentation(text: str) -> Augmentation:
    """A preset and changes to it: `ours`, or `peers,turn=0.4,speed=0.3`. UsageError lists what there is."""
    preset, *changes = text.split(",")
    known = [field.name for field in fields(Augmentation)]
    if preset not in PRESETS:
        raise UsageError(
            f"--augment {preset}: expected one of {', '.join(PRESETS)}, then changes such as ours,speed=0.3"
        )
    values: dict[str, float | bool] = {}
    for change in changes:
        name, _, number = change.partition("=")
        try:
            values[name] = float(number)
        except ValueError:
            raise UsageError(f"--augment {change}: expected NAME=NUMBER, with a name of {', '.join(known)}") from None
        if name not in known:
            raise UsageError(f"--augment {change}: expected one of {', '.join(known)}")
    for name in ("per_axis", "origin"):
        if name in values:
            values[name] = bool(values[name])
    return replace(PRESETS[preset], **values)


def _rotation(angles: np.ndarray) -> np.ndarray:
    """Rz @ Ry @ Rx for three angles in radians."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(angles), np.sin(angles)
    x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return z @ y @ x
