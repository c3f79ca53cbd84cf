"""Geometry with more than one backend: sampling, neighbors, interpolation, small inverses.

Every operation is one public function with a torch reference and a fast CPU kernel behind it (see `backend`).
Names resolve on first use, so that `from dpcli.ops import fps_numpy` needs neither torch nor numba at import.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOME = {
    "fps": "farthest_point_sampling",
    "fps_reference": "farthest_point_sampling",
    "fps_numpy": "cpu.sampling_without_torch",
    "space_time_ball_query": "ball_query",
    "space_time_ball_query_reference": "ball_query",
    "knn": "nearest_neighbors",
    "knn_reference": "nearest_neighbors",
    "three_nn_interpolate": "interpolate",
    "gather_mean": "gather",
    "gather_points": "gather",
    "small_inverse": "small_inverses",
    "small_solve": "small_inverses",
    "weighted_kabsch": "rigid",
    "apply_motions": "rigid",
    "rigid_flow": "rigid",
    "motion_matrix": "rotations",
    "quaternion_to_matrix": "rotations",
    "normalize_quaternion": "rotations",
    "multiply_quaternions": "rotations",
    "rotate_by_quaternion": "rotations",
    "nearest_rotation": "rotations",
    "mean_rotation": "rotations",
    "rasterization": "splatting.rasterization",
    "rasterization_reference": "splatting.rasterization",
    "orbit_pose": "cameras",
    "orbit_of": "cameras",
    "pinhole": "cameras",
    "chosen_backend": "backend",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
