"""NvGesture (Molchanov et al. 2016): 25 hand gestures, 8-bit H.264 depth in which NEARER is LARGER."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np

from dpcli.errors import DataError
from dpcli.path_names import path_inside
from dpcli.prepare.decode.depth_files import read_video
from dpcli.prepare.decode.pinhole_camera import Calibration, Intrinsics, pixel_rays
from dpcli.prepare.reader import Item, Reader, Sample, published_found, require_folder, require_known, sample_of_frames
from dpcli.text_files import read_text

CLASSES = 25
CLASS_NAMES = tuple(f"gesture {number:02}" for number in range(1, CLASSES + 1))
IMAGE_UNIT = "pixel (row, column), gray level (depth; nearer = larger)"
_SIZE, _FPS = (240, 320), 30.0  # rows and columns of the pictures, frames a second
INTRINSICS = Intrinsics(224.502, 230.494, 160.0, 120.0)
_CAMERA = Calibration(INTRINSICS, *_SIZE[::-1], source="the camera of NvGesture")
_SMALLEST = 100  # rows of pictures that may be those of the data set, resized
_RESIZED = "clips whose video is resized, not 320x240; points are in its own pixels"
_OTHER_RATE = "clips whose video isn't at 30 frames a second, in which the lists count; are they the right frames?"
PUBLISHED = {"train": 1050, "test": 482}
LINE = re.compile(
    r"path:(?P<path>\S.*?)\s+depth:(?P<stream>[^:\s]+):(?P<start>\d+):(?P<stop>\d+)(?:\s.*)?\slabel:(?P<label>\d+)\s*"
)
SUBJECT = re.compile(r"subject(\d+)_r\d+")


@dataclass(frozen=True)
class ListEntry:
    """Holds one line of a list file: ``stop`` is exclusive, ``label`` counts from 1, ``path`` is relative to the data."""

    path: str
    stream: str
    start: int
    stop: int
    label: int


def parse_line(line: str) -> ListEntry:
    """Returns the parts of a line of a list file. Raises ValueError, which says what is wrong with it.

    >>> parse_line("path:./Video_data/class_01/subject3_r0 depth:sk_depth:146:226 color:sk_color:146:226 label:1")
    ListEntry(path='./Video_data/class_01/subject3_r0', stream='sk_depth', start=146, stop=226, label=1)
    """
    match = LINE.fullmatch(line.strip())
    if not match:
        raise ValueError("expected 'path:FOLDER depth:NAME:START:STOP ... label:N'")
    start, stop, label = (int(match[key]) for key in ("start", "stop", "label"))
    if start >= stop:
        raise ValueError(f"the clip {start}:{stop} is empty; expected START < STOP")
    if not 1 <= label <= CLASSES:
        raise ValueError(f"label {label} is out of range; expected 1 to {CLASSES}")
    return ListEntry(match["path"], match["stream"], start, stop, label)


def foreground(frame: np.ndarray, erode: int = 1) -> np.ndarray:
    """Returns the mask u8 (H,W) of the hand in an 8-bit frame (H,W), nearer = larger.

    Otsu's threshold, the largest 4-connected component, ``erode`` passes of a 3x3 erosion (PointLSTM's preprocessing).
    """
    import cv2

    _, mask = cv2.threshold(frame, 0, 1, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    x, y, width, height = cv2.boundingRect(mask)
    window = mask[y : y + height, x : x + width]
    if window.size:
        count, labels = cv2.connectedComponents(window, connectivity=4)
        if count > 2:
            # areas from the labels of the foreground alone: four times faster than OpenCV's statistics
            areas = np.bincount(labels.reshape(-1).take(np.flatnonzero(window.view(bool))))
            np.equal(labels, areas.argmax(), out=window.view(bool))
    if erode and window.size:
        # one pixel around it is empty, or is the image's border, beyond which OpenCV takes the pixels for set
        window = mask[max(y - 1, 0) : y + height + 1, max(x - 1, 0) : x + width + 1]
        cv2.erode(window, np.ones((3, 3), np.uint8), dst=window, iterations=erode)
    return mask


@lru_cache(maxsize=2)
def pixel_places(height: int, width: int) -> np.ndarray:
    """Returns row, column and 0 of every pixel in raster order, f32 (H*W, 3)."""
    places = np.zeros((height, width, 3), np.float32)
    places[..., 0] = np.arange(height)[:, None]
    places[..., 1] = np.arange(width)
    places.setflags(write=False)
    return places.reshape(-1, 3)


@dataclass(frozen=True)
class NvGesture(Reader):
    """Reads NvGesture; defaults are the peers' preprocessing without their thinning to 32 frames x 512 points."""

    raw: Path
    foreground: str = "otsu"  # otsu | none
    erode: int = 1  # passes of 3x3 erosion
    coordinates: str = "image"  # image: row, column, gray level | camera: pinhole with depth 255 - gray level
    class_names: ClassVar[tuple[str, ...]] = CLASS_NAMES
    fields: ClassVar[tuple[str, ...]] = ("time",)

    def __post_init__(self) -> None:
        require_known(self, foreground=("otsu", "none"), coordinates=("image", "camera"))

    @property
    def length_unit(self) -> str:
        return IMAGE_UNIT if self.coordinates == "image" else "255 - gray level"

    def items(self) -> list[Item]:
        expected = "nvgesture_train_correct_cvpr2016_v2.lst, nvgesture_test_... and Video_data/"
        folder = require_folder(self.raw, expected)
        lists = {split: self._lists(split) for split in PUBLISHED}
        if not any(lists.values()):
            raise DataError(f"{folder}: no list file; expected {expected}")
        items: dict[str, Item] = {}
        for split, found in lists.items():
            for number, line in enumerate(read_text(found[-1]).splitlines() if found else [], start=1):
                if line.strip():
                    where = f"{found[-1]}:{number}"
                    item = self._item(line, split, where)
                    if item.name in items:
                        problem = f"{where}: {item.name} is listed twice"
                        item = Item(f"{item.name} ({where})", item.path, split, problem=problem)
                    items[item.name] = item
        if not items:
            raise DataError(f"{folder}: the list files are empty; expected one line per clip")
        return [items[name] for name in sorted(items)]

    def _lists(self, split: str) -> list[Path]:
        return sorted(self.raw.glob(f"nvgesture_{split}_correct*.lst"))

    def _item(self, line: str, split: str, where: str) -> Item:
        try:
            entry = parse_line(line)
        except ValueError as error:
            return Item(
                where.rsplit("/", 1)[-1], self.raw, split, problem=f"{where}: {error}; found {line.strip()[:80]!r}"
            )
        relative = Path(entry.path)
        subject = SUBJECT.fullmatch(relative.name)
        name = f"{'/'.join(relative.parts[-2:])}@{entry.start}"
        path, problem = self.raw, ""
        try:
            path = path_inside(self.raw, self.raw, f"{entry.path}/{entry.stream}.avi")
            problem = "" if path.is_file() else f"{where}: names {path}, which does not exist"
        except DataError as error:
            problem = f"{where}: {error}"
        return Item(
            name,
            path,
            split,
            label=entry.label - 1,
            subject=int(subject[1]) if subject else -1,
            problem=problem,
            extra={"start": entry.start, "stop": entry.stop},
        )

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        start, stop = item.extra["start"], item.extra["stop"]
        frames, rate = read_video(item.path, start, stop)
        if not frames:
            raise DataError(f"{item.path}: ends before frame {start}; the list asks for frames {start} to {stop - 1}")
        clouds = [self._points(frame) for frame in frames]
        counts = np.array([len(cloud) for cloud in clouds], np.int64)
        resized = self.coordinates == "image" and frames[0].shape != _SIZE and len(frames[0]) >= _SMALLEST
        notes = {
            _RESIZED: int(resized),
            _OTHER_RATE: int(rate is not None and abs(rate - _FPS) > 1),
            "frames listed beyond the end of a video": stop - start - len(frames),
        }
        return sample_of_frames(
            item, np.concatenate(clouds), counts, notes, time=np.arange(len(clouds)) / (rate or _FPS)
        )

    def _points(self, frame: np.ndarray) -> np.ndarray:
        if frame.dtype != np.uint8:
            raise DataError(f"frames of {frame.dtype}; expected 8-bit depth")
        # the foreground is brighter than a threshold of 0 or more: nothing unseen is in it
        seen = foreground(frame, self.erode).view(bool) if self.foreground == "otsu" else frame > 0
        pixels = np.flatnonzero(seen)
        depth = frame.reshape(-1).take(pixels).astype(np.float32)
        if self.coordinates == "camera":
            z = 255 - depth  # a gray level of 255 would be the camera itself
            camera = _CAMERA.of_pictures(*frame.shape[::-1])
            return (pixel_rays(*frame.shape, camera)[pixels] * z[:, None])[z > 0]
        points = pixel_places(*frame.shape).take(pixels, axis=0)
        points[:, 2] = depth
        return points

    def summary(self, items: list[Item]) -> list[str]:
        lines = published_found(items, PUBLISHED, "clips")
        for *others, last in filter(None, map(self._lists, PUBLISHED)):
            lines += (
                [f"of several lists {last.name} is read, not {', '.join(p.name for p in others)}"] if others else []
            )
        return lines
