"""Raw KITTI files made byte by byte from their description: PNGs, calibration lines, Velodyne scans."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from tests.support.depth_png_helpers import png_bytes

P2 = np.array([[7.2e2, 0, 6.1e2, 4.5e1], [0, 7.2e2, 1.7e2, 2.2e-1], [0, 0, 1, 2.7e-3]])


def write_png(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(png_bytes(image))


def write_calibration(path: Path, **matrices: np.ndarray) -> None:
    """Lines as KITTI's; one that holds no numbers among them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ["calib_time: 09-Jan-2012 13:57:47"]
    lines += [f"{key}: {' '.join(f'{value:.12e}' for value in np.ravel(m))}" for key, m in matrices.items()]
    path.write_text("\n".join(lines) + "\n")


def write_scan(path: Path, points: np.ndarray) -> None:
    """x y z and a reflectance, value by value."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(struct.pack("<4f", *map(float, p), 0.25) for p in points))


def velodyne_to_camera() -> np.ndarray:
    """f64 (4,4), about KITTI's: x forward -> z, y left -> -x, z up -> -y, a little turned and shifted."""
    turn = np.array([[0.01, -1, 0], [0, 0.0, -1], [1, 0.01, 0]])
    u, _, v = np.linalg.svd(turn)
    return np.block([[u @ v, np.array([[-0.02], [-0.07], [-0.3]])], [np.zeros((1, 3)), np.ones((1, 1))]])
