"""SHREC'17 Track (De Smedt et al. 2017): 14 hand gestures, by one finger or the whole hand, in RealSense depth."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import ClassVar

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.prepare.actions.shrec17_lists import IMAGE_UNIT, PUBLISHED, Entry, entries, find_lists, gesture_names
from dpcli.prepare.decode.cv2_import import load_cv2
from dpcli.prepare.decode.folder_listing import folder_files, leads_out
from dpcli.prepare.decode.pinhole_camera import Intrinsics, back_project
from dpcli.prepare.decode.png import decode_depth_png
from dpcli.prepare.reader import Item, Reader, Sample, natural_key, published_found, require_known, sample_of_frames

INTRINSICS = Intrinsics(463.889, 463.889, 320.0, 240.0)
WIDTH, HEIGHT, FPS = 640, 480, 30.0
TICKS_PER_SECOND = 1e7  # of the timestamps in general_informations.txt


def read_regions(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Reads general_informations.txt: timestamps f64 (T) in ticks, hand regions i64 (T,4): x, y, width, height."""
    try:
        lines = path.read_text("utf-8-sig", "replace").splitlines()
    except FileNotFoundError:
        raise DataError(f"{path}: not found; it holds the hand's region (--no-bbox does without)") from None
    rows = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words:
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != 5 or not np.isfinite(row).all():
            raise DataError(f"{path}:{number}: {line.strip()[:60]!r}; expected 5 numbers: timestamp x y width height")
        rows.append(row)
    table = np.array(rows, np.float64).reshape(-1, 5)
    return table[:, 0], table[:, 1:].astype(np.int64)


def largest_component(mask: np.ndarray) -> np.ndarray:
    """Returns the largest 4-connected component of a mask u8 (H,W) of 0 and 1; of equal ones the first in raster
    order.
    """
    cv2 = load_cv2()
    _, labels = cv2.connectedComponents(mask, connectivity=4)
    areas = np.bincount(labels.reshape(-1)[np.flatnonzero(mask)], minlength=1)
    return mask if len(areas) < 2 else (labels == areas.argmax()).astype(np.uint8)


def keep_only_hand(depth: np.ndarray, median: int = 3, close: int = 7) -> np.ndarray:
    """Returns a cropped depth frame (H,W) u8 or u16 with all but the hand set to 0 (PointLSTM's preprocessing).

    Median blur; depth > 0 closed by a ``close`` x ``close`` square; of that the largest component; of that the pixels
    that had a depth before the closing. 0 leaves a step out.
    """
    cv2 = load_cv2()
    blurred = cv2.medianBlur(depth, median) if median else depth
    mask = (blurred > 0).astype(np.uint8)
    if close:
        square, anchor = np.ones((close, close), np.uint8), (close - 1) // 2
        dilated = cv2.dilate(mask, square)  # about close // 2, so that an even square is the other way round below
        mask = cv2.erode(dilated, square, anchor=(anchor, anchor))
    return np.where(largest_component(mask) > 0, blurred, 0)


@dataclass(frozen=True)
class Shrec17(Reader):
    """Reads SHREC'17; defaults are the peers' preprocessing without their thinning to 32 frames x 256 points."""

    raw: Path
    classes: int = 28
    bbox: bool = True
    foreground: str = "component"  # component | none
    median: int = 3  # side of the median blur, pixels; 0 = none
    close: int = 7  # side of the closing, pixels; 0 = none
    coordinates: str = "image"  # image: row, column, depth | camera: pinhole
    fields: ClassVar[tuple[str, ...]] = ("time",)

    def __post_init__(self) -> None:
        require_known(self, classes=(14, 28), foreground=("component", "none"), median=(0, 3, 5))
        require_known(self, coordinates=("image", "camera"))

    @property
    def class_names(self) -> list[str]:
        return gesture_names(find_lists(self.raw), self.classes)

    @property
    def length_unit(self) -> str:
        return IMAGE_UNIT if self.coordinates == "image" else "mm"

    def items(self) -> list[Item]:
        lists = find_lists(self.raw)
        root = lists[0].path.parent
        items = {item.name: item for item in (self._item(root, *line) for line in entries(lists))}
        listed = {item.path for item in items.values()}
        for folder in sorted(root.glob("gesture_*/finger_*/subject_*/essai_*")):
            if folder not in listed:
                name = folder.relative_to(root).as_posix()
                items[name] = Item(name, folder, problem=f"{folder}: in neither list file, so its split is unknown")
        return sorted(items.values(), key=lambda item: natural_key(item.name))

    def _item(self, root: Path, split: str, where: str, entry: Entry | str) -> Item:
        """Returns the item of a line of a list, FILE:LINE, whose sequence's folder lies beside the lists."""
        if isinstance(entry, str):
            return Item(where, root, split, problem=entry)
        folder, problem = root / entry.folder, ""
        if not folder.is_dir():
            problem = f"{root}: {where} names {entry.folder}, which does not exist"
        elif target := leads_out(folder, root):
            problem = f"{folder}: a link that leads out of the data, to {target}; copy the folder here"
        return Item(
            entry.folder,
            folder,
            split,
            label=entry.label(self.classes),
            subject=entry.subject,
            problem=problem,
            extra={"root": root, "frames": entry.frames},
        )

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        frames, notes = self._frame_paths(item)
        ticks, regions = self._regions(item, len(frames))
        clouds, cut = [], 0
        for k, path in enumerate(frames):
            depth = decode_depth_png(path.read_bytes(), str(path), (WIDTH, HEIGHT), bits=(8, 16))
            x, y, right, bottom = _clip_to_image(regions[k]) if self.bbox else (0, 0, WIDTH, HEIGHT)
            cut += bool(self.bbox and [x, y, right - x, bottom - y] != regions[k].tolist())
            clouds.append(self._points(depth, x, y, right, bottom))
        more = len(ticks) - len(frames) - sum(notes.values())  # which frame a region belongs to is their order alone
        notes["regions beyond the frames of a sequence left out; do they belong together?"] = max(more, 0)
        notes["hand regions cut at the edge of the image"] = cut
        seconds = _frame_seconds(ticks, len(frames))
        if seconds is None:
            seconds = np.arange(len(frames)) / FPS
            notes["sequences without usable timestamps (30 frames/s assumed)"] = 1
        counts = np.array([len(cloud) for cloud in clouds], np.int64)
        return sample_of_frames(item, np.concatenate(clouds), counts, notes, time=seconds)

    def _frame_paths(self, item: Item) -> tuple[list[Path], dict[str, int]]:
        """Returns the files 0_depth.png ... as many as the list says; more of them are left out and counted."""
        found = dict(folder_files(item.path, item.extra["root"], "_depth.png"))
        count = item.extra["frames"]  # of a text that may be damaged: no list of so many is made
        wanted = list(takewhile(found.__contains__, (f"{k}_depth.png" for k in range(count))))
        if len(wanted) < count:
            numbers = [name.partition("_")[0] for name in found]
            there = sum(one.isdecimal() and one == str(int(one)) and int(one) < count for one in numbers)
            raise DataError(
                f"{item.path}: {count - there} of the {count} frames that the list promises are missing, "
                f"the first: {len(wanted)}_depth.png"
            )
        return [found[name] for name in wanted], {"frames beyond the count in the list left out": len(found) - count}

    def _regions(self, item: Item, frames: int) -> tuple[np.ndarray, np.ndarray]:
        path = item.path / "general_informations.txt"
        if not self.bbox and not path.is_file():
            return np.zeros(0), np.zeros((0, 4), np.int64)
        ticks, regions = read_regions(path)
        if self.bbox and len(regions) < frames:
            raise DataError(
                f"{path}: regions of {counted(len(regions), 'frame')}; expected {frames} lines, one per frame"
            )
        return ticks, regions

    def _points(self, depth: np.ndarray, x: int, y: int, right: int, bottom: int) -> np.ndarray:
        """Returns the points f32 (N,3), in raster order of the pixels, of a region of one frame (480,640)."""
        if right <= x or bottom <= y:
            return np.zeros((0, 3), np.float32)
        region = np.ascontiguousarray(depth[y:bottom, x:right])
        if self.foreground == "component":
            region = keep_only_hand(region, self.median, self.close)
        elif self.median:
            region = load_cv2().medianBlur(region, self.median)
        if self.coordinates == "camera":
            whole = np.zeros_like(depth)
            whole[y:bottom, x:right] = region
            return back_project(whole[None], INTRINSICS)[0]
        row, column = np.divmod(np.flatnonzero(region > 0), region.shape[1])
        return np.stack([row + y, column + x, region[row, column]], axis=1).astype(np.float32)

    def summary(self, items: list[Item]) -> list[str]:
        return published_found(items, PUBLISHED, "gestures")


def _clip_to_image(region: np.ndarray) -> tuple[int, int, int, int]:
    """Returns left, top, right, bottom of what lies in the image of x, y, width, height; nothing when right <= left."""
    x, y, width, height = (int(v) for v in region)
    return max(x, 0), max(y, 0), min(x + width, WIDTH), min(y + height, HEIGHT)


def _frame_seconds(ticks: np.ndarray, frames: int) -> np.ndarray | None:
    """Returns timestamps of the frames as seconds from the first; None where they are too few or don't rise."""
    if len(ticks) < frames or (np.diff(ticks[:frames]) <= 0).any():
        return None
    return (ticks[:frames] - ticks[0]) / TICKS_PER_SECOND
