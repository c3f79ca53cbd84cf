"""One sample: a sequence of frames, each a set of points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.store.joints import PARENT, TYPE, TYPES, no_joints
from dpcli.store.schema import KEPT, TABLES

POINT_FIELDS = {
    one.name: (one.dtype, one.row)
    for one in TABLES["clouds"]
    if one.optional and one.shape[0] == "P" and not one.group and not one.name.startswith(KEPT)
}  # name -> dtype, shape of one point
OF_PARTS = {
    one.name: one.shape[2:] for one in TABLES["clouds"] if one.shape[:2] == ("F", "parts")
}  # name -> shape of what is said of one part in one frame

LONGEST = 1e12  # the cube of which float32 still holds; a street in nanometers is shorter
TOLERANCE = 1e-3  # of rotations, unit quaternions and probabilities in float32
NO_LENGTHS = f"NaN, infinity or a number beyond {LONGEST:.0e}"


def are_lengths(values: np.ndarray) -> bool:
    """Returns whether all numbers of an array are finite, and so small that what is computed from them is so, too.

    >>> are_lengths(np.array([1.0, -2e9])), are_lengths(np.array([1.0, np.nan])), are_lengths(np.array([3e37]))
    (True, False, False)
    """
    return not values.size or bool(-LONGEST < values.min() and values.max() < LONGEST)


def are_rigid(motions: np.ndarray, last_row: float = 0.0) -> np.ndarray:
    """Returns which of (...,4,4) are a rotation and a translation, last row 0 0 0 1, bool (...). NaN and infinity are not.

    last_row: how far its numbers may be off, as in files of others.

    >>> are_rigid(np.stack([np.eye(4), np.diag([1.0, 1, -1, 1])])).tolist()
    [True, False]
    """
    rotation = motions[..., :3, :3].astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        rigid = (np.abs(rotation @ rotation.swapaxes(-1, -2) - np.eye(3)) < TOLERANCE).all((-1, -2))
        rigid &= (np.abs(motions[..., 3, :] - [0, 0, 0, 1]) <= last_row).all(-1)
    rigid &= np.isfinite(motions).all((-1, -2))
    rigid[rigid] = np.linalg.det(rotation[rigid]) > 0
    return rigid


@dataclass
class CloudSequence:
    """Holds a point cloud video. Per-point arrays are flat, frame after frame; `frame_offsets` cuts them.

    points f32 (P,3) in the file's length unit; frame_offsets i64 (T+1), from 0 to P; label counts from 0, -1 = unknown;
    time f64 (T) seconds; color u8 (P,3); part i16 (P) rigid part; track i64 (P) identity of a point over frames;
    scene_flow f32 (P,3) true displacement to the next frame, in the last frame to the one before; for motion that no
    pose tells; pose f64 (T,parts,4,4) part-to-world; joint f64 (T,parts,9) the joint above each part (docs/format.md says
    the nine numbers); shift f64 (3) what was taken off the original coordinates; extra:
    columns of the raw data that were kept, f32 (P) each, by the name that the file has for them (`field_NAME`).
    """

    name: str
    points: np.ndarray
    frame_offsets: np.ndarray
    split: str = ""
    label: int = -1
    subject: int = -1
    camera: int = -1
    time: np.ndarray | None = None
    color: np.ndarray | None = None
    part: np.ndarray | None = None
    track: np.ndarray | None = None
    scene_flow: np.ndarray | None = None
    pose: np.ndarray | None = None
    joint: np.ndarray | None = None
    shift: np.ndarray | None = None
    extra: dict[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def from_frames(cls, name: str, frames: list[np.ndarray], **fields: Any) -> CloudSequence:
        """Makes a sequence from a list of (N_t,3) arrays; per-point fields are given as lists of per-frame arrays, too.

        Raises DataError where a field holds numbers that its type can't hold, such as a part of 40,000.

        >>> waving = CloudSequence.from_frames("a", [np.zeros((2, 3)), np.ones((1, 3))], label=4)
        >>> waving.num_frames, waving.frame_offsets.tolist(), waving.frame(1).tolist()
        (2, [0, 2, 3], [[1.0, 1.0, 1.0]])
        """
        offsets = np.concatenate([[0], np.cumsum([len(frame) for frame in frames])]).astype(np.int64)
        points = np.concatenate(frames).astype(np.float32, copy=False) if frames else np.zeros((0, 3), np.float32)
        for key in POINT_FIELDS.keys() & fields.keys():
            if fields[key] is not None:
                fields[key] = _in_type_of(key, np.concatenate(fields[key]), name)
        return cls(name, points, offsets, **fields)

    @property
    def num_frames(self) -> int:
        """Counts the frames, T."""
        return len(self.frame_offsets) - 1

    def frame(self, t: int) -> np.ndarray:
        """Returns the points of frame t, f32 (N_t,3), a view."""
        return self.points[self.frame_offsets[t] : self.frame_offsets[t + 1]]

    def value(self, name: str) -> Any:
        """Returns a field by its name in the file, kept columns among them; None when the sample lacks it."""
        return self.extra.get(name) if name.startswith(KEPT) else getattr(self, name)

    def without(self, name: str) -> None:
        """Forgets a field by its name in the file."""
        if name.startswith(KEPT):
            self.extra.pop(name, None)
        else:
            setattr(self, name, None)

    def take_points(self, rows: np.ndarray, frame_offsets: np.ndarray) -> None:
        """Keeps only the points `rows` (i64), in this order, with their fields; `frame_offsets` (T+1) cuts them."""
        self.frame_offsets = frame_offsets
        for name in ("points", *POINT_FIELDS):
            values = getattr(self, name)
            if values is not None:
                setattr(self, name, values.take(rows, axis=0))
        self.extra = {name: values.take(rows) for name, values in self.extra.items()}

    def pad_parts(self, parts: int) -> None:
        """Extends `pose` and `joint` to so many parts; those that the sequence lacks stand still and have no joint."""
        if self.pose is not None:
            still = np.tile(np.eye(4), (self.num_frames, parts - self.pose.shape[1], 1, 1))
            self.pose = np.concatenate([self.pose, still], axis=1)
        if self.joint is not None:
            none = no_joints(self.num_frames, parts - self.joint.shape[1])
            self.joint = np.concatenate([self.joint, none], axis=1)

    def validate(self, num_classes: int = 0) -> None:
        """Raises DataError unless shapes, offsets, label and values are as the class says."""
        where = f"sample {self.name!r}"
        if not self.name:
            raise DataError("a sample has no name; every sample needs a unique one")
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise DataError(f"{where}: points have shape {self.points.shape}, expected (points, 3)")
        offsets = self.frame_offsets
        if len(offsets) < 2 or len(self.points) == 0:
            raise DataError(f"{where}: no frames or no points; a sample needs at least one point")
        if offsets[0] != 0 or offsets[-1] != len(self.points) or np.any(np.diff(offsets) < 0):
            raise DataError(
                f"{where}: frame_offsets must rise from 0 to {len(self.points)}, found {offsets[:4]}...{offsets[-1]}"
            )
        if not are_lengths(self.points):
            bad = int((~np.isfinite(self.points)).any(1).sum())
            if not bad:
                raise DataError(f"{where}: holds {NO_LENGTHS}; drop such points before writing")
            raise DataError(
                f"{where}: {bad} of {counted(len(self.points), 'point')} NaN or infinite; drop them before writing"
            )
        if self.label < -1 or (num_classes and self.label >= num_classes):
            known = f"0..{num_classes - 1}" if num_classes else "0, 1, ..."
            raise DataError(f"{where}: label {self.label} is out of range; expected -1 (unknown) or {known}")
        self.validate_index()
        self._validate_fields(where)

    def validate_index(self) -> None:
        """Raises DataError unless what tells this sample from others can be written: whole numbers that fit, texts
        without NUL.
        """
        for one in TABLES["clouds"]:
            value = getattr(self, one.name) if one.shape == ("S",) and not one.optional else None
            if isinstance(value, str) and "\0" in value:
                raise DataError(f"sample {self.name!r}: {one.name} {value!r} holds NUL, expected a text")
            if value is not None and not isinstance(value, str):
                most = np.iinfo(one.dtype).max
                if not -1 <= value <= most:
                    raise DataError(f"sample {self.name!r}: {one.name} {value}, expected -1 (unknown) or 0 to {most}")

    def _validate_fields(self, where: str) -> None:
        for key, (dtype, shape) in POINT_FIELDS.items():
            value = getattr(self, key)
            if value is not None and (value.shape != (len(self.points), *shape) or value.dtype != dtype):
                expected = (len(self.points), *shape)
                raise DataError(f"{where}: {key} is {value.dtype} {value.shape}, expected {np.dtype(dtype)} {expected}")
        for key, value in self.extra.items():
            if value.shape != (len(self.points),) or value.dtype != np.float32:
                raise DataError(
                    f"{where}: {key} is {value.dtype} {value.shape}, expected float32 {(len(self.points),)}"
                )
        if self.shift is not None and (np.shape(self.shift) != (3,) or not np.isfinite(self.shift).all()):
            raise DataError(f"{where}: shift is {self.shift}, expected 3 finite numbers")
        if self.time is not None and self.time.shape != (self.num_frames,):
            raise DataError(f"{where}: time has shape {self.time.shape}, expected ({self.num_frames},)")
        for name, row in OF_PARTS.items():
            values = getattr(self, name)
            if values is not None and (len(values) != self.num_frames or values.shape[2:] != row):
                expected = ", ".join(map(str, (self.num_frames, "parts", *row)))
                raise DataError(f"{where}: {name} has shape {values.shape}, expected ({expected})")
        self.validate_values()

    def validate_values(self) -> None:
        """Raises DataError where a field beside the points, of the right type and shape, holds unusable values."""
        where = f"sample {self.name!r}"
        if self.scene_flow is not None and not are_lengths(self.scene_flow):
            raise DataError(f"{where}: scene_flow holds {NO_LENGTHS}; drop the points whose motion is unknown")
        if self.time is not None and not np.isfinite(self.time).all():
            raise DataError(f"{where}: time holds NaN or infinity; make the file again")
        for name in OF_PARTS:
            values = getattr(self, name)
            if values is not None and not are_lengths(values):
                raise DataError(f"{where}: {name} holds {NO_LENGTHS}; make the file again")
        if self.part is not None and self.part.min(initial=-1) < -1:
            raise DataError(f"{where}: part holds {self.part.min()}, expected -1 (unknown) or 0, 1, ...")
        if self.joint is not None:
            parents, types = self.joint[..., PARENT], self.joint[..., TYPE]
            wrong = (parents < -1) | (parents >= self.joint.shape[1]) | (types < 0) | (types >= len(TYPES))
            if wrong.any() or (parents % 1).any() or (types % 1).any():
                frame, part = np.argwhere(wrong | (parents % 1 != 0) | (types % 1 != 0))[0]
                raise DataError(
                    f"{where}: joint of part {part} in frame {frame} has parent {parents[frame, part]:g} and type"
                    f" {types[frame, part]:g}, expected a part or -1, and 0 to {len(TYPES) - 1}"
                )


def _in_type_of(key: str, values: np.ndarray, name: str) -> np.ndarray:
    dtype = POINT_FIELDS[key][0]
    if dtype.kind in "iu" and values.dtype != dtype and values.size:  # numpy would let what doesn't fit wrap around
        least, most = np.iinfo(dtype).min, np.iinfo(dtype).max
        if not (least <= values.min() and values.max() <= most):
            found = f"{values.min():g} to {values.max():g}"
            raise DataError(f"sample {name!r}: {key} holds {found}, expected {least} to {most} ({dtype})")
    return values.astype(dtype, copy=False)
