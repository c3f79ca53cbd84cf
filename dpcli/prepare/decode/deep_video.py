"""Frames of videos whose gray has more than 8 bits, decoded by ffmpeg without any change to their numbers."""

from __future__ import annotations

import re
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.decode.video_streams import VideoStream, ffmpeg_reading

_STAMP = re.compile(rb"\bpts_time:(\S+)")
_NEUTRAL = 0.02  # how far a color may be from gray, as a share of its range: what lossy codecs make of gray
_PATIENCE = 30.0  # seconds until a time stamp that belongs to a frame must have come


def deep_frames(path: Path, stream: VideoStream) -> Iterator[tuple[np.ndarray, float | None]]:
    """Yields (frame (H,W) u16 or f32 as stored, seconds of its time stamp or None) of a stream with ``deep_bits``.

    Ends early where the file does. Raises DataError when no frame can be decoded, or when they are colored.
    """
    plain = re.sub("be$", "le", stream.pixel_format)
    kind = np.dtype("<f4" if plain.startswith("grayf32") else "<u2")
    shift = 16 - stream.written_bits if stream.codec == "jpeg2000" and stream.written_bits else 0
    pixels = stream.width * stream.height
    size = (pixels + _color_values(stream)) * kind.itemsize
    count = 0
    with subprocess.Popen(
        _command(path, stream, plain), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        stamps = _Stamps(process.stderr)
        try:
            while size and len(data := process.stdout.read(size)) == size:  # type: ignore[union-attr]
                values = np.frombuffer(data, kind)
                _require_gray(path, stream, values[pixels:], count)
                frame = values[:pixels].reshape(stream.height, stream.width)
                yield frame >> shift if shift else frame, stamps.of_frame(count)
                count += 1
        finally:
            process.kill()
    if not count:
        raise DataError(f"{path}: no frame of its stream {stream.described()} can be decoded; expected a whole video")


def _command(path: Path, stream: VideoStream, pixel_format: str) -> list[str]:
    source = ffmpeg_reading(path, "-threads", "1", "-noautorotate")
    taken = ["-map", f"0:v:{stream.place}", "-vf", "showinfo=checksum=0", "-fps_mode", "passthrough"]
    raw = ["-f", "rawvideo", "-pix_fmt", pixel_format, "-"]
    return [*source, *taken, *raw]


def _color_values(stream: VideoStream) -> int:
    """Returns how many values of color follow those of brightness in a frame."""
    if stream.pixel_format.startswith("gray"):
        return 0
    across, down = {"420": (2, 2), "422": (2, 1), "440": (1, 2), "444": (1, 1)}[stream.pixel_format[3:6]]
    return 2 * -(-stream.width // across) * -(-stream.height // down)


def _require_gray(path: Path, stream: VideoStream, colors: np.ndarray, index: int) -> None:
    middle = 1 << stream.deep_bits - 1
    if len(colors) and (np.abs(colors.astype(np.int32) - middle) > _NEUTRAL * 2 * middle).mean() > _NEUTRAL:
        raise DataError(
            f"{path}: frame {index} is colored; expected a depth video whose gray is the depth, not a picture of it"
        )


class _Stamps:
    """Reads the time stamps that ffmpeg writes beside the frames, in a thread of its own."""

    def __init__(self, pipe) -> None:  # a binary stream
        self.seconds: list[float | None] = []
        self.news = threading.Condition()
        self.ended = False
        threading.Thread(target=self._read, args=(pipe,), daemon=True).start()

    def _read(self, pipe) -> None:
        try:
            for line in pipe:
                if match := _STAMP.search(line):
                    self._add(float(match[1]) if re.fullmatch(rb"-?[\d.]+(e-?\d+)?", match[1]) else None)
        except ValueError:  # closed, because no more frames are needed
            pass
        with self.news:
            self.ended = True
            self.news.notify()

    def _add(self, seconds: float | None) -> None:
        with self.news:
            self.seconds.append(seconds)
            self.news.notify()

    def of_frame(self, index: int) -> float | None:
        """Returns the seconds of a frame that has come, None when it has no time stamp."""
        with self.news:
            self.news.wait_for(lambda: len(self.seconds) > index or self.ended, timeout=_PATIENCE)
            return self.seconds[index] if len(self.seconds) > index else None
