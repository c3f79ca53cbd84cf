"""Reading the DFA (ARTEMIS) folder: cameras, motions, pictures, bones, skinned voxels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.prepare.reader import require_folder
from dpcli.runtime.torch_files import load_plain
from dpcli.text_files import read_text

_IMAGE = ("img_{:04d}.jpg", "img_{:04d}.png")
_ALPHA = "img_{:04d}_alpha.png"


@dataclass(frozen=True)
class Motion:
    """Holds where the pictures of one motion lie: `folders` by the number of the frame, rising."""

    name: str
    folders: dict[int, Path]

    def image(self, frame: int, camera: int) -> Path:
        """Returns the path of the color picture. Raises DataError when it is missing."""
        for pattern in _IMAGE:
            path = self.folders[frame] / pattern.format(camera)
            if path.is_file():
                return path
        raise DataError(
            f"{self.folders[frame] / _IMAGE[0].format(camera)}: missing; frame {frame} lacks camera {camera}"
        )

    def alpha(self, frame: int, camera: int) -> Path:
        """Returns the path of the mask beside it. Raises DataError when it is missing."""
        path = self.folders[frame] / _ALPHA.format(camera)
        if not path.is_file():
            raise DataError(f"{path}: missing; frame {frame} lacks the alpha of camera {camera}")
        return path


def find_motion(animal: Path, name: str) -> Motion:
    """Finds the frames of a motion. Raises UsageError that lists the motions when `name` is none of them."""
    images = require_folder(require_folder(animal, "img/, bones/, CamPose.inf, Intrinsic.inf") / "img", "MOTION/FRAME/")
    folder = images / name
    if not name or not folder.is_dir():
        counts = declared_frames(animal)
        known = sorted(p.name for p in images.iterdir() if p.is_dir())
        shown = ", ".join(f"{one} ({counts[one]} frames)" if one in counts else one for one in known) or "none"
        raise UsageError(f"--motion {name or '?'}: the motions of {animal} are {shown}")
    folders = {int(p.name): p for p in folder.iterdir() if p.is_dir() and p.name.isdecimal()}
    if not folders:
        raise DataError(f"{folder}: no frames; expected folders 0, 1, 2, ... of img_0000.jpg, img_0000_alpha.png, ...")
    return Motion(name, dict(sorted(folders.items())))


def declared_frames(animal: Path) -> dict[str, int]:
    """Returns frames of each motion as the file `sequences` says; empty without one."""
    for name in ("sequences", "sequences.txt"):
        if (animal / name).is_file():
            words = (line.split() for line in _text(animal / name).splitlines())
            return {
                line[0]: int(line[1]) for line in words if len(line) >= 2 and line[1].isdecimal() and len(line[1]) < 10
            }
    return {}


def read_poses(path: Path) -> np.ndarray:
    """Reads rigid poses f64 (N,4,4), camera-to-world or bone-to-world, of a file with 12 numbers a row.

    A row holds the 3rd, 1st, 2nd and 4th column of [R T], in this order. Raises DataError when a row is no rotation.
    """
    rows = _numbers(path)
    if rows.ndim != 2 or rows.shape[1] != 12 or not np.isfinite(rows).all():
        raise DataError(f"{path}: {rows.shape} numbers; expected rows of 12 finite ones (columns 3, 1, 2, 4 of [R T])")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    for place, column in enumerate((2, 0, 1, 3)):
        poses[:, :3, column] = rows[:, 3 * place : 3 * place + 3]
    rotation = poses[:, :3, :3]
    off = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = (off > 1e-3) | (np.linalg.det(rotation) < 0)
    if bad.any():
        row = int(np.argmax(bad))
        raise DataError(f"{path}: row {row} holds no rotation (off by {off[row]:.2g}); is the column order 3, 1, 2, 4?")
    u, _, v = np.linalg.svd(rotation)
    poses[:, :3, :3] = u @ v  # text keeps six digits
    return poses


def read_intrinsics(path: Path) -> np.ndarray:
    """Reads f64 (V,3,3) of a file that holds, per camera, a line with its number and three rows of K."""
    words = _text(path).split()
    if len(words) == 0 or len(words) % 10:
        raise DataError(f"{path}: {len(words)} numbers; expected 10 per camera: its number and K, row by row")
    try:
        table = np.array(words, np.float64).reshape(-1, 10)
    except ValueError as error:
        raise DataError(f"{path}: {error}; expected numbers only") from None
    order = table[:, 0].astype(int)
    if sorted(order) != list(range(len(order))):
        raise DataError(f"{path}: cameras {order.tolist()[:8]}; expected 0 to {len(order) - 1}, each once")
    cameras = np.empty((len(order), 3, 3))
    cameras[order] = table[:, 1:].reshape(-1, 3, 3)
    if not np.isfinite(cameras).all() or (cameras[:, [0, 1], [0, 1]] <= 0).any() or (cameras[:, 2] != [0, 0, 1]).any():
        raise DataError(f"{path}: a K isn't [[fx s cx] [0 fy cy] [0 0 1]] with positive focal lengths")
    return cameras


@dataclass(frozen=True)
class Rig:
    """Holds all cameras of the folder in its own world: intrinsics f64 (V,3,3), poses world_to_camera f64 (V,4,4)."""

    intrinsics: np.ndarray
    poses: np.ndarray


def read_rig(animal: Path) -> Rig:
    """Reads the cameras. Raises DataError when their two files hold different numbers of them."""
    to_world, intrinsics = read_poses(animal / "CamPose.inf"), read_intrinsics(animal / "Intrinsic.inf")
    if len(to_world) != len(intrinsics):
        raise DataError(
            f"{animal}: CamPose.inf has {counted(len(to_world), 'camera')}, Intrinsic.inf {len(intrinsics)}"
        )
    return Rig(intrinsics, np.linalg.inv(to_world))


def _numbers(path: Path) -> np.ndarray:
    rows = [line.split() for line in _text(path).splitlines() if line.strip()]
    try:
        return np.array(rows, np.float64)
    except ValueError:
        raise DataError(f"{path}: rows of different lengths, or words that are not numbers") from None


def _text(path: Path) -> str:
    if not path.is_file():
        raise DataError(f"{path}: missing; the cameras and bones of an ARTEMIS folder are needed, copy it completely")
    return read_text(path)


@dataclass(frozen=True)
class Skin:
    """Holds voxels of the rest pose and how bones carry them: points f64 (N,3), bone i64 (N,W), weight f64 (N,W), rows
    sum to 1.
    """

    points: np.ndarray
    bone: np.ndarray
    weight: np.ndarray

    def at(self, bones: np.ndarray, rest: np.ndarray) -> np.ndarray:
        """Computes x_t = sum_w weight (Bones_t Bones_rest^-1) x, linear blend skinning; bones, rest f64 (B,4,4) -> f64
        (N,3).
        """
        moves = bones @ np.linalg.inv(rest)
        whole = np.concatenate([self.points, np.ones((len(self.points), 1))], axis=1)
        moved = np.einsum("nwij,nj->nwi", moves[self.bone][:, :, :3], whole)
        return np.einsum("nw,nwi->ni", self.weight, moved)

    @property
    def heaviest(self) -> np.ndarray:
        """Returns the bone with the largest weight i64 (N); the first of equals."""
        return self.bone[np.arange(len(self.bone)), self.weight.argmax(axis=1)]

    def choose(self, rows: np.ndarray) -> Skin:
        """Returns the voxels of these indices alone."""
        return Skin(self.points[rows], self.bone[rows], self.weight[rows])


def has_skin(animal: Path) -> bool:
    """Tells whether the folder holds skinned voxels."""
    return (animal / "volumes" / "coords_init.pth").is_file() and (animal / "bones").is_dir()


def read_skin(animal: Path, bones: int) -> Skin:
    """Reads the voxels under volumes/; tensors only, nothing is unpickled. Raises DataError when shapes disagree."""
    folder = animal / "volumes"
    names = {"points": "coords_init.pth", "bone": "volume_indices.pth", "weight": "volume_weights.pth"}
    points, bone, weight = (_tensor(folder / name) for name in names.values())
    points, bone, weight = points.reshape(-1, points.shape[-1]), np.squeeze(bone), np.squeeze(weight)
    bone, weight = (value[:, None] if value.ndim == 1 else value for value in (bone, weight))
    if points.shape[1] != 3 or bone.shape != weight.shape or bone.shape[:1] != points.shape[:1] or not len(points):
        shapes = ", ".join(
            f"{names[key]} {value.shape}" for key, value in zip(names, (points, bone, weight), strict=True)
        )
        raise DataError(f"{folder}: {shapes}; expected (N,3), (N,W), (N,W)")
    bone, weight = bone.astype(np.int64), weight.astype(np.float64)
    used = weight > 0
    if not np.isfinite(points).all() or not np.isfinite(weight).all() or (bone[used].min(initial=0) < 0):
        raise DataError(f"{folder}: NaN or infinite values, or negative bones")
    if bone[used].max(initial=0) >= bones:
        raise DataError(f"{folder / names['bone']}: bone {bone[used].max()}, but the bones files have {bones} rows")
    total = np.where(used, weight, 0).sum(axis=1, keepdims=True)
    kept = total[:, 0] > 0  # voxels outside every bone's reach don't move with any
    share = np.where(used, weight, 0)[kept] / total[kept]
    return Skin(points[kept].astype(np.float64), np.where(used, bone, 0)[kept], share)


def _tensor(path: Path) -> np.ndarray:
    import torch

    if not path.is_file():
        raise DataError(f"{path}: missing; --tracks 0 goes without the voxels")
    value = load_plain(path)
    if not isinstance(value, torch.Tensor):
        raise DataError(f"{path}: holds a {type(value).__name__}, expected one tensor")
    return value.detach().numpy()


def outer_shell(points: np.ndarray) -> np.ndarray:
    """Returns the rows i64 of the voxels (N,3) that lack one of their six neighbors; all when they are on no regular
    grid.
    """
    step = np.inf
    for axis in range(3):
        gaps = np.diff(np.unique(np.round(points[:, axis], 6)))
        step = min(step, gaps.min(initial=np.inf))
    everything = np.arange(len(points))
    if not np.isfinite(step) or step <= 0:
        return everything
    cell = (points - points.min(axis=0)) / step
    place = np.round(cell).astype(np.int64) + 1
    shape = place.max(axis=0) + 2
    if np.abs(cell - np.round(cell)).max() > 0.05 or shape.prod(dtype=np.float64) > 5e8:
        return everything
    filled = np.zeros(shape, bool)
    filled[tuple(place.T)] = True
    around = [filled[tuple((place + step_).T)] for step_ in np.vstack([np.eye(3, dtype=int), -np.eye(3, dtype=int)])]
    return np.flatnonzero(~np.all(around, axis=0))
