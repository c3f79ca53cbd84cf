"""Finds the video streams of a file and the pixel format of each, as ffmpeg describes them."""

from __future__ import annotations

import re
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

from dpcli.errors import DataError
from dpcli.path_names import utf8_path
from dpcli.runtime.clips.container_ends import VIDEO_FORMATS
from dpcli.runtime.clips.display_matrix import display_matrix
from dpcli.runtime.clips.video_frames import open_container

_STREAM = re.compile(r"\s*Stream #0:\d+.*?: (Video|Audio|Subtitle|Data|Attachment): (.*)")
_TITLE = re.compile(r"\s+(?:title|handler_name)\s*: (.*)")
_GRAY = re.compile(r"gray(?:(9|10|12|14|16|f32)(?:le|be))?")
_BRIGHTNESS = re.compile(r"yuv(420|422|444|440)p(9|10|12|14|16)(?:le|be)")
_EIGHT_BITS = re.compile(
    r"gray|ya8|pal8|mono[bw]|nv\d+|yuva?j?4\d\dp|yuyv422|yvyu422|uyvy422|rgb24|bgr24|[argb0]{4}|gbra?p"
)


@dataclass(frozen=True)
class VideoStream:
    """Says what one video stream of a file is.

    ``place`` counts the video streams from 0; ``full_range`` is whether brightness uses all values; ``written_bits`` is
    how many of 16 bits the file holds, 0 where it doesn't say.
    """

    place: int
    codec: str
    pixel_format: str
    width: int
    height: int
    full_range: bool = False
    written_bits: int = 0
    title: str = ""

    @property
    def deep_bits(self) -> int:
        """Returns the bits of a pixel that arrives as it was stored, more than 8; 0 for other formats.

        That is gray, or the brightness of a format whose colors are apart and whose brightness uses all values.
        """
        if (gray := _GRAY.fullmatch(self.pixel_format)) and gray[1]:
            return int(gray[1].removeprefix("f"))
        if self.full_range and (brightness := _BRIGHTNESS.fullmatch(self.pixel_format)):
            return int(brightness[2])
        return 0

    @property
    def is_eight_bits(self) -> bool:
        """Returns whether a pixel has 8 bits a channel, or less."""
        return _EIGHT_BITS.fullmatch(self.pixel_format) is not None

    def described(self) -> str:
        """Returns what the stream is, in words, such as ``gray16be, 640x576, DEPTH``."""
        return ", ".join(part for part in (self.pixel_format, f"{self.width}x{self.height}", self.title) if part)


def ffmpeg_reading(path: Path, *options: str) -> list[str]:
    """Returns the command of the ffmpeg that comes with imageio-ffmpeg up to its input, a file that names no others."""
    import imageio_ffmpeg

    quiet = ["-hide_banner", "-nostdin", "-nostats", "-format_whitelist", VIDEO_FORMATS]
    return [imageio_ffmpeg.get_ffmpeg_exe(), *quiet, *options, "-i", f"file:{utf8_path(path, 'ffmpeg')}"]


def video_streams(path: Path) -> list[VideoStream]:
    """Returns the video streams of a file, pictures of its cover left out; none when ffmpeg can't read it."""
    told = subprocess.run(ffmpeg_reading(path), capture_output=True, stdin=subprocess.DEVNULL).stderr.decode(
        "utf-8", "replace"
    )
    found: list[VideoStream] = []
    of_video = False
    for line in told.splitlines():
        if match := _STREAM.match(line):
            of_video = match[1] == "Video" and "(attached pic)" not in line
            if of_video:
                found.append(_parsed(len(found), match[2]))
        elif of_video and (title := _TITLE.match(line)) and not found[-1].title:
            found[-1] = replace(found[-1], title=title[1].strip())
    return found


def how_shown(path: Path, place: int = 0, *, every: bool = False) -> tuple[bool, int]:
    """Returns whether the first frame of a video stream is interlaced, or ``every`` one was asked for and some is, and by how many
    quarters counterclockwise the first is turned where it is shown; (False, 0) where PyAV can't read it.

    Raises DataError where it is shown mirrored: which of the two the camera saw, no file says, and space would be mirrored, too.
    """
    import av

    try:
        with open_container(path) as container:
            frames = container.decode(video=place)
            first = next(frames)
            woven = bool(first.interlaced_frame) or (every and any(frame.interlaced_frame for frame in frames))
            turned, (a, b, c, d) = round(first.rotation / 90) % 4, display_matrix(first)
    except (av.FFmpegError, OSError, ValueError, IndexError, StopIteration):
        return False, 0
    if a * d < b * c:
        raise DataError(
            f"{path}: says that it is shown mirrored; expected the camera's own picture, which is as a rule the stored one: ffmpeg"
            f" -display_rotation 0 -i {path.name} -c copy depth{path.suffix}"
        )
    return woven, turned


def attached_json(path: Path) -> bytes:
    """Returns the calibration that an Azure Kinect's recorder attached to a file, nothing where there is none."""
    import av

    try:
        with open_container(path) as container:
            attached = [one.data for one in container.streams.attachments if str(one.name).endswith(".json")]
    except (av.FFmpegError, OSError, ValueError):
        return b""
    return next((data for data in attached if data and b'"CalibrationInformation"' in data), b"")


def cuts_left(path: Path) -> bool:
    """Returns whether the codec of a file's first video cuts columns off on the left, in whose place OpenCV stretches what it got."""
    import av

    try:
        with open_container(path) as container:
            return next(container.decode(video=0)).width != container.streams.video[0].codec_context.width
    except (av.FFmpegError, OSError, ValueError, IndexError, StopIteration):
        return False


def _parsed(place: int, text: str) -> VideoStream:
    """Returns a stream from ffmpeg's words for it: ``png (MPNG / 0x474E504D), gray16be(pc, progressive), 32x24, ...``."""
    parts = [part.strip() for part in re.split(r",(?![^(]*\))", text)]
    kind, _, details = (parts[1] if len(parts) > 1 else "unknown").partition("(")
    bits = re.search(r"(\d+) bpc", details)
    size = next((match for part in parts[2:] if (match := re.match(r"(\d+)x(\d+)\b", part))), None)
    width, height = (int(size[1]), int(size[2])) if size else (0, 0)
    full_range = re.search(r"\bpc\b", details) is not None
    return VideoStream(place, parts[0].split()[0], kind, width, height, full_range, int(bits[1]) if bits else 0)


def depth_stream(path: Path) -> VideoStream:
    """Returns the stream of a file that holds depth: the only one, the one called so, or the only deep one.

    Raises DataError when nothing decides, or when its pixels would not arrive as they were stored.
    """
    streams = video_streams(path)
    if not any(one.width and one.pixel_format != "none" for one in streams):
        raise DataError(f"{path}: not a readable video (empty, truncated, or of an unknown codec)")
    called = [one for one in streams if "depth" in one.title.lower()]
    deep = [one for one in streams if one.deep_bits]
    one = next((choice[0] for choice in (streams, called, deep) if len(choice) == 1), None)
    if one is None:
        listed = "; ".join(f"{one.place}: {one.described()}" for one in streams)
        raise DataError(
            f"{path}: holds {len(streams)} video streams ({listed}); none is called depth, so copy the one that is it:"
            f" ffmpeg -i {path.name} -map 0:v:1 -c copy depth{path.suffix}"
        )
    if not one.is_eight_bits and not one.deep_bits:
        raise DataError(
            f"{path}: its pixel format is {one.pixel_format}; expected gray of 8 to 16 bits, such as gray16le, because"
            " depth doesn't survive in others; write it again from its source: -c:v ffv1 -pix_fmt gray16le"
        )
    return one
