"""A small video of a disc that walks, in all the forms in which videos are compared."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from dpcli.ops.cameras import DEFAULT_FOVY, orbit_pose, pinhole
from dpcli.store.views import ViewsHeader, ViewsWriter

ROLES = ("reference", "train", "test", "test")
FRAMES, WIDTH, HEIGHT = 3, 32, 24


def clip(seed: int = 0, noise: float = 0, views: int = 4, frames: int = FRAMES, width: int = WIDTH) -> np.ndarray:
    """rgba u8 (V,T,H,W,4): a disc that walks; noise sigma grows with the view's number."""
    y, x = np.mgrid[:HEIGHT, :width] + 0.5
    made = np.empty((views, frames, HEIGHT, width, 4), np.uint8)
    rng = np.random.default_rng(seed)
    for v in range(views):
        for t in range(frames):
            color = 120 + 60 * np.sin(x[..., None] / 3 + y[..., None] / (2 + v) + np.arange(3))
            color = color + rng.normal(0, noise * (1 + v), color.shape)
            made[v, t, ..., :3] = np.clip(color, 0, 255)
            made[v, t, ..., 3] = 255 * np.clip(9 - np.hypot(x - 12 - 2 * t, y - 11 - v), 0, 1)
    return made


def header(roles: tuple[str, ...] = ROLES, frames: int = FRAMES, width: int = WIDTH, turn: float = 0.0) -> ViewsHeader:
    count = len(roles)
    poses = np.stack([orbit_pose(0.4 * view + turn, 0.1) for view in range(count)])
    lenses = np.tile(pinhole(DEFAULT_FOVY, width, HEIGHT), (count, 1, 1))
    return ViewsHeader(
        "disc", lenses, poses, np.arange(frames) / 10, list(roles), roles.index("reference"), (width, HEIGHT)
    )


def write(path: Path, rgba: np.ndarray, head: ViewsHeader | None = None, **fields: np.ndarray) -> Path:
    with ViewsWriter(path, head or header(), **fields) as writer:
        for v, t in np.ndindex(rgba.shape[:2]):
            writer.add(v, t, rgba[v, t])
    return path


def write_folder(folder: Path, frames: np.ndarray, name: str = "{}.png") -> Path:
    folder.mkdir(parents=True)
    for t, frame in enumerate(frames):
        Image.fromarray(frame).save(folder / name.format(t))
    return folder


def white(rgba: np.ndarray, background: float = 1.0) -> np.ndarray:
    """Composite in float64, by hand."""
    alpha = rgba[..., 3:] / 255
    return alpha * rgba[..., :3] / 255 + (1 - alpha) * background
