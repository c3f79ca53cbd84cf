"""Color frames of a clip, decoded one at a time: a folder of images in any peer's naming, a video file or a GIF."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.decode.cv2_import import load_cv2
from dpcli.prepare.decode.depth_files import open_video
from dpcli.prepare.reader import natural_key

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".webm", ".mkv", ".m4v")
ANIMATION_SUFFIXES = (".gif", ".apng")
_BY_DURATION = (".mkv", ".webm")  # OpenCV's count of frames is made up of the clip's duration and mean rate
_STAMP_STEP = 2e-3  # s: what rounding does to time stamps
FOLDER_FPS = 16.0  # 32 frames in 2 seconds: how the usual test clips were sampled


@dataclass(frozen=True)
class Frames:
    """Holds the frames of a clip. `names` are for messages; `numbers` the integers in the names (or 0, 1, ...).

    times: f64 (T) seconds as the file declares them, None when it doesn't.
    """

    path: Path
    names: tuple[str, ...]
    numbers: tuple[int, ...]
    files: tuple[Path, ...]  # what to digest
    times: tuple[float, ...] | None = None

    def __len__(self) -> int:
        return len(self.names)

    def read(self, wanted: Sequence[int]) -> Iterator[np.ndarray]:
        """Yields frames by rising index, each u8 (H,W,4) straight alpha, opaque where the file has no alpha."""
        if self.path.is_dir():
            return (read_rgba(self.files[index]) for index in wanted)
        if self.path.suffix.lower() in ANIMATION_SUFFIXES:
            return _animation_frames(self.path, wanted)
        return _video_frames(self.path, wanted)


def open_frames(path: Path) -> Frames:
    """Opens the frames of a folder, video or GIF. Raises DataError when there are none or they cannot be decoded."""
    if path.is_dir():
        return _open_folder(path)
    if not path.is_file():
        raise DataError(f"{path}: no such file or folder; expected frames: a folder of images, a video or a .gif")
    suffix = path.suffix.lower()
    if suffix in ANIMATION_SUFFIXES:
        return _open_animation(path)
    if suffix in VIDEO_SUFFIXES:
        return _open_video(path)
    if suffix in IMAGE_SUFFIXES:
        raise DataError(f"{path}: one image; expected its folder (a folder with a single image is a clip of one frame)")
    known = ", ".join((*VIDEO_SUFFIXES, *ANIMATION_SUFFIXES))
    raise DataError(f"{path}: unknown kind; expected a folder of images, or a file of {known}")


def image_paths(folder: Path) -> list[Path]:
    """Returns images directly in a folder, by the integers in their names that aren't the same in all, from left to
    right.
    """
    found = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
    found.sort(key=natural_key)
    columns = _telling_columns([path.stem for path in found])
    order = [tuple(numbers) for numbers in zip(*columns)]
    if found and len(set(order)) == len(found):
        return [path for _, path in sorted(zip(order, found))]
    return found


def frame_numbers(stems: Sequence[str]) -> list[int]:
    """Returns the integer of each name that tells frames apart: the last that differs between them and counts as they
    follow.

    `frame_0001`, `1_rgba`, `cam2_000_v1` all work; 0, 1, 2, ... where no integer alone does: names without any, or not
    equally many, or such as `1305031102.675304` (seconds, microseconds) and `12-59-58`, where the last one starts
    again.
    """
    columns = _telling_columns(stems)
    if len(columns) == 1:
        return columns[0]
    places = sorted(range(len(stems)), key=lambda k: tuple(column[k] for column in columns))
    for column in reversed(columns):
        if all(column[a] < column[b] for a, b in zip(places, places[1:])):
            return column
    ranks = {place: rank for rank, place in enumerate(places)}
    return [ranks[k] for k in range(len(stems))]


def _telling_columns(stems: Sequence[str]) -> list[list[int]]:
    """Returns the columns of integers in the names that aren't the same everywhere, or the last one if all are; []
    where names hold none, or not equally many.
    """
    rows = [[int(word) for word in re.findall(r"\d+", stem)] for stem in stems]
    if not rows or not rows[0] or len({len(row) for row in rows}) != 1:
        return []
    columns = [list(column) for column in zip(*rows)]
    return [column for column in columns if len(set(column)) > 1] or columns[-1:]


def _open_folder(folder: Path) -> Frames:
    paths = image_paths(folder)
    if not paths:
        inside = sorted(p.name for p in folder.iterdir() if p.is_dir())[:3]
        hint = f"; it has folders ({', '.join(inside)}): name one of them" if inside else ""
        raise DataError(f"{folder}: no frames; expected images ({', '.join(IMAGE_SUFFIXES)}){hint}")
    stems = [path.stem for path in paths]
    twins = sorted({stem for stem in stems if stems.count(stem) > 1})
    if twins:
        raise DataError(f"{folder}: {twins[0]!r} is there with two suffixes; leave one image per frame")
    return Frames(folder, tuple(p.name for p in paths), tuple(frame_numbers(stems)), tuple(paths))


def read_rgba(path: Path) -> np.ndarray:
    """Reads one image as u8 (H,W,4), straight alpha. Raises DataError when unreadable."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            return _to_rgba(image)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        why = "empty" if path.is_file() and path.stat().st_size == 0 else str(error).splitlines()[0]
        raise DataError(f"{path}: not a readable image ({why}); export this frame again") from None


def _to_rgba(image) -> np.ndarray:  # image: PIL.Image.Image
    if image.mode.startswith("I") or image.mode == "F":  # 16-bit gray: PIL would clip it at 255
        gray = np.asarray(image, np.float64)
        gray = np.clip(gray / (257.0 if gray.max(initial=0) > 255 else 1.0), 0, 255).round().astype(np.uint8)
        return np.dstack([gray, gray, gray, np.full_like(gray, 255)])
    return np.array(image.convert("RGBA"))


def _open_animation(path: Path) -> Frames:
    from PIL import Image

    try:
        with Image.open(path) as image:
            count, times, now = getattr(image, "n_frames", 1), [], 0.0
            for index in range(count):
                image.seek(index)
                image.load()
                times.append(now)
                now += max(float(image.info.get("duration", 0) or 0), 20.0) / 1000  # players show 0 as 20 ms or more
    except (OSError, ValueError, SyntaxError, EOFError) as error:
        raise DataError(f"{path}: not a readable animation ({error}); export it again") from None
    return Frames(path, _numbered(count), tuple(range(count)), (path,), tuple(times))


def _animation_frames(path: Path, wanted: Sequence[int]) -> Iterator[np.ndarray]:
    from PIL import Image

    with Image.open(path) as image:
        for index in wanted:
            image.seek(index)
            yield _to_rgba(image)


def _open_video(path: Path) -> Frames:
    cv2 = load_cv2()
    capture = open_video(path)
    try:
        rate, declared = float(capture.get(cv2.CAP_PROP_FPS)), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        stamps = []
        while capture.grab():
            stamps.append(capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
    finally:
        capture.release()
    count, steady = len(stamps), bool(np.isfinite(rate)) and 0 < rate < 10_000
    if count == 0:
        raise DataError(f"{path}: no frame can be decoded; the video is empty, truncated, or of an unknown codec")
    times = _frame_times(np.array(stamps), rate if steady else None)
    whole = path.suffix.lower() in _BY_DURATION and times is not None and _lasts(times, declared / rate)
    if declared > count + 1 and not whole:
        raise DataError(
            f"{path}: only {count} of its {declared} frames can be decoded; it is truncated or damaged: "
            "copy it again, or cut the good part out"
        )
    return Frames(
        path, _numbered(count), tuple(range(count)), (path,), None if times is None else tuple(times.tolist())
    )


def _frame_times(stamps: np.ndarray, rate: float | None) -> np.ndarray | None:
    """Returns seconds of a video's frames from its first: by its rate where that is what their time stamps say, else
    the stamps.

    Recordings of screens and phones have frames when something happens; their rate is a mean. Stamps are rounded to
    milliseconds in some containers and missing (0) in others.
    """
    steady = np.arange(len(stamps)) / rate if rate else None
    since = stamps - stamps[0]
    rising = len(stamps) > 1 and bool((np.diff(stamps) > 0).all()) and bool(np.isfinite(stamps).all())
    if not rising or (steady is not None and np.abs(since - steady).max() <= _STAMP_STEP):
        return steady
    return since


def _lasts(times: np.ndarray, duration: float) -> bool:
    """Returns whether frames at these times fill a clip that is said to last so long: the last one may stay for a
    while.
    """
    steps = np.diff(times)
    return len(steps) > 0 and duration - times[-1] <= max(2 * float(steps.max()), 0.1 * duration)


def _video_frames(path: Path, wanted: Sequence[int]) -> Iterator[np.ndarray]:
    """Decodes from the beginning: jumping to a frame of an inter-coded video isn't exact in every container."""
    cv2 = load_cv2()
    capture = open_video(path)
    try:
        at = -1
        for index in wanted:
            while at < index and capture.grab():
                at += 1
            ok, frame = capture.retrieve() if at == index else (False, None)
            if not ok:
                raise DataError(f"{path}: frame {index} cannot be decoded; copy the video again")
            if frame.dtype != np.uint8 or frame.ndim != 3:
                raise DataError(f"{path}: frame {index} is {frame.dtype} {frame.shape}; expected 8-bit color")
            yield cv2.cvtColor(frame, cv2.COLOR_BGR2RGBA)
    finally:
        capture.release()


def _numbered(count: int) -> tuple[str, ...]:
    return tuple(f"frame {index}" for index in range(count))
