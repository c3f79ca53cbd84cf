"""Files of kind `gaussians`: a 4D scene as canonical Gaussians, their motion, and the rigid parts that explain it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from dpcli.errors import DataError
from dpcli.runtime.whole_file import refuse_existing
from dpcli.store.file import PACKED, history_of, open_store, read_provenance, root_attributes, write_root
from dpcli.store.schema import TABLES
from dpcli.store.sequence import TOLERANCE, are_rigid
from dpcli.store.writing.atomic_file import AtomicFile
from dpcli.text_files import parse_json

SH_C0 = 0.28209479177387814  # the constant spherical harmonic: color = 0.5 + SH_C0 sh[:, 0]
_LARGEST_LOG_SCALE = 40  # so that a scale, and its square in a covariance, stay finite in float32
_NEAR, _NEAR_SHARE = 0.01, 0.02  # depth that 3DGS draws from; the same in half the extent of a scene in a small unit
_LETTERS = {"N": "Gaussians", "T": "frames", "S": "parts", "K": "control points", "V": "cameras", "B": "SH terms"}
LAYOUT = {field.name: (field.dtype, field.shape) for field in TABLES["gaussians"]}  # data set -> type, shape
_QUATERNIONS = ("quaternion", "frame_quaternion", "control_quaternion")


@dataclass
class GaussianScene:
    """Holds N Gaussians over T frames, S rigid parts, K control points, V cameras. World right-handed, y up; see ops/cameras.

    Canonical: mean f32 (N,3); log_scale f32 (N,3) natural log of the standard deviations; quaternion f32 (N,4) wxyz,
    unit; opacity_logit f32 (N); sh f32 (N,(degree+1)^2,3). Motion: time f64 (T) seconds, rising; frame_mean f32 (T,N,3)
    and frame_quaternion f32 (T,N,4); size and opacity stay as they are. Parts: part i16 (N) hard id, -1 none;
    part_probability f32 (N,S) 0..1; part_motion f32 (T,S,4,4) rigid, canonical to frame; rigid_weight f32 (T,N) 0..1,
    1 = moves with its part. Control: control_point f32 (K,3) canonical, control_radius f32 (K), control_position
    f32 (T,K,3), control_quaternion f32 (T,K,4). Cameras (OpenCV axes): camera_intrinsics f64 (V,3,3) in pixels of
    `size` (width, height), camera_world_to_camera f64 (V,4,4); `reference` is the input's. metrics: plain JSON values.
    """

    mean: np.ndarray
    log_scale: np.ndarray
    quaternion: np.ndarray
    opacity_logit: np.ndarray
    sh: np.ndarray
    time: np.ndarray
    frame_mean: np.ndarray
    frame_quaternion: np.ndarray
    part: np.ndarray
    part_probability: np.ndarray
    part_motion: np.ndarray
    rigid_weight: np.ndarray
    control_point: np.ndarray
    control_radius: np.ndarray
    control_position: np.ndarray
    control_quaternion: np.ndarray
    camera_intrinsics: np.ndarray
    camera_world_to_camera: np.ndarray
    size: tuple[int, int]
    reference: int = 0
    metrics: dict[str, Any] = field(default_factory=dict)

    @property
    def num_gaussians(self) -> int:
        """Counts the Gaussians, N."""
        return len(self.mean)

    @property
    def num_frames(self) -> int:
        """Counts the frames, T."""
        return len(self.time)

    @property
    def num_parts(self) -> int:
        """Counts the rigid parts, S."""
        return self.part_probability.shape[1]

    @property
    def sh_degree(self) -> int:
        """Returns the degree of the spherical harmonics, 0 to 3."""
        return round(self.sh.shape[1] ** 0.5) - 1

    @property
    def opacity(self) -> np.ndarray:
        """Returns the opacities, f32 (N), 0..1."""
        return opacity_of(self.opacity_logit)

    @property
    def scale(self) -> np.ndarray:
        """Returns the standard deviations, f32 (N,3)."""
        return np.exp(self.log_scale)

    @property
    def color(self) -> np.ndarray:
        """Returns the color that doesn't depend on the direction, u8 (N,3)."""
        return color_of(self.sh)

    @property
    def reach(self) -> float:
        """Returns half the diagonal of the box around all means of all frames, and the largest standard deviation."""
        extent = np.ptp(self.frame_mean.reshape(-1, 3).astype(np.float64), axis=0)
        return float(np.linalg.norm(extent)) / 2 + float(self.scale.max())

    @property
    def near(self) -> float:
        """Returns the least depth at which a camera sees a Gaussian: that of 3DGS, and less where the whole scene is small."""
        return min(_NEAR, max(_NEAR_SHARE * self.reach, float(np.finfo(np.float32).tiny)))

    def require_times(self, asked: np.ndarray, path: object, asker: str) -> None:
        """Raises DataError where times f64 (n), seconds, lie outside the clip by more than half a frame: nothing is known then.

        path: of the scene; asker: what asks for these times, in words.
        """
        own = self.time
        slack = 0.5 * min((np.diff(t).min() for t in (own, asked) if len(t) > 1), default=np.inf)
        if asked[0] < own[0] - slack or asked[-1] > own[-1] + slack:
            raise DataError(f"{path}: holds {own[0]:.4g} to {own[-1]:.4g} s, but {asker}")

    def between(self, time: float) -> tuple[int, int, float]:
        """Returns (a, b, w): the frames around `time` (seconds), and the weight 0..1 of the later one; clamped at the ends."""
        if not np.isfinite(time):
            raise DataError(f"time {time}: expected seconds between {self.time[0]:g} and {self.time[-1]:g}")
        after = int(np.searchsorted(self.time, time, side="right"))
        if after == 0 or after == len(self.time):
            end = min(after, len(self.time) - 1)
            return end, end, 0.0
        start, stop = self.time[after - 1 : after + 1]
        return after - 1, after, float((time - start) / (stop - start))

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Returns means f32 (N,3) and unit quaternions f32 (N,4) at `time` in seconds, clamped at the ends of the clip.

        Between frames means go straight and quaternions along the normalized shorter chord; at a frame's time the
        result is that frame, exactly.
        """
        a, b, weight = self.between(time)
        if weight == 0:
            return self.frame_mean[a].copy(), self.frame_quaternion[a].copy()
        w = np.float32(weight)
        one, two = self.frame_quaternion[a], self.frame_quaternion[b]
        two = np.where((one * two).sum(1, keepdims=True) < 0, -two, two)  # q and -q turn alike
        blend = (1 - w) * one + w * two
        return (1 - w) * self.frame_mean[a] + w * self.frame_mean[b], blend / np.linalg.norm(
            blend, axis=1, keepdims=True
        )

    def validate(self, where: str = "scene") -> None:
        """Raises DataError, starting with `where`, unless types, shapes and values are as the class says."""
        counts = {
            "N": len(self.mean),
            "T": len(self.time),
            "S": _axis(self.part_probability, 1),
            "K": len(self.control_point),
            "V": len(self.camera_intrinsics),
            "B": _axis(self.sh, 1),
        }
        for key, (dtype, shape) in LAYOUT.items():
            _check_array(where, key, getattr(self, key), dtype, shape, counts)
        for letter in "NTV":
            if not counts[letter]:
                raise DataError(f"{where}: no {_LETTERS[letter]}, expected at least one")
        for problem in self._problems():
            raise DataError(f"{where}: {problem}")

    def _problems(self) -> Iterator[str]:
        """Yields what is wrong with values, given that types and shapes are right."""
        if self.sh.shape[1] not in (1, 4, 9, 16):
            yield f"sh has {self.sh.shape[1]} terms, expected 1, 4, 9 or 16 (degree 0 to 3)"
        if self.log_scale.size and self.log_scale.max() > _LARGEST_LOG_SCALE:
            yield f"log_scale holds {self.log_scale.max():g}, expected at most {_LARGEST_LOG_SCALE}: float32 ends there"
        if np.any(np.diff(self.time) <= 0):
            yield "time must rise from frame to frame"
        for key in _QUATERNIONS:
            off = np.abs(np.linalg.norm(getattr(self, key), axis=-1) - 1) > TOLERANCE
            if off.any():
                yield f"{int(off.sum())} rows of {key} are not of length 1; normalize them before writing"
        for key in ("part_probability", "rigid_weight"):
            value = getattr(self, key)
            if value.size and (value.min() < -TOLERANCE or value.max() > 1 + TOLERANCE):
                yield f"{key} holds {value.min():g} to {value.max():g}, expected 0..1"
        if self.part.min() < -1 or self.part.max() >= self.num_parts:
            yield f"part holds {self.part.min()}..{self.part.max()}, expected -1..{self.num_parts - 1}"
        if self.control_radius.size and self.control_radius.min() <= 0:
            yield f"control_radius holds {self.control_radius.min():g}, expected lengths above 0"
        for key in ("part_motion", "camera_world_to_camera"):
            wrong = ~are_rigid(getattr(self, key))
            if wrong.any():
                yield f"{key}{np.argwhere(wrong)[0].tolist()} is not rigid (a rotation and a translation, last row 0 0 0 1)"
        yield from self._header_problems()

    def _header_problems(self) -> Iterator[str]:
        if not 0 <= self.reference < len(self.camera_intrinsics):
            yield f"reference is camera {self.reference}, expected 0..{len(self.camera_intrinsics) - 1}"
        lenses = self.camera_intrinsics
        if (lenses[:, [0, 1], [0, 1]] <= 0).any() or (lenses[:, 2] != [0, 0, 1]).any():
            yield "camera_intrinsics holds a camera that is not [[fx 0 cx] [0 fy cy] [0 0 1]], fx, fy > 0"
        # as of views: one that shifts the ends of the picture by more than half a pixel
        elif (np.abs(lenses[:, [0, 1], [1, 0]]) * max(self.size, default=0) > lenses[:, [0, 1], [0, 1]]).any():
            yield "camera_intrinsics holds a camera with a skew; expected pixels that are rectangles, since nothing draws others"
        if len(self.size) != 2 or min(self.size) < 1:
            yield f"size is {self.size}, expected (width, height) in pixels"
        try:
            json.dumps(self.metrics, allow_nan=False)
        except (TypeError, ValueError) as error:
            yield f"metrics can't be JSON ({error})"


def opacity_of(logit: np.ndarray) -> np.ndarray:
    """Returns the logistic of logits f32 (N), without overflow: f32 (N), 0..1."""
    return (0.5 * (1 + np.tanh(0.5 * logit))).astype(np.float32)


def color_of(sh: np.ndarray) -> np.ndarray:
    """Returns the color u8 (N,3) of spherical harmonics (N,terms,3) that doesn't depend on the direction."""
    return (np.clip(0.5 + SH_C0 * sh[:, 0], 0, 1) * 255 + 0.5).astype(np.uint8)


def _axis(array: np.ndarray, axis: int) -> int:
    return array.shape[axis] if np.ndim(array) > axis else -1


def _check_array(where: str, key: str, value: np.ndarray, dtype: type, shape: tuple, counts: dict[str, int]) -> None:
    expected = tuple(counts.get(length, length) for length in shape)
    if np.shape(value) != expected or value.dtype != dtype:
        names = ", ".join(_LETTERS.get(length, str(length)) for length in shape)
        found = f"{getattr(value, 'dtype', type(value).__name__)} {np.shape(value)}"
        raise DataError(f"{where}: {key} is {found}, expected {np.dtype(dtype)} {expected} = ({names})")
    if not np.isfinite(value).all():
        raise DataError(f"{where}: {int((~np.isfinite(value)).sum())} values of {key} are NaN or infinite; fit again")


def write_scene(
    path: str | Path,
    scene: GaussianScene,
    *,
    provenance: dict | Sequence[dict] | None = None,
    seed: int = 0,
    source: str = "",
    length_unit: str = "",
    force: bool = False,
) -> None:
    """Writes a scene whole or not at all. Raises UsageError when `path` exists and `force` is off; DataError as `validate`."""
    refuse_existing(path, force)
    scene.validate(f"{path}")
    history = history_of(provenance)
    with AtomicFile(path) as file:
        write_root(
            file, "gaussians", length_unit=length_unit, source=source, seed=seed, class_names=[], provenance=history
        )
        _write_arrays(file, scene)


def _write_arrays(file: h5py.File, scene: GaussianScene) -> None:
    metrics = json.dumps(scene.metrics, sort_keys=True, allow_nan=False)
    file.attrs.update({"size": np.array(scene.size, np.int64), "reference": int(scene.reference), "metrics": metrics})
    for key in LAYOUT:
        value = getattr(scene, key)
        small = value.dtype.kind == "i" and value.size  # labels pack well, coordinates hardly
        file.create_dataset(key, data=value, **(PACKED if small else {}))


def read_scene(path: str | Path) -> GaussianScene:
    """Reads a scene into memory and validates it. Raises DataError for no scene, a missing data set, or bad values."""
    with open_store(path, ["gaussians"]) as file:
        missing = [key for key in LAYOUT if key not in file] + [
            key for key in ("size", "reference", "metrics") if key not in file.attrs
        ]
        if missing:
            raise DataError(f"{path}: {', '.join(missing)} missing; the file is incomplete, fit again")
        arrays = {key: file[key][()] for key in LAYOUT}
        try:
            size, metrics = (
                tuple(int(side) for side in file.attrs["size"]),
                parse_json(str(file.attrs["metrics"]), "metrics"),
            )
            scene = GaussianScene(**arrays, size=size, reference=int(file.attrs["reference"]), metrics=metrics)
        except (DataError, TypeError, ValueError, OverflowError) as error:
            raise DataError(f"{path}: size, reference or metrics is damaged ({error}); fit again") from None
        scene.validate(str(path))
    return scene


class SceneOrigin(NamedTuple):
    """Says where a scene comes from: the file's root attributes, and the commands that led to it, oldest first."""

    attributes: dict[str, Any]
    provenance: list[dict]


def scene_origin(path: str | Path) -> SceneOrigin:
    """Reads only where a scene comes from. Raises DataError as `open_store`, and without seed, source or unit."""
    with open_store(path, ["gaussians"]) as file:
        attributes = root_attributes(file)
        absent = [name for name in ("seed", "source", "length_unit") if name not in attributes]
        if absent:
            raise DataError(f"{path}: no attribute {absent[0]!r}; another program changed the file, make it again")
        return SceneOrigin(attributes, read_provenance(file))
