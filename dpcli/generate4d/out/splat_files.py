"""Gaussians in the files that players read: 3DGS `.ply` (Kerbl 2023) and `.splat` (antimatter15), and their cameras."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.runtime.whole_file import write_whole
from dpcli.store.gaussians import GaussianScene, color_of, opacity_of

# Half a turn about x: our world (y up, the reference camera at +z) to the players' (x right, y down, z forward)
TO_PLAYER = np.diag([1.0, -1.0, -1.0])
# What that does to real spherical harmonics, in the order of 3DGS: -1 where the term is odd in y and z together
_SH_SIGNS = np.float32([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1])
_SPLAT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quaternion", "u1", 4)])


@dataclass
class Splats:
    """Holds Gaussians at one instant, as in `GaussianScene`.

    mean, log_scale: f32 (N,3). quaternion: f32 (N,4), wxyz. opacity_logit: f32 (N). sh: f32 (N,(degree+1)^2,3).
    """

    mean: np.ndarray
    log_scale: np.ndarray
    quaternion: np.ndarray
    opacity_logit: np.ndarray
    sh: np.ndarray

    @classmethod
    def of(cls, scene: GaussianScene, time: float | None = None, axes: str = "player") -> Splats:
        """Returns the canonical Gaussians, or those at `time` (seconds); axes: player (x right, y down) or keep."""
        mean, quaternion = (scene.mean, scene.quaternion) if time is None else scene.at(time)
        whole = cls(mean, scene.log_scale, quaternion, scene.opacity_logit, scene.sh)
        return whole if axes == "keep" else whole.turned()

    def turned(self) -> Splats:
        """Returns the Gaussians after half a turn about x, which TO_PLAYER is."""
        w, x, y, z = self.quaternion.T
        return Splats(
            self.mean * np.float32(TO_PLAYER.diagonal()),
            self.log_scale,
            np.stack([-x, w, -z, y], 1),
            self.opacity_logit,
            self.sh * _SH_SIGNS[: self.sh.shape[1], None],
        )


def write_splat_ply(path: Path, splats: Splats) -> None:
    """Writes one 3DGS .ply: binary little-endian; opacity as a logit, sizes as logarithms, color terms channel by channel.

    Raises DataError when it can't be written.
    """
    rest = splats.sh[:, 1:].transpose(0, 2, 1).reshape(len(splats.mean), -1)  # all terms of red, then green, blue
    columns = {
        **dict(zip("xyz", splats.mean.T)),
        **dict.fromkeys(("nx", "ny", "nz"), np.zeros(len(splats.mean))),
        **{f"f_dc_{i}": values for i, values in enumerate(splats.sh[:, 0].T)},
        **{f"f_rest_{i}": values for i, values in enumerate(rest.T)},
        "opacity": splats.opacity_logit,
        **{f"scale_{i}": values for i, values in enumerate(splats.log_scale.T)},
        **{f"rot_{i}": values for i, values in enumerate(splats.quaternion.T)},
    }
    rows = np.stack([np.float32(values) for values in columns.values()], axis=1).astype("<f4")
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(rows)}",
        *(f"property float {name}" for name in columns),
        "end_header",
    ]
    write_whole(path, ("\n".join(lines) + "\n").encode("ascii") + rows.tobytes())


def write_splat(path: Path, splats: Splats) -> None:
    """Writes one .splat: 32 bytes a Gaussian, the largest and most opaque first; the color is the one without direction.

    Raises DataError when it can't be written.
    """
    opacity = opacity_of(splats.opacity_logit)
    rows = np.empty(len(splats.mean), _SPLAT)
    rows["mean"], rows["scale"] = splats.mean, np.exp(splats.log_scale)
    rows["rgba"][:, :3], rows["rgba"][:, 3] = color_of(splats.sh), np.rint(opacity * 255)
    rows["quaternion"] = np.clip(np.rint(splats.quaternion * 128 + 128), 0, 255)
    weight = splats.log_scale.sum(1, dtype=np.float64) + np.log(np.maximum(opacity, 1e-30))
    write_whole(path, rows[np.argsort(-weight, kind="stable")].tobytes())


def camera_list(scene: GaussianScene, axes: str = "player") -> list[dict[str, Any]]:
    """Returns the scene's cameras as 3DGS's cameras.json has them, and beside that cx, cy and which is the reference.

    Each has position, rotation (camera to world, columns x right, y down, z forward), fx and fy in pixels.
    """
    width, height = scene.size
    turn = np.eye(3) if axes == "keep" else TO_PLAYER
    cameras = []
    for index, (lens, pose) in enumerate(zip(scene.camera_intrinsics, scene.camera_world_to_camera)):
        rotation = turn @ pose[:3, :3].T
        cameras.append(
            {
                "id": index,
                "img_name": f"view{index}",
                "width": width,
                "height": height,
                "position": (-rotation @ pose[:3, 3]).tolist(),
                "rotation": rotation.tolist(),
                "fx": lens[0, 0],
                "fy": lens[1, 1],
                "cx": lens[0, 2],
                "cy": lens[1, 2],
                "reference": index == scene.reference,
            }
        )
    return cameras
