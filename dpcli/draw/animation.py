"""Writing pictures one after the other: as a video (.mp4), an animation (.gif), a picture (.png) or a folder."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dpcli.errors import DataError, DpcError, UsageError
from dpcli.path_names import frame_names, utf8_path
from dpcli.runtime.progress import log
from dpcli.runtime.whole_file import check_replaced, not_writable, refuse_broken_link, refuse_replacing, whole_file

if TYPE_CHECKING:
    from PIL import Image

KINDS = (".mp4", ".gif", ".png")
_X264 = ("-crf", "18", "-preset", "veryfast", "-threads", "2", "-movflags", "+faststart")  # crf 18: visually lossless
# Browsers take videos that lack any of the tags for BT.601 or BT.709 by their size, while FFmpeg converts by BT.601. Newer
# FFmpegs tag a video as its frames are tagged, whatever options say: so a filter tags them.
_BT709 = (
    *(
        "-vf",
        "scale=out_color_matrix=bt709:out_range=tv,setparams=range=tv:color_primaries=bt709:color_trc=bt709:colorspace=bt709",
    ),
    *("-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709", "-color_range", "tv"),
)
_ROOM = 64 << 10  # bytes: with less a disk counts as full, as encoders write whole buffers
_COLORS = 255  # of an animation
_GIF_RATE = 50
_PALETTE_FRAMES = 5  # pictures, about, that an animation's colors are chosen from


def output_kind(path: Path) -> str:
    """Returns .mp4, .gif, .png, or "" for a folder. Raises UsageError for anything else.

    >>> output_kind(Path("turn.GIF")), output_kind(Path("frames"))
    ('.gif', '')
    """
    kind = path.suffix.lower()
    if kind and kind not in KINDS and not path.is_dir():
        raise UsageError(f"-o {path}: expected a name that ends in {', '.join(KINDS)}, or a folder for pictures")
    return kind if kind in KINDS else ""


def write_pictures(path: Path, pictures: Iterable[np.ndarray], fps: float, *, force: bool = False) -> None:
    """Writes u8 pictures (H,W,3), or (H,W,4) for .png and folders, all of one size, to what the name says.

    A .png takes the first one. Nothing half-written stays under the name. Raises UsageError when it exists and `force` is off.
    """
    kind = output_kind(path)
    refuse_replacing(path, force)
    if not kind:
        refuse_broken_link(path)
    check_replaced(path, ("[0-9]*.png",))
    if not path.parent.is_dir():
        raise DataError(f"{path}: the folder {path.parent} does not exist; create it first")
    try:
        with whole_file(path) as part:
            if kind:
                _try_name(path, part)
            {".mp4": _mp4, ".gif": _gif, ".png": _png, "": _folder}[kind](part, pictures, fps)
    except OSError as error:
        raise not_writable(path, error) from None


def _try_name(path: Path, part: Path) -> None:
    """Raises DataError, before any picture is drawn, where no file can be made: an encoder doesn't tell why it ends."""
    try:
        part.touch()
        part.unlink()
    except OSError as error:
        raise not_writable(path, error) from None


def _mp4(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    try:
        import imageio_ffmpeg
    except ImportError:
        _mp4_by_opencv(path, pictures, fps)
        return
    frames = map(_even, pictures)
    for first in frames:
        writer = imageio_ffmpeg.write_frames(
            str(path),
            first.shape[1::-1],
            fps=fps,
            codec="libx264",
            pix_fmt_out="yuv420p",
            macro_block_size=1,
            quality=None,
            output_params=[*_X264, *_BT709],
            ffmpeg_log_level="error",
        )
        with _telling(path), closing(writer):  # ends the encoder, also where a picture fails
            writer.send(None)
            for picture in chain([first], frames):
                writer.send(np.ascontiguousarray(picture))
    if not path.exists():
        raise DpcError("the video encoder wrote nothing; a .gif or a folder of pictures needs no encoder")
    _refuse_incomplete(path)


def _refuse_incomplete(path: Path) -> None:
    """Raises OSError where the last bytes of a video found no room, which an encoder that is asked to end does not tell."""
    names, place, size = set(), 0, path.stat().st_size
    with open(path, "rb") as file:
        while place + 8 <= size:
            file.seek(place)
            head = file.read(16)
            length = int.from_bytes(head[:4], "big")
            length = int.from_bytes(head[8:], "big") if length == 1 else length
            names.add(head[4:8])
            if length < 8:
                break
            place += length
    if place == size and {b"moov", b"mdat"} <= names:
        return
    with _telling(path), open(path, "ab") as file:
        file.write(bytes(_ROOM))  # the system says why
    raise OSError("the video encoder ended early: the file is incomplete")


@contextmanager
def _telling(path: Path) -> Iterator[None]:
    """Says why an encoder ended early, which itself says it with its whole command line, or not at all."""
    try:
        yield
    except OSError as error:
        if shutil.disk_usage(path.parent).free < _ROOM:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from error
        raise OSError(f"the video encoder ended early: {(str(error).splitlines() or [''])[0]}") from error


def _mp4_by_opencv(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    """Writes MPEG-4 part 2, which players read and browsers don't: OpenCV alone can write no other."""
    import cv2

    log.warn("mp4 without H.264, so browsers may not play it; pip install imageio-ffmpeg")
    writer, name = None, utf8_path(path, "OpenCV")
    for picture in map(_even, pictures):
        writer = writer or cv2.VideoWriter(name, cv2.VideoWriter_fourcc(*"mp4v"), fps, picture.shape[1::-1])
        writer.write(picture[..., ::-1])
    if writer is not None:
        writer.release()
        _refuse_incomplete(path)


def _even(picture: np.ndarray) -> np.ndarray:
    """Repeats the last column and row where width and height are odd: H.264's 4:2:0 needs even ones."""
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _gif(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    whole = list(pictures)
    table = _color_table(np.concatenate(whole[:: max(1, len(whole) // (_PALETTE_FRAMES - 1))], axis=1))
    images = [_numbered(picture, table) for picture in whole]
    # GIF counts in hundredths of a second, and players slow down below two
    ends = np.arange(len(images) + 1) * max(2.0, 100 / fps)
    pauses = (np.diff(np.rint(ends)) * 10).astype(int).tolist()
    if fps > _GIF_RATE:
        log.warn(
            f"an animation shows at most {_GIF_RATE} pictures a second: it takes {fps / _GIF_RATE:.3g} times as long"
        )
    images[0].save(path, save_all=True, append_images=images[1:], duration=pauses, loop=0, disposal=1)


def _color_table(picture: np.ndarray) -> Image.Image:
    """Returns a palette for all pictures, so that nothing flickers; it has the most frequent color, mostly the ground, exactly."""
    from PIL import Image

    packed = picture[..., 0].astype(np.int32) << 16 | picture[..., 1].astype(np.int32) << 8 | picture[..., 2]
    values, counts = np.unique(packed, return_counts=True)
    frequent = int(values[counts.argmax()])
    colors = Image.fromarray(picture).quantize(_COLORS).getpalette()
    table = Image.new("P", (1, 1))
    table.putpalette([*colors[: 3 * _COLORS], frequent >> 16, frequent >> 8 & 255, frequent & 255])
    return table


def _numbered(picture: np.ndarray, table: Image.Image) -> Image.Image:
    """Returns a picture in the colors of a table, the table's last color exactly: Pillow gives colors that differ in their last
    two bits one number, so that white is 252 where the table has such a gray.
    """
    from PIL import Image

    numbers = Image.fromarray(picture).quantize(palette=table, dither=Image.Dither.NONE)
    colors = np.array(table.getpalette(), np.uint8).reshape(-1, 3)
    numbers.paste(len(colors) - 1, mask=Image.fromarray((picture == colors[-1]).all(-1)))
    return numbers


def _png(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    from PIL import Image

    Image.fromarray(next(iter(pictures))).save(path)


def _folder(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    from PIL import Image

    path.mkdir()
    paths = []
    for number, picture in enumerate(pictures):
        paths.append(path / f"{number:04d}.png")
        Image.fromarray(picture).save(paths[-1])
    for one, name in zip(paths, frame_names(range(len(paths)), ".png")):  # known only now that all are drawn
        if one.name != name:
            one.rename(path / name)
