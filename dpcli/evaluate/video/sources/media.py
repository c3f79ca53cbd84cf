"""Videos in files of other programs: folders of images, .npy arrays and video files."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.video.sources.source import Picture, Source, View
from dpcli.path_names import utf8_path

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
VIDEO_SUFFIXES = (".mp4", ".gif", ".webm", ".avi", ".mov", ".mkv")


class FolderSource(Source):
    """Reads a folder of images, frames ordered by the numbers in their names, or of such folders, one per view."""

    kind = "folder of images"

    def __init__(self, path: Path) -> None:
        self.path = path
        folders = {path: _images_in(path)} if _images_in(path) else {}
        for child in sorted((p for p in path.iterdir() if p.is_dir()), key=_numbers_in_name) if not folders else ():
            if _images_in(child):
                folders[child] = _images_in(child)
        if not folders:
            raise DataError(f"{path}: no images in it or in its folders ({', '.join(IMAGE_SUFFIXES)})")
        self.files = list(folders.values())
        self.views = [_view_of_folder("" if folder == path else folder.name) for folder in folders]
        self.frames = [len(files) for files in self.files]
        self.has_alpha = _read_image(self.files[0][0])[1]

    def pictures(self, view: int, frames: Sequence[int]) -> Iterator[Picture]:
        """Yields the frames of a view, in rising order."""
        for frame in frames:
            yield Picture(rgba=_read_image(self.files[view][frame])[0])


def _images_in(folder: Path) -> list[Path]:
    return sorted((p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES), key=_numbers_in_name)


def _numbers_in_name(path: Path) -> tuple:
    return [int(number) for number in re.findall(r"\d+", path.stem)], path.name


def _view_of_folder(name: str) -> View:
    """Returns the view that a folder's name stands for.

    `2`, `view_2`, `cam-02`: view 2 of a views file; `reference`, `ref`, `input`, or one folder alone: the reference.
    """
    if name.lower() in ("", "reference", "ref", "input"):
        return View(tuple(dict.fromkeys([name.lower() or "reference", "reference"])), "reference")
    number = re.fullmatch(r"(?:view|cam|camera)?[-_]?(\d+)", name.lower())
    return View((name, *([str(int(number[1]))] if number and number[1] != name else ())), "test")


def _read_image(path: Path) -> tuple[np.ndarray, bool]:
    """Returns rgba u8 (H,W,4), and whether the file has an alpha channel. DataError when unreadable or not 8-bit color."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            if image.mode.startswith(("I", "F")):
                raise DataError(f"{path}: pixels of type {image.mode}; expected an 8-bit color picture")
            has_alpha = "A" in image.getbands() or "transparency" in image.info
            return np.asarray(image.convert("RGBA")), has_alpha
    except (OSError, SyntaxError, ValueError) as error:
        raise DataError(f"{path}: not a readable image ({error}); make it again") from None


class ArraySource(Source):
    """Reads an .npy array (T,H,W,C) or (V,T,H,W,C), C 3 or 4 (straight alpha): uint8, or floats in 0..1."""

    kind = "array"

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            array = np.load(path, mmap_mode="r", allow_pickle=False)
        except (ValueError, OSError, EOFError) as error:
            raise DataError(f"{path}: not a readable .npy array ({error})") from None
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
        """Yields the frames of a view, in rising order."""
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
            with np.errstate(invalid="ignore"):  # NaN is found, and said, by whoever compares
                colored = values[..., :3] * values[..., 3:]
            yield Picture(values=np.concatenate([colored, values[..., 3:]], -1, dtype=np.float32))


class VideoSource(Source):
    """Reads a video file: one opaque view, decoded as it is read."""

    kind, has_alpha = "video file", False

    def __init__(self, path: Path) -> None:
        self.path = path
        capture = self._open()
        count = 0
        while capture.grab():  # what a container declares is often wrong
            count += 1
        capture.release()
        if not count:
            raise DataError(f"{path}: not a readable video (empty, damaged, or of an unknown codec)")
        self.views, self.frames = [_view_of_folder("")], [count]

    def _open(self):  # -> cv2.VideoCapture
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        import cv2

        return cv2.VideoCapture(utf8_path(self.path, "OpenCV"))

    def pictures(self, view: int, frames: Sequence[int]) -> Iterator[Picture]:
        """Yields the frames of a view, in rising order."""
        capture, asked = self._open(), set(frames)
        for frame in range(max(asked, default=-1) + 1):
            good, image = capture.read()
            if not good:
                raise DataError(f"{self.path}: frame {frame} cannot be decoded; make the file again")
            if frame in asked:
                rgba = np.full((*image.shape[:2], 4), 255, np.uint8)
                rgba[..., :3] = image[..., ::-1]
                yield Picture(rgba=rgba)
        capture.release()
