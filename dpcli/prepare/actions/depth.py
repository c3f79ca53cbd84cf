"""Anybody's depth video: video files, folders of depth images, or arrays, to points in meters (camera axes OpenCV)."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.path_names import as_utf8
from dpcli.prepare.decode.depth_files import VIDEO_SUFFIXES, has_images, read_depth_video
from dpcli.prepare.decode.pinhole_camera import Intrinsics, back_project
from dpcli.prepare.labels import LabelTable, labels_of_folders, read_labels
from dpcli.prepare.reader import Item, Sample, describe, drop_empty_frames, natural_key, offsets
from dpcli.store import CloudSequence

DEFAULT_FOV = 60.0  # degrees; between Kinect v1 (57) and most depth cameras of today (65 to 75)
DEFAULT_FPS = 30.0
BACKGROUNDS = ("none", "median", "first")
_BACKGROUND_FRAMES = 64  # the median of more changes nothing but the time it takes


def background_depth(depth: np.ndarray, kind: str) -> np.ndarray:
    """Returns the depth of the still scene, (H,W), 0 where nothing was ever seen, of depth (T,H,W), 0 = nothing seen.

    ``median``: per pixel, the lower median of the frames in which something was seen; ``first``: the first frame.
    """
    if kind == "first":
        return depth[0]
    some = depth[np.linspace(0, len(depth) - 1, min(len(depth), _BACKGROUND_FRAMES)).astype(int)]
    seen = np.count_nonzero(some, axis=0)
    ordered = np.sort(some, axis=0)  # the unseen zeros come first
    middle = len(some) - seen + np.maximum(seen - 1, 0) // 2
    return np.take_along_axis(ordered, np.minimum(middle, len(some) - 1)[None], axis=0)[0]


@dataclass(frozen=True, kw_only=True)
class DepthVideos:
    """Reads anybody's depth videos.

    Lengths in meters, focal lengths and centers in pixels, the field of view in degrees.
    """

    inputs: tuple[Path, ...]
    intrinsics: Intrinsics | None = None
    fov: float | None = None
    depth_scale: float | None = None
    invert: bool = False
    near: float = 0.0
    far: float = float("inf")
    background: str = "none"
    margin: float = 0.05
    fps: float | None = None
    stride: int = 1
    labels: Path | None = None
    label_from_folder: bool = False
    length_unit: ClassVar[str] = "m"
    fields: ClassVar[tuple[str, ...]] = ("time",)

    def __post_init__(self) -> None:
        if self.background not in BACKGROUNDS:
            raise UsageError(f"--background {self.background}: expected one of {', '.join(BACKGROUNDS)}")
        if not 0 <= self.near < self.far:
            raise UsageError(f"--near {self.near:g} --far {self.far:g}: expected 0 <= near < far, in meters")
        if self.depth_scale is not None and not self.depth_scale > 0:
            raise UsageError(f"--depth-scale {self.depth_scale:g}: expected raw units per meter, more than 0")
        if self.fps is not None and not self.fps > 0:
            raise UsageError(f"--fps {self.fps:g}: expected more than 0")
        if self.intrinsics and self.fov is not None:
            raise UsageError("--fov and intrinsics were both given; use one")
        if self.labels and self.label_from_folder:
            raise UsageError("--labels and --label-from-folder were both given; use one")

    @property
    def class_names(self) -> list[str]:
        """Returns the class names in the order of their labels."""
        return self._table.class_names if self._table else []

    @property
    def config(self) -> dict[str, Any]:
        """Returns the options that decide the content, for the provenance."""
        values = {k: v for k, v in asdict(self).items() if k not in ("inputs", "labels", "label_from_folder", "far")}
        folders = {"label_from_folder": True} if self.label_from_folder else {}
        return {**values, "far": self.far if np.isfinite(self.far) else None, **folders}

    @cached_property
    def _table(self) -> LabelTable | None:
        if self.label_from_folder:
            return labels_of_folders(self.inputs[0], [item.name for item in self._found], "CLASS/VIDEO")
        return read_labels(self.labels) if self.labels else None

    @cached_property
    def _found(self) -> list[Item]:
        paths = [(found, given) for given in self.inputs for found in find_videos(given)]
        items: dict[str, Item] = {}
        for path, given in paths:
            name = as_utf8(path.relative_to(given).as_posix() if path != given else path.name)
            if name in items:
                raise DataError(f"{path}: another input is called {name!r}, too ({items[name].path}); rename one")
            items[name] = Item(name, path)
        return list(items.values())

    def items(self) -> list[Item]:
        """Returns the index in its final order. Raises DataError when the raw data are not what they should be."""
        return self._table.apply(self._found) if self._table else self._found

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        """Returns the sample of one item. Raises DataError when its data are bad."""
        video = read_depth_video(item.path, self.stride)
        depth, unit = self._raw(video.frames, item.path)
        if self.background != "none":
            depth, unit = depth.astype(np.float32) * np.float32(unit), 1.0
            still = background_depth(depth, self.background)
            depth[(still > 0) & (depth > still - np.float32(self.margin))] = 0
        points, counts = back_project(depth, self._camera(*depth.shape[1:]), unit=unit, near=self.near, far=self.far)
        kept, notes = drop_empty_frames(str(item.path), counts)
        rate = (self.fps or video.fps or DEFAULT_FPS) / self.stride
        return Sample(
            CloudSequence(item.name, points, offsets(counts[kept]), time=kept / rate, **describe(item)), notes
        )

    def _raw(self, frames: np.ndarray, path: Path) -> tuple[np.ndarray, float]:
        """Returns depth (T,H,W) as the sensor counts it, 0 = nothing seen, and how many meters one count is."""
        kind = frames.dtype
        if kind.kind == "f" and not np.isfinite(frames).all():
            frames = np.nan_to_num(frames, nan=0, posinf=0, neginf=0)  # the usual marks for "no return"
        usual = 1.0 if kind.kind == "f" else 100.0 if kind.itemsize == 1 else 1000.0  # raw units per meter
        scale = self.depth_scale or usual
        if self.invert:
            if kind.kind != "u":
                raise DataError(
                    f"{path}: depths of type {kind}; --invert needs unsigned integers, whose range is known"
                )
            frames = np.where(frames > 0, np.iinfo(kind).max - frames, 0)
        return frames, 1 / scale

    def _camera(self, height: int, width: int) -> Intrinsics:
        if self.intrinsics:
            return self.intrinsics
        return Intrinsics.from_field_of_view(self.fov or DEFAULT_FOV, width, height)

    def summary(self, items: list[Item]) -> list[str]:
        """Returns lines for the log about what the index holds and lacks."""
        lines = [f"{len(items)} depth video{'s' if len(items) != 1 else ''} found"]
        if not self.intrinsics and self.fov is None:
            lines.append(
                f"no intrinsics given: assuming a horizontal field of view of {DEFAULT_FOV:g} degrees (--fov, --fx ...)"
            )
        unlabeled = [item.name for item in items if item.label < 0]
        if self._table and unlabeled:
            lines.append(f"{len(unlabeled)} without a label in {self.labels}: {', '.join(unlabeled[:5])}")
        return lines


def find_videos(path: Path) -> list[Path]:
    """Returns the depth videos that an input names: itself, or what a folder holds (videos, arrays, folders of
    images).
    """
    if not path.exists():
        raise DataError(f"{path}: no such file or folder")
    if not path.is_dir() or has_images(path):
        return [path]
    found, suffixes = [], (*VIDEO_SUFFIXES, ".npy")
    for folder, folders, files in os.walk(path):  # frames are many: they are neither sorted nor asked what they are
        found += [below for name in folders if has_images(below := Path(folder, name))]
        named = (Path(folder, name) for name in files if name.lower().endswith(suffixes))
        found += [file for file in named if file.is_file()]
    found.sort(key=lambda p: natural_key(p.relative_to(path).as_posix()))
    if not found:
        raise DataError(
            f"{path}: no depth video in it; expected folders of 16-bit images, .npy, {', '.join(VIDEO_SUFFIXES)}"
        )
    return found
