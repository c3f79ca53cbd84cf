"""Depth PNGs and the raw folders of SHREC'17 and NTU RGB+D, written byte by byte from their descriptions."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np


def png_bytes(image: np.ndarray) -> bytes:
    """A PNG of u8 or u16, gray (H,W) or RGB (H,W,3), after the specification: no filter, one IDAT, big-endian samples."""
    height, width = image.shape[:2]
    rows = image.astype(image.dtype.newbyteorder(">")).reshape(height, -1)
    raw = b"".join(b"\0" + row.tobytes() for row in rows)
    header = struct.pack(">IIBBBBB", width, height, 8 * image.dtype.itemsize, 2 * (image.ndim == 3), 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(raw, 1)), (b"IEND", b"")]
    body = b"".join(struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks)
    return b"\x89PNG\r\n\x1a\n" + body


def person(seed: int, frames: int = 2) -> np.ndarray:
    """Masked depth u16 (T,424,512) in mm: a blob of a person on nothing."""
    rng = np.random.default_rng(seed)
    depth = np.zeros((frames, 424, 512), np.uint16)
    for t in range(frames):
        top, left = rng.integers(20, 300), rng.integers(20, 400)
        depth[t, top : top + 40, left : left + 15] = rng.integers(2000, 4200, (40, 15))
    return depth


def ntu_files(name: str, depth: np.ndarray, first: int = 1) -> dict[str, bytes]:
    """``nturgb+d_depth_masked/NAME/MDepth-00000001.png`` ... -> content."""
    folder = f"nturgb+d_depth_masked/{name}"
    return {f"{folder}/MDepth-{first + t:08d}.png": png_bytes(frame) for t, frame in enumerate(depth)}


def write_files(root: Path, files: dict[str, bytes]) -> Path:
    """Files by relative path."""
    for name, content in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return root


def hand_depth(seed: int, frames: int = 3, dtype: type = np.uint16) -> np.ndarray:
    """Depth (T,480,640): a solid hand that moves, a small speck near it, and noise far away."""
    rng = np.random.default_rng(seed)
    depth = np.zeros((frames, 480, 640), dtype)
    high = 250 if dtype == np.uint8 else 900
    for t in range(frames):
        depth[t, 100:130, 200 + t : 240 + t] = rng.integers(100, high, (30, 40))
        depth[t, 112:116, 215:219] = 0  # a hole that the closing fills, and that has no depth
        depth[t, 150:154, 200:204] = 120
        depth[t, 300:302, 500:502] = 200
    return depth


REGION = (190, 90, 70, 80)  # x, y, width, height around the hand and the speck


def write_gesture(root: Path, folder: str, depth: np.ndarray, regions: list[tuple] | None = None) -> Path:
    """One SHREC'17 sequence: k_depth.png, general_informations.txt with ticks of 1e-7 s, and the skeleton files."""
    place = root / folder
    place.mkdir(parents=True, exist_ok=True)
    for k, frame in enumerate(depth):
        (place / f"{k}_depth.png").write_bytes(png_bytes(frame))
    regions = regions or [REGION] * len(depth)
    lines = [" ".join(f"{v:.6f}" for v in (6.4e10 + 333_333 * k, *region)) for k, region in enumerate(regions)]
    (place / "general_informations.txt").write_text("\n".join(lines) + "\n")
    for name in ("skeletons_image.txt", "skeletons_world.txt"):
        (place / name).write_text("0.0 0.0\n")
    return place


def write_lists(root: Path, train: list[str], test: list[str] = ()) -> Path:
    """train_gestures.txt and test_gestures.txt."""
    root.mkdir(parents=True, exist_ok=True)
    for split, lines in (("train", train), ("test", test)):
        (root / f"{split}_gestures.txt").write_text("".join(f"{line}\n" for line in lines))
    return root
