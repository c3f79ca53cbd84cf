"""Decoding depth videos (8 or 16 bits), folders of images and NumPy arrays; frames come out as stored."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.path_names import utf8_path
from dpcli.prepare.decode.cv2_import import load_cv2
from dpcli.prepare.decode.png import decode_gray_png
from dpcli.prepare.reader import natural_key

VIDEO_SUFFIXES = (".avi", ".mp4", ".mkv", ".mov")
IMAGE_SUFFIXES = (".png", ".tif", ".tiff", ".pgm")
_GRAY_NOISE, _COLORED_SHARE = (
    24,
    0.02,
)  # levels between channels, and share of pixels beyond: a color map has most of them
_GRAY16 = 0x10003159  # what OpenCV calls the pixel format gray16le


@dataclass
class DepthVideo:
    """Holds raw frames (T,H,W) u8, u16, or float, and the frame rate its file declares (None = says nothing)."""

    frames: np.ndarray
    fps: float | None = None


def open_video(path: Path):  # -> cv2.VideoCapture
    """Opens an OpenCV capture that yields 16-bit gray frames unharmed and 8-bit ones expanded to the full range."""
    if not path.is_file():
        raise DataError(f"{path}: no such video")
    cv2, name = load_cv2(), utf8_path(path, "OpenCV")
    # frame threads cost a quarter more processor time, and the cores are busy with other videos
    single = [cv2.CAP_PROP_N_THREADS, 1]
    capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG, single)
    # the default conversion of 16-bit frames to 8-bit BGR would cut the lower byte off
    if capture.isOpened() and int(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)) == _GRAY16:
        if not capture.set(cv2.CAP_PROP_CONVERT_RGB, 0):  # an OpenCV that takes it at the opening only
            capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG, [*single, cv2.CAP_PROP_CONVERT_RGB, 0])
    if not capture.isOpened():
        raise DataError(f"{path}: not a readable video (empty, truncated, or of an unknown codec)")
    return capture


def video_frames(path: Path, start: int = 0, stop: int | None = None, stride: int = 1) -> Iterator[np.ndarray]:
    """Yields frames start, start + stride, ... before ``stop``, each (H,W) u8 or u16; ends early where the file ends.

    Decodes from the beginning: jumping to a frame of an inter-coded video isn't exact in every container.
    """
    capture = open_video(path)
    try:
        yield from _decoded(capture, path, start, stop, stride)
    finally:
        capture.release()


def read_video(
    path: Path, start: int = 0, stop: int | None = None, stride: int = 1
) -> tuple[list[np.ndarray], float | None]:
    """Returns what `video_frames` yields, and the frames per second that the file declares (None = says nothing)."""
    import cv2

    capture = open_video(path)
    try:
        rate = float(capture.get(cv2.CAP_PROP_FPS))
        frames = list(_decoded(capture, path, start, stop, stride))
    finally:
        capture.release()
    return frames, rate if np.isfinite(rate) and 0 < rate < 10_000 else None


def _decoded(capture, path: Path, start: int, stop: int | None, stride: int) -> Iterator[np.ndarray]:
    index = 0
    while (stop is None or index < stop) and capture.grab():
        if index >= start and (index - start) % stride == 0:
            ok, frame = capture.retrieve()
            if not ok:
                raise DataError(f"{path}: frame {index} cannot be decoded")
            if frame.ndim == 3 and _colored(frame):
                raise DataError(
                    f"{path}: frame {index} is colored; expected a depth video whose gray is the depth, not a picture of it"
                )
            yield np.ascontiguousarray(frame[..., 0]) if frame.ndim == 3 else frame  # strided, all after is slower
        index += 1


def _colored(frame: np.ndarray) -> bool:
    """Returns whether a decoded frame (H,W,3) u8 has colors, beyond what lossy codecs make of gray; looks at some of
    its pixels.
    """
    some = frame[::8, ::8].astype(np.int16)
    return bool((np.ptp(some, axis=2) > _GRAY_NOISE).mean() > _COLORED_SHARE)


def read_image(path: Path) -> np.ndarray:
    """Reads one gray depth image (H,W) u8, u16 or f32. Raises DataError when unreadable or colored."""
    data = path.read_bytes()
    image = decode_gray_png(data)
    if image is not None:
        return image
    cv2 = load_cv2()
    pages = cv2.imdecodemulti(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)[1] if data else ()
    if not pages:
        raise DataError(f"{path}: not a readable image (empty, truncated, or not an image)")
    if len(pages) > 1:  # which of them is the frame?
        raise DataError(
            f"{path}: holds {len(pages)} pages; expected one depth image a file: save each page as its own file"
        )
    image = pages[0]
    if image.ndim == 3:
        if image.shape[2] != 3 or (image != image[..., :1]).any():
            raise DataError(f"{path}: a color image of shape {image.shape}; expected one gray channel of depth")
        image = image[..., 0]
    return image


def read_image_folder(folder: Path, stride: int = 1) -> np.ndarray:
    """Reads the images of a folder in natural order as (T,H,W). Raises DataError when sizes or types differ."""
    paths = image_paths(folder)[::stride]
    if not paths:
        raise DataError(f"{folder}: no depth images ({', '.join(IMAGE_SUFFIXES)})")
    first = read_image(paths[0])
    frames = np.empty((len(paths), *first.shape), first.dtype)
    frames[0] = first
    for index, path in enumerate(paths[1:], start=1):
        frame = read_image(path)
        if (frame.shape, frame.dtype) != (first.shape, first.dtype):
            size = f"{first.shape[1]}x{first.shape[0]} {first.dtype}"
            raise DataError(f"{path}: {frame.shape[1]}x{frame.shape[0]} {frame.dtype}; the first image is {size}")
        frames[index] = frame  # while it is in the cache
    return frames


def has_images(folder: Path) -> bool:
    """Returns whether `image_paths` finds any, without asking for all."""
    with os.scandir(folder) as entries:
        return any(entry.name.lower().endswith(IMAGE_SUFFIXES) for entry in entries)


def image_paths(folder: Path) -> list[Path]:
    """Returns image files directly in a folder, in natural order."""
    return sorted((p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES), key=natural_key)


def read_array(path: Path, stride: int = 1) -> np.ndarray:
    """Reads a ``.npy`` of depth frames (T,H,W), or one frame (H,W), memory-mapped so that a stride reads less."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise DataError(f"{path}: not a readable .npy array ({error})") from None
    if array.ndim == 2:
        array = array[None]
    if array.ndim != 3 or array.dtype.kind not in "uif":
        raise DataError(
            f"{path}: array of shape {array.shape}, {array.dtype}; expected numbers (frames, height, width)"
        )
    return np.ascontiguousarray(array[::stride])


def read_depth_video(path: Path, stride: int = 1) -> DepthVideo:
    """Reads any depth video: a video file, an ``.npy``, or a folder of images. ``stride`` keeps every n-th frame."""
    suffix = path.suffix.lower()
    if path.is_dir():
        video = DepthVideo(read_image_folder(path, stride))
    elif suffix == ".npy":
        video = DepthVideo(read_array(path, stride))
    elif suffix in VIDEO_SUFFIXES:
        frames, rate = read_video(path, stride=stride)
        if not frames:
            raise DataError(f"{path}: an empty video: no frame can be decoded")
        video = DepthVideo(np.stack(frames), rate)
    else:
        raise DataError(f"{path}: unknown kind; expected a folder of images, .npy or {', '.join(VIDEO_SUFFIXES)}")
    if video.frames.size == 0:
        raise DataError(f"{path}: an empty video: shape {video.frames.shape}")
    return video
