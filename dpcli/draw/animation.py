"""Pictures out, one at a time: a video (.mp4), an animation (.gif), a picture (.png) or a folder of pictures."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError, DpcError, UsageError
from dpcli.path_names import utf8_path
from dpcli.runtime.progress import log
from dpcli.runtime.whole_file import check_replaced, whole_file

KINDS = (".mp4", ".gif", ".png")
_QUALITY = 18  # x264's constant rate factor: visually lossless


def output_kind(path: Path) -> str:
    """.mp4, .gif, .png, or "" for a folder; UsageError for anything else."""
    kind = path.suffix.lower()
    if kind and kind not in KINDS and not path.is_dir():
        raise UsageError(f"-o {path}: expected a name that ends in {', '.join(KINDS)}, or a folder for pictures")
    return kind if kind in KINDS else ""


def write_pictures(path: Path, pictures: Iterable[np.ndarray], fps: float, *, force: bool = False) -> None:
    """Write u8 pictures (H,W,3), or (H,W,4) for .png and folders, all of one size, to what the name says.

    A .png takes the first one. Nothing half-written stays under the name. UsageError when it exists and `force` is off.
    """
    kind = output_kind(path)
    if path.exists() and not force:
        raise UsageError(f"{path}: exists already; --force replaces it")
    check_replaced(path, ("[0-9]*.png",))
    if not path.parent.is_dir():
        raise DataError(f"{path}: the folder {path.parent} does not exist; create it first")
    try:
        with whole_file(path) as part:
            {".mp4": _mp4, ".gif": _gif, ".png": _png, "": _folder}[kind](part, pictures, fps)
    except OSError as error:
        raise DpcError(f"{path}: cannot be written ({error})") from None


def _mp4(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    try:
        import imageio_ffmpeg
    except ImportError:
        _mp4_by_opencv(path, pictures, fps)
        return
    writer: Any = None
    for picture in map(_even, pictures):
        if writer is None:
            size = picture.shape[1::-1]
            writer = imageio_ffmpeg.write_frames(
                str(path),
                size,
                fps=fps,
                codec="libx264",
                pix_fmt_out="yuv420p",
                macro_block_size=1,
                quality=None,
                output_params=[
                    "-crf",
                    str(_QUALITY),
                    "-preset",
                    "veryfast",
                    "-threads",
                    "2",
                    "-movflags",
                    "+faststart",
                ],
                ffmpeg_log_level="error",
            )
            writer.send(None)
        writer.send(np.ascontiguousarray(picture))
    if writer is not None:
        writer.close()
    if not path.exists():
        raise DpcError("the video encoder wrote nothing; a .gif or a folder of pictures needs no encoder")


def _mp4_by_opencv(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    """MPEG-4 part 2, which players read and browsers don't: what OpenCV alone can write."""
    import cv2

    log.warn("mp4 without H.264, so browsers may not play it; pip install imageio-ffmpeg")
    writer, name = None, utf8_path(path, "OpenCV")
    for picture in map(_even, pictures):
        writer = writer or cv2.VideoWriter(name, cv2.VideoWriter_fourcc(*"mp4v"), fps, picture.shape[1::-1])
        writer.write(picture[..., ::-1])
    if writer is not None:
        writer.release()


def _even(picture: np.ndarray) -> np.ndarray:
    """Even width and height, as H.264's 4:2:0 needs: the last column and row are repeated."""
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _gif(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    from PIL import Image

    images = [Image.fromarray(picture).quantize(128) for picture in pictures]
    pause = max(2, round(100 / fps)) * 10  # milliseconds; GIF counts in hundredths and players slow down below two
    images[0].save(path, save_all=True, append_images=images[1:], duration=pause, loop=0, disposal=1)


def _png(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    from PIL import Image

    Image.fromarray(next(iter(pictures))).save(path)


def _folder(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    from PIL import Image

    path.mkdir()
    for number, picture in enumerate(pictures):
        Image.fromarray(picture).save(path / f"{number:04d}.png")
