"""Animated images: GIF, APNG, WebP and AVIF, whatever their file is called, decoded one frame at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, reading
from dpcli.runtime.clips.apng_pictures import apng_canvases, apng_seconds, is_animated_png
from dpcli.runtime.clips.container_ends import pictures_in
from dpcli.runtime.clips.gif_pictures import check_canvas, gif_canvases
from dpcli.runtime.clips.images import ORIENTATION, as_shown, open_image
from dpcli.runtime.progress import log

_MANY_JPEGS = (".mjpg", ".mjpeg")  # JPEG images one after the other, which are a video
_SHORTEST, _INSTEAD = 10.0, 100.0  # ms: what is shown so long or less browsers show for a tenth of a second


def is_image_file(path: Path) -> bool:
    """Returns whether a file begins as an image does that may be animated (GIF, PNG, WebP, AVIF), or as JPEG, BMP or TIFF."""
    with open(path, "rb") as file:
        start = file.read(16)
    if start[4:8] == b"ftyp":
        return start[8:12] in (b"avif", b"avis")
    if start[:4] == b"RIFF":
        return start[8:12] == b"WEBP"
    if path.suffix.lower() in _MANY_JPEGS:
        return False
    return start.startswith((b"GIF8", b"\x89PNG", b"\xff\xd8\xff", b"BM", b"II*\0", b"MM\0*"))


def animation_times(path: Path) -> tuple[float, ...]:
    """Returns the seconds at which each frame appears, from 0. Raises DataError when the file is damaged or one image."""
    times, now = [], 0.0
    try:
        with open_image(path) as image:
            if image.format == "GIF":
                check_canvas(path, image.width * image.height, path.stat().st_size)
            for duration in _durations(path, image):
                times.append(now)
                now += (duration if duration > _SHORTEST else _INSTEAD) / 1000
            moves, form = image.format in ("GIF", "PNG", "WEBP", "AVIF"), image.format
    except DataError:
        raise
    except Exception as error:  # a damaged file raises nearly anything
        raise DataError(f"{path}: not a readable animation ({error}); export it again") from None
    if len(times) > 1 and form == "TIFF":
        raise DataError(f"{path}: {len(times)} pages without times; write each as an image into a folder")
    if len(times) == 1 and path.suffix.lower() not in (".gif", ".apng") or not moves:
        raise DataError(f"{path}: one image; expected its folder (a folder with a single image is a clip of one frame)")
    if (behind := pictures_in(path) - len(times)) > 0:
        log.warn(f"{path}: {counted(behind, 'picture')} behind the {len(times)} that its header counts: left out")
    return tuple(times)


def _durations(path: Path, image) -> Iterator[float]:  # image: PIL.Image.Image
    """Yields the milliseconds that each frame lasts. Raises nearly anything at one that is damaged."""
    if image.format == "PNG" and is_animated_png(path.read_bytes()):
        seconds = apng_seconds(path)
        yield from (1000 * one for one, _ in zip(seconds, apng_canvases(path, *image.size), strict=True))
        return
    lasting, stamps = [], []
    for index in range(getattr(image, "n_frames", 1)):
        image.seek(index)
        image.load()
        lasting.append(float(image.info.get("duration", 0) or 0))
        stamps.append(image.info.get("timestamp", 0))
    if image.format == "AVIF":  # Pillow rounds each to milliseconds; of durations the errors would add up
        lasting[:-1] = (float(after - before) for before, after in pairwise(stamps))
    yield from lasting


def animation_frames(path: Path, wanted: Sequence[int]) -> Iterator[np.ndarray]:
    """Yields frames by rising index, each u8 (H,W,4) with straight alpha.

    Pillow lays the pictures of neither a PNG nor a GIF over one another as browsers do.
    """
    from PIL import Image

    with reading(path), open_image(path) as image:
        info, orientation = dict(image.info), 1
        laid = gif_canvases if image.format == "GIF" else None
        if image.format == "PNG" and is_animated_png(path.read_bytes()):
            laid, orientation = apng_canvases, image.getexif().get(ORIENTATION, 1)
        if laid:
            canvases = enumerate(laid(path, *image.size))
            for index in wanted:
                shown = next(canvas for at, canvas in canvases if at == index)
                picture = Image.fromarray(shown)
                picture.getexif()[ORIENTATION] = orientation
                yield np.array(as_shown(picture, info))
            return
        for index in wanted:
            image.seek(index)
            yield np.array(as_shown(image, image.info | info).convert("RGBA"))
