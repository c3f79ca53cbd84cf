"""Small raw folders in the official formats, made byte by byte, and the command run as a user runs it."""

from __future__ import annotations

import struct
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.reader import Item, Reader, Sample
from dpcli.store import CloudSequence

DPC = [sys.executable, "-m", "dpcli"]
ROOT = Path(__file__).resolve().parents[2]


def dpc(*arguments: str | Path, **options: Any) -> subprocess.CompletedProcess:
    """Run the command; stdout and stderr as text unless told otherwise."""
    options = {"capture_output": True, "text": True, "timeout": 120, "cwd": ROOT, **options}
    return subprocess.run([*DPC, *map(str, arguments)], **options)


def make_depth(seed: int, frames: int = 3, height: int = 6, width: int = 8, fill: float = 0.5) -> np.ndarray:
    """Depth u32 (T,H,W) with about this fraction of non-zero pixels."""
    rng = np.random.default_rng(seed)
    depth = rng.integers(1, 4000, (frames, height, width)).astype(np.uint32)
    return np.where(rng.random(depth.shape) < fill, depth, 0).astype(np.uint32)


def bin_bytes(depth: np.ndarray) -> bytes:
    """The official MSR-Action3D bytes, written value by value from their description and not with NumPy."""
    frames, height, width = depth.shape
    values = [int(v) for v in depth.ravel()]
    return struct.pack(f"<3I{len(values)}I", frames, width, height, *values)


def write_msr(folder: Path, names: list[str], **options: Any) -> Path:
    """``aAA_sSS_eEE_sdepth.bin`` files of random depth, each of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed, name in enumerate(names):
        (folder / f"{name}_sdepth.bin").write_bytes(bin_bytes(make_depth(seed, **options)))
    return folder


def write_video(path: Path, frames: np.ndarray, codec: str = "FFV1", fps: float = 30.0) -> Path:
    """u8 or u16 (T,H,W) into a gray video file, without loss under FFV1."""
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    depth_type = cv2.CV_16U if frames.dtype == np.uint16 else cv2.CV_8U
    parameters = [cv2.VIDEOWRITER_PROP_DEPTH, depth_type, cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    size = frames.shape[:0:-1]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*codec), fps, size, parameters)
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


@dataclass(frozen=True)
class ToyReader(Reader):
    """A reader without files; items whose number is in ``bad`` fail."""

    count: int = 5
    points: int = 50
    bad: tuple[int, ...] = ()
    config_extra: str = ""
    class_names: tuple[str, ...] = ("a", "b")
    length_unit: str = "m"
    fields: tuple[str, ...] = ()

    @property
    def config(self) -> dict[str, Any]:
        return {"extra": self.config_extra}

    def items(self) -> list[Item]:
        return [Item(f"toy{k:03}", Path(f"toy{k:03}"), "train", k % 2, 1, extra={"k": k}) for k in range(self.count)]

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        if item.extra["k"] in self.bad:
            raise DataError(f"{item.name} is broken")
        frames = [rng.normal(size=(self.points + t, 3)).astype(np.float32) for t in range(3)]
        return Sample(CloudSequence.from_frames(item.name, frames, split=item.split, label=item.label))

    def summary(self, items: list[Item]) -> list[str]:
        return []
