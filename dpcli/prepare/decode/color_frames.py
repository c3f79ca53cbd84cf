"""Color frames of a clip, decoded one at a time: a folder of images in any peer's naming, a video file or a GIF."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dpcli.errors import DataError, UsageError, first_line
from dpcli.path_names import first_names
from dpcli.prepare.decode.pictures.tiff import BITS, COMPRESSION
from dpcli.prepare.reader import natural_key
from dpcli.prepare.series import Series, about_series, choose_series
from dpcli.prepare.times_beside import with_times
from dpcli.runtime.clips.animations import animation_frames, animation_times, is_image_file
from dpcli.runtime.clips.clip_folders import clips_in, refuse_clips
from dpcli.runtime.clips.images import (
    IMAGE_SUFFIXES,
    ORIENTATION,
    as_shown,
    one_series,
    open_image,
    refuse_twins,
    require_one_picture,
)
from dpcli.runtime.clips.name_numbers import in_order
from dpcli.runtime.clips.other_files import no_video
from dpcli.runtime.clips.video_frames import look_at_video, video_frames
from dpcli.runtime.progress import log

_SAID: set[str] = set()
PICTURE_FOLDERS = set("ref rgba rgb images image img imgs frames color".split())  # names that say nothing else
_ALL = "take all, each into a file of its own"
FOLDER_FPS = 16.0  # 32 frames in 2 seconds: how the usual test clips were sampled


@dataclass(frozen=True)
class Frames:
    """Holds the frames of a clip. `names` are for messages; `numbers` the integers in the names (or 0, 1, ...).

    times: f64 (T) seconds as the file, the names or a text beside them tell, None when nothing does.
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
        return (animation_frames if is_image_file(self.path) else video_frames)(self.path, wanted)


def open_frames(path: Path, pattern: str = "", *, quiet: bool = False) -> Frames:
    """Opens the frames of a folder, video or GIF; pattern: which images of a folder are frames; quiet: what else lies there
    is not told.

    Raises DataError when there are none or they cannot be decoded, UsageError at a pattern for what is no folder.
    """
    if path.is_dir():
        return _open_folder(path, pattern, quiet)
    if pattern and path.exists():
        raise UsageError(f"--pattern {pattern}: chooses among the images of a folder; {path} is a file")
    if not path.is_file():
        raise DataError(
            f"{path}: no such file or folder; expected frames: a folder of images, a video or an animated image"
        )
    return _open_animation(path) if is_image_file(path) else _open_video(path)


def image_paths(folder: Path) -> list[Path]:
    """Returns images directly in a folder, by the numbers in their names, from left to right: fractions and dates as such
    where most are named alike, else the integers that aren't the same in all.
    """
    found = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
    found.sort(key=natural_key)
    columns = _telling_columns([path.stem for path in found])
    order = [tuple(numbers) for numbers in zip(*columns)]
    if found and len(set(order)) == len(found):
        found = [path for _, path in sorted(zip(order, found))]
    return in_order(found)


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


def integers(name: str) -> list[int]:
    """Returns the integers in a name, from left to right.

    >>> integers("cam2_007.png")
    [2, 7]
    """
    return [int(word) for word in re.findall(r"\d+", name)]


def _telling_columns(stems: Sequence[str]) -> list[list[int]]:
    """Returns the columns of integers in the names that aren't the same everywhere, or the last one if all are; []
    where names hold none, or not equally many.
    """
    rows = [integers(stem) for stem in stems]
    if not rows or not rows[0] or len({len(row) for row in rows}) != 1:
        return []
    columns = [list(column) for column in zip(*rows)]
    return [column for column in columns if len(set(column)) > 1] or columns[-1:]


def _open_folder(folder: Path, pattern: str, quiet: bool) -> Frames:
    paths = image_paths(folder)
    if paths and pattern:
        chosen = choose_series(folder, [path.name for path in paths], pattern=pattern)
        if chosen is None:
            raise DataError(f"{folder}: no images whose names fit --pattern '{pattern}', such as {paths[0].name}")
        for line in about_series([(str(folder), replace(chosen, numbered=False))]):  # gaps are told with the frames
            if not quiet:
                log.info(line)
        paths = [path for path in paths if path.name in chosen.names]
    elif not paths:
        refuse_clips(folder, _ALL, 'dpc prepare video "$clip" -o "$clip.h5"')
        raise DataError(f"{folder}: no frames; expected images ({', '.join(IMAGE_SUFFIXES)}){_held_instead(folder)}")
    paths = paths if pattern else one_series(folder, paths, option="--pattern", quiet=quiet)
    if not quiet and (clips := clips_in(folder)):
        log.info(f"{folder}: its images are the clip; left out: {first_names(clips)}")
    refuse_twins(folder, paths, f"choose with --pattern '*{paths[0].suffix}'")
    stems = [path.stem for path in paths]
    numbers = frame_numbers(stems)
    if any(a >= b for a, b in zip(numbers, numbers[1:])):
        numbers = list(range(len(stems)))  # fractions: 0.25 comes before 0.3
    names = tuple(path.name for path in paths)
    timed = with_times(Series(folder, names, pattern), folder)
    seconds = timed.times()
    if seconds is not None and not quiet:
        log.info(f"{folder}: its frames have the times in {timed.beside.path.name if timed.beside else 'their names'}")
    for unfit in () if quiet else timed.left_out:
        log.info(f"{folder}: left out: {unfit}")
    return Frames(folder, names, tuple(numbers), tuple(paths), None if seconds is None else tuple(seconds.tolist()))


def _held_instead(folder: Path) -> str:
    """Returns what a folder without frames holds, for its error: folders, or files of another kind; "" for neither."""
    inside = sorted(path.name for path in folder.iterdir() if path.is_dir())[:3]
    if inside:
        return f"; it has folders ({', '.join(inside)}): name one of them"
    files = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    if not files:
        return ""
    if not files[0].suffix and is_image_file(files[0]):
        return f"; {files[0].name} is an image without the suffix of one: give each its own"
    return f"; {files[0].name}: {no_video(files[0])}"


def read_rgba(path: Path) -> np.ndarray:
    """Reads one image as u8 (H,W,4), straight alpha. Raises DataError when unreadable."""
    with _readable(path) as image:
        require_one_picture(path, image)
        _require_known_numbers(path, image)
        return _to_rgba(as_shown(image), path)


def image_size(path: Path) -> tuple[int, int]:
    """Returns the width and height of one image as it is shown, by its header. Raises DataError when unreadable."""
    with _readable(path) as image:
        turned = image.getexif().get(ORIENTATION, 1) in (5, 6, 7, 8)
        return image.size[::-1] if turned else image.size


@contextmanager
def _readable(path: Path):  # -> Iterator[PIL.Image.Image]
    try:
        with open_image(path) as image:
            yield image
    except (OSError, ValueError, SyntaxError) as error:
        why = "empty" if path.is_file() and path.stat().st_size == 0 else first_line(error)
        raise DataError(f"{path}: not a readable image ({why}); export this frame again") from None


def _require_known_numbers(path: Path, image) -> None:  # image: PIL.Image.Image
    """Raises DataError of gray whose numbers Pillow gives changed: TIFFs of 9 to 15 bits, and those of other than unsigned 16
    that are compressed with the high byte first.
    """
    tags = getattr(image, "tag_v2", None)
    if tags is None:
        return
    if 8 < (bits := tags.get(BITS, (8,))[0]) < 16:
        raise DataError(f"{path}: a TIFF of {bits} bits a channel; expected 8 or 16: export this frame again")
    if image.mode in ("F", "I") and tags.prefix == b"MM" and tags.get(COMPRESSION, 1) != 1:
        raise DataError(f"{path}: compressed numbers of {bits} bits, high byte first; expected 8 or unsigned 16 bits")


def _to_rgba(image, path: Path) -> np.ndarray:  # image: PIL.Image.Image
    from PIL import Image

    if image.mode.startswith("I") or image.mode == "F":  # 16-bit gray: PIL would clip it at 255
        gray = np.asarray(image, np.float64)
        top = gray.max(initial=0)
        if image.mode != "F" and not 0 <= gray.min(initial=0) <= top < 1 << 16:
            raise DataError(
                f"{path}: gray from {gray.min():.0f} to {top:.0f}; expected 0 to 255 or to 65535: export this frame again"
            )
        unit = 1 / 255 if image.mode == "F" and top < 2 else 257.0 if top > 255 else 1.0
        if unit == 1 and top and image.mode != "F":
            with log.each_once(_SAID):
                log.warn(
                    f"{path.parent}: 16-bit gray of which a picture nowhere exceeds 255 is taken for 0 to 255 there; store "
                    "8 bits where it is nearly black instead"
                )
        level = image.info.get("transparency")  # of PNG: what is see-through
        clear = (gray == level) & isinstance(level, int)
        gray = np.clip(gray / unit, 0, 255).round().astype(np.uint8)
        rgb = Image.fromarray(np.dstack([gray, gray, gray]))  # to which as_shown applies what the file says of its gray
        shown = as_shown(rgb, {name: image.info[name] for name in ("gamma", "srgb") if name in image.info})
        return np.dstack([np.array(shown)[..., :3], np.where(clear, 0, 255).astype(np.uint8)])
    return np.array(image.convert("RGBA"))


def _open_animation(path: Path) -> Frames:
    times = animation_times(path)
    return Frames(path, _numbered(len(times)), tuple(range(len(times))), (path,), times)


def _open_video(path: Path) -> Frames:
    look = look_at_video(path)
    return Frames(path, _numbered(look.count), tuple(range(look.count)), (path,), look.times)


def _numbered(count: int) -> tuple[str, ...]:
    return tuple(f"frame {index}" for index in range(count))
