"""Videos in files of other programs: folders of images, .npy arrays and video files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unicodedata import normalize

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.video.sources.source import Picture, Source, View
from dpcli.npy_files import map_npy
from dpcli.path_names import first_names
from dpcli.runtime.clips.animations import animation_frames, animation_times, is_image_file
from dpcli.runtime.clips.clip_folders import clips_in, refuse_clips
from dpcli.runtime.clips.images import (
    IMAGE_SUFFIXES,
    as_shown,
    one_series,
    open_image,
    refuse_twins,
    require_one_picture,
)
from dpcli.runtime.clips.name_numbers import in_order
from dpcli.runtime.clips.video_frames import look_at_video, video_frames
from dpcli.runtime.progress import log

_BELOW = -0.1  # of floats in 0..1: an overshoot is no lower, and where black is -1 dark pixels are
_ALL = "compare all with those of the same names in a folder TRUTH"


class FolderSource(Source):
    """Reads a folder of images, frames ordered by the numbers in their names, or of such folders, one per view."""

    kind = "folder of images"

    def __init__(self, path: Path) -> None:
        self.path = path
        own = _images_in(path)
        folders = {path: own} if own else {}
        if own and (clips := clips_in(path)):
            log.info(f"{path}: its images are compared; left out: {first_names(clips)}")
        for child in sorted((p for p in path.iterdir() if p.is_dir()), key=_numbers_in_name) if not folders else ():
            if inside := _images_in(child):
                folders[child] = inside
        if not folders:
            refuse_clips(path, _ALL, 'dpc evaluate video "$clip" --truth TRUTH/"$(basename "$clip")"')
            raise DataError(f"{path}: no images in it or in its folders ({', '.join(IMAGE_SUFFIXES)})")
        self.files = list(folders.values())
        self.views = [_view_of_folder("" if folder == path else folder.name) for folder in folders]
        self.frames = [len(files) for files in self.files]
        self.numbers = [_counted(files) for files in self.files]
        self.has_alpha = any(_has_alpha(file) for files in self.files for file in files)

    def pictures(self, view: int, frames: Sequence[int]) -> Iterator[Picture]:
        for frame in frames:
            yield Picture(rgba=_read_image(self.files[view][frame]))


def _images_in(folder: Path) -> list[Path]:
    found = (p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))
    images = one_series(folder, in_order(sorted(found, key=_numbers_in_name)))
    refuse_twins(folder, images, "move those of one kind into a folder of their own")
    return images


def _numbers_in_name(path: Path) -> tuple:
    return [int(number) for number in re.findall(r"\d+", path.stem)], path.name


def _counted(files: Sequence[Path]) -> list[int] | None:
    """Returns the only number that differs among the names of files, of each; None where several do, or none."""
    rows = [_numbers_in_name(file)[0] for file in files]
    if len({len(row) for row in rows}) != 1:
        return None
    varying = [list(column) for column in zip(*rows) if len(set(column)) > 1]
    return varying[0] if len(varying) == 1 else None


def _view_of_folder(name: str) -> View:
    """Returns the view that a folder's name stands for.

    `2`, `view_2`, `cam-02`: view 2 of a views file; `reference`, `ref`, `input`, or one folder alone: the reference.
    """
    name = normalize("NFC", name)  # macOS takes letters and their accents apart
    if name.lower() in ("", "reference", "ref", "input"):
        return View(tuple(dict.fromkeys([name.lower() or "reference", "reference"])), "reference")
    number = re.fullmatch(r"(?:view|cam|camera)?[-_]?(\d+)", name.lower())
    return View((name, *([str(int(number[1]))] if number and str(int(number[1])) != name else ())), "test")


def _has_alpha(path: Path) -> bool:
    with _opened(path) as image:
        return not {"A", "a"}.isdisjoint(image.getbands()) or "transparency" in image.info


def _read_image(path: Path) -> np.ndarray:
    """Returns rgba u8 (H,W,4). Raises DataError if unreadable or not 8-bit color."""
    with _opened(path) as image:
        return np.asarray(as_shown(image).convert("RGBA"))


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        with open_image(path) as image:
            require_one_picture(path, image)
            if image.mode.startswith(("I", "F")):
                raise DataError(f"{path}: pixels of type {image.mode}; expected an 8-bit color picture")
            yield image
    except DataError:
        raise
    except Exception as error:  # a damaged image raises nearly anything, and one of a vast size DecompressionBombError
        raise DataError(f"{path}: not a readable image ({error}); make it again") from None


class ArraySource(Source):
    """Reads an .npy array (T,H,W,C) or (V,T,H,W,C), C 3 or 4 (straight alpha): uint8, or floats in 0..1."""

    kind = "array"

    def __init__(self, path: Path) -> None:
        self.path = path
        array = map_npy(path)
        array = array[None] if array.ndim == 4 else array
        known = array.dtype == np.uint8 or array.dtype.kind == "f"
        if array.ndim != 5 or array.shape[-1] not in (3, 4) or not known or array.size == 0:
            raise DataError(
                f"{path}: {array.dtype} {array.shape}; expected uint8, or floats in 0..1, of shape "
                "([views,] frames, height, width, 3 or 4)"
            )
        self.array, count = array, len(array)
        self.views = [_view_of_folder("" if count == 1 else str(index)) for index in range(count)]
        self.frames = [array.shape[1]] * count
        self.has_alpha = array.shape[-1] == 4

    def pictures(self, view: int, frames: Sequence[int]) -> Iterator[Picture]:
        for frame in frames:
            values = np.array(self.array[view, frame])
            if values.shape[-1] == 3:
                opaque = np.full((*values.shape[:2], 1), 255 if values.dtype == np.uint8 else 1, values.dtype)
                values = np.concatenate([values, opaque], -1)
            if values.dtype == np.uint8:
                yield Picture(rgba=values)
                continue
            largest = float(np.nanmax(values, initial=0))
            if 1.5 < largest < np.inf:
                raise DataError(
                    f"{self.path}: frame {frame} has values up to {largest:g}; floats are taken as 0..1: "
                    "divide by 255, or store them as uint8"
                )
            smallest = float(np.nanmin(values[..., :3], initial=0))
            if -np.inf < smallest < _BELOW:
                raise DataError(
                    f"{self.path}: frame {frame} has values down to {smallest:g}; floats are taken as 0..1: of -1..1 save "
                    "(x + 1) / 2"
                )
            with np.errstate(invalid="ignore"):  # the comparison finds and reports NaN
                colored = values[..., :3] * values[..., 3:]
            yield Picture(values=np.concatenate([colored, values[..., 3:]], -1, dtype=np.float32))


class VideoSource(Source):
    """Reads a video file or an animated image: one view, decoded as it is read, with the alpha that it has."""

    kind = "video file"

    def __init__(self, path: Path) -> None:
        self.path, self.animated = path, is_image_file(path)
        if self.animated:
            times = animation_times(path)
            count = len(times)
            self.has_alpha = any((frame[..., 3] < 255).any() for frame in animation_frames(path, range(count)))
        else:
            look = look_at_video(path)
            count, times, self.has_alpha = look.count, look.times, look.has_alpha
        self.times = times
        self.views, self.frames = [_view_of_folder("")], [count]

    def pictures(self, view: int, frames: Sequence[int]) -> Iterator[Picture]:
        read = animation_frames if self.animated else video_frames
        yield from (Picture(rgba=rgba) for rgba in read(self.path, frames))
