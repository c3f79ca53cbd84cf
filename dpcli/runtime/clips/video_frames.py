"""Frames of video files as players show them: with their alpha, turned, with square pixels, and by their own color matrix.

PyAV decodes: it brings decoders of AV1 and of the alpha of VP8 and VP9, which OpenCV lacks, and follows edit lists.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from pathlib import Path

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.path_names import utf8_path
from dpcli.runtime.clips import wide_color
from dpcli.runtime.clips.container_ends import VIDEO_FORMATS, empty_frames, ends_early, joined_videos, promised_frames
from dpcli.runtime.clips.cropping import Margins, entry_box, margins
from dpcli.runtime.clips.display_matrix import as_it_plays, display_matrix, more_than_a_picture
from dpcli.runtime.clips.other_files import no_video
from dpcli.runtime.progress import log

VIDEO_SUFFIXES = (
    *(".mp4", ".mov", ".avi", ".webm", ".mkv", ".m4v", ".ts", ".mts", ".m2ts", ".mpg", ".mpeg"),
    *(".wmv", ".flv", ".ogv", ".3gp", ".y4m", ".asf", ".mxf", ".vob", ".dv", ".mjpg", ".mjpeg"),
)
_BARE = ("h264", "hevc", "obu", "mjpeg", "m4v")  # streams without a container: their times are FFmpeg's invention
_ASSUMED_RATE = 25.0  # of such a stream, where it tells none
_UNTOLD = {"colorspace": 2, "color_primaries": 2, "color_trc": 2, "color_range": 0}  # what H.273 has for "unspecified"
_STILL = (b"ftypheic", b"ftypheix", b"ftypmif1")  # how pictures of phones begin
_ALPHA_DECODERS = {"vp8": "libvpx", "vp9": "libvpx-vp9"}  # FFmpeg's own decoders of them pass over the alpha
_STAMP_STEP = 2e-3  # s: what rounding does to time stamps
_APART = 1e-4  # s between frames of one stamp, less than the stamps' own steps
_HDR = {wide_color.PQ: "PQ", wide_color.HLG: "HLG"}
_MATRICES = (1, 4, 5, 6, 7, 9)  # in H.273: BT.709, FCC, BT.601 (two), SMPTE 240M, BT.2020
_UNKNOWN_MATRICES = {8: "YCgCo", 11: "YDzDx", 14: "ICtCp", 15: "IPT-C2", 16: "YCgCo-Re", 17: "YCgCo-Ro"}
_BT709, _BT601, _BT2020 = 1, 5, 9
_SD_LINES, _SD_COLUMNS = 576, 1279  # larger pictures without a tag are BT.709, as players have it
_FULL_RANGE = 2
_ALPHA_LAYER = re.compile(rb"\x4e[\x01\x09]\xa5")  # supplemental information of HEVC, of type 165: of an alpha channel
_HEAD = 1024  # bytes of a packet that hold such information, before its picture
_ASKEW = 0.02  # of a display matrix: a degree
_EXACTLY = 2 | 0x2000 | 0x40000  # FFmpeg's bilinear, full_chroma_int, accurate_rnd


@dataclass(frozen=True)
class VideoLook:
    """Tells of a video what one pass finds: its number of frames, their seconds or None, and whether alpha shows.

    An alpha that is 0 everywhere is none: programs that record four bytes a pixel may leave the fourth empty.
    """

    count: int
    times: tuple[float, ...] | None
    has_alpha: bool
    is_empty: bool = False  # its alpha, everywhere


def look_at_video(path: Path) -> VideoLook:
    """Decodes a video once and returns what is in it; what isn't shown as stored is said in the log.

    Raises DataError when no frame can be decoded, or when frames are missing that the file declares.
    """
    state = path.stat()
    return _look(path, state.st_mtime_ns, state.st_size)


def video_frames(path: Path, wanted: Sequence[int]) -> Iterator[np.ndarray]:
    """Yields frames by rising index, each u8 (H,W,4), straight alpha, opaque where the video has none.

    Decodes from the beginning: jumping to a frame of an inter-coded video isn't exact in every container.
    """
    container, stream = _open(path)
    with closing(container):
        frames, matrix, empty = enumerate(_decoded(path, container, stream)), None, False
        hidden = _margins(path, container, stream)
        for index in wanted:
            frame = next((frame for at, frame in frames if at == index), None)
            if frame is None:
                raise DataError(f"{path}: frame {index} cannot be decoded; copy the video again")
            if matrix is None:  # one for all of them
                matrix = display_matrix(frame)
                empty = _has_alpha(frame) and look_at_video(path).is_empty
            picture = _rgba(frame, stream.sample_aspect_ratio, hidden)
            if empty:
                picture[..., 3] = 255
            yield as_it_plays(picture, matrix)


@lru_cache(maxsize=4)
def _look(path: Path, changed: int, size: int) -> VideoLook:
    container, stream = _open(path)
    with closing(container):
        stamps, first, failed, alpha, seen, woven = [], None, False, False, False, 0
        bare = container.format.name in _BARE
        try:
            for frame in _decoded(path, container, stream):
                first, woven = first or frame, woven + bool(frame.interlaced_frame)
                if _has_alpha(frame) and not (alpha and seen):
                    low, high = _ends_of_alpha(frame)
                    alpha, seen = alpha or low < 255, seen or high > 0
                # Frames that the decoder held back until the end know no time base of their own.
                stamps.append(0.0 if bare or frame.pts is None else float(frame.pts * stream.time_base))
        except DataError:
            failed = True
        if first is None:
            raise DataError(f"{path}: no frame can be decoded; the video is empty, truncated, or of an unknown codec")
        rate = float((stream.codec_context.framerate if bare else stream.average_rate) or 0)
        if bare and rate == _ASSUMED_RATE:
            log.info(
                f"{path}: a stream without a container: {rate:g} frames per second, unless the stream states another rate (--fps)"
            )
        if container.format.name == "avi" and stream.frames > len(stamps) + 1:
            rate = 0.0  # frames are repeated: their own time stamps tell when, or nothing does
        times = frame_times(np.array(stamps), rate if 0 < rate < 10_000 else None)
        _check_whole(path, container, stream, len(stamps), times, failed)
        _require_known_colors(path, container, stream, first)
        _require_one_layer(path, stream)
        _tell_streams(path, container, stream)
        _tell_display(path, first, stream)
        if woven:  # of a film on television some are, two of five
            part = "" if woven == len(stamps) else f" in {woven} of {len(stamps)} frames"
            log.warn(f"{path}: interlaced{part}: each shows two moments, line by line; ffmpeg -vf bwdif parts them")
        left, right, top, bottom = _margins(path, container, stream)
        if left + right + top + bottom:
            shown = f"{first.width - left - right}x{first.height - top - bottom} of {first.width}x{first.height}"
            log.info(f"{path}: its margins are cut off, as it plays: {shown}")
        if alpha and not seen:
            log.info(f"{path}: its alpha is 0 everywhere, which is none; read as opaque")
    return VideoLook(
        len(stamps), None if times is None else tuple(times.tolist()), alpha and seen, is_empty=alpha and not seen
    )


def _ends_of_alpha(frame) -> tuple[int, int]:  # av.VideoFrame
    """Returns the least and the greatest alpha: some writers add a needless channel, filled with 255 or 0."""
    alpha = _levels(frame, frame.width, {})[..., 3]
    return int(alpha.min()), int(alpha.max())


def _has_alpha(frame) -> bool:
    return any(component.is_alpha for component in frame.format.components)


def open_container(path: Path, **options: str):  # -> av.container.InputContainer
    """Opens a video file, with options of FFmpeg's demuxer. Raises what PyAV does, DataError for a path that isn't UTF-8."""
    import av

    name = "file:" + utf8_path(path, "FFmpeg")
    options = {"format_whitelist": VIDEO_FORMATS, **options}
    return av.open(name, options=options, metadata_errors="replace")  # titles may be in any encoding


def _open(path: Path):  # -> (av.container.InputContainer, av.VideoStream)
    import av

    try:
        with path.open("rb") as file:
            if file.read(12)[4:] in _STILL:
                raise ValueError  # of its tiles, FFmpeg would read the first
        container = open_container(path)
    except (av.FFmpegError, OSError, ValueError):
        raise DataError(f"{path}: not a readable video ({no_video(path)})") from None
    streams = _streams(container)
    if not streams:
        container.close()
        raise DataError(f"{path}: no video in this file; expected a clip")
    if streams[0].codec_context is None:
        container.close()
        raise DataError(f"{path}: no decoder for its codec; ffmpeg -i {path.name} -c:v libx264 clip.mp4 converts it")
    return container, streams[0]


def _streams(container) -> list:  # of av.VideoStream
    """Returns the video streams, no pictures of covers, the one that players show first: the default, else the largest."""

    def rank(stream) -> tuple[bool, int]:
        context = stream.codec_context
        return not stream.disposition & stream.disposition.default, -(context.width * context.height if context else 0)

    pictured = [one for one in container.streams.video if not one.disposition & one.disposition.attached_pic]
    return sorted(pictured, key=rank)


def _decoded(path: Path, container, stream) -> Iterator:  # of av.VideoFrame
    """Yields the frames that play. Raises DataError at one that can't be decoded; such packets before the first are skipped."""
    import av

    context = stream.codec_context
    # The container's colors, before a decoder puts those of the stream in their place, also where it tells none.
    told = {name: tag for name, none in _UNTOLD.items() if (tag := getattr(context, name)) != none}
    silent = context.codec.canonical_name == "vp8"  # which has no place for them: FFmpeg assumes some
    wanted = _ALPHA_DECODERS.get(context.codec.canonical_name)
    if wanted and stream.metadata.get("alpha_mode", stream.metadata.get("ALPHA_MODE")) == "1":
        context = av.CodecContext.create(wanted, "r")
    context.thread_type = "AUTO"
    context.flags |= av.codec.context.Flags.unaligned  # else columns that H.264 and HEVC cut off on the left are shown
    begun = False
    for packet in chain(_packets_with_bytes(path, container, stream), [None]):
        try:
            frames = context.decode(packet)
        except av.FFmpegError as error:
            if begun:
                raise DataError(f"{path}: a frame cannot be decoded ({error.strerror}); copy the video again") from None
            continue
        for frame in frames:
            begun = True
            if silent or frame.colorspace == _UNTOLD["colorspace"]:
                for name, tag in told.items():
                    setattr(frame, name, tag)
            yield frame


def _packets_with_bytes(path: Path, container, stream) -> Iterator:  # of av.Packet
    """Yields the packets of a stream. Raises DataError where what lies between two of them is damaged.

    One without bytes says that a picture stays, in Theora; a codec takes it for the end, which comes but once.
    """
    import av

    try:
        yield from (packet for packet in container.demux(stream) if packet.size)
    except av.FFmpegError as error:
        raise DataError(f"{path}: no frame begins where one should ({error.strerror}); copy the video again") from None


def missing_frames(path: Path, count: int, times: np.ndarray | None) -> int:
    """Returns how many frames of its first video a file declares beyond the `count` that were decoded, 0 where it is whole.

    times: seconds of the decoded frames f64 (count), None where they are not known. Frames that an edit list hides are no
    loss; one is none either, since containers count differently, unless the file ends early or a packet of it is damaged.
    """
    cut = ends_early(path)
    container, stream = _open(path)
    with closing(container):
        declared, held = _declared_and_held(path, container, stream, count, times, cut)
    if declared > held + (not cut):
        return declared - held
    damaged = _damaged_packets(path)  # behind the first of which some decoders stop
    return max(damaged, _packets(path) - count) if damaged else 0


def _damaged_packets(path: Path) -> int:
    """Returns how many packets of the video can't be decoded, which OpenCV and ffmpeg don't tell."""
    import av

    damaged = 0
    with open_container(path) as container:
        try:
            for packet in container.demux(_streams(container)[0]):
                try:
                    packet.decode()
                except av.FFmpegError:
                    damaged += 1
        except av.FFmpegError:  # where the file ends
            pass
    return damaged


def _check_whole(path: Path, container, stream, count: int, times: np.ndarray | None, failed: bool) -> None:
    """Raises DataError when the file declares more frames than it holds; frames that an edit list hides are no loss.

    Warns where it ends early and nothing tells how many frames it had.
    """
    cut = ends_early(path)
    declared, held = (
        (stream.frames, count) if failed else _declared_and_held(path, container, stream, count, times, cut)
    )
    if failed or declared > held + (not cut):
        of = f"its {counted(declared, 'frame')}" if declared else "its frames"
        raise DataError(
            f"{path}: of {of} only {held} can be decoded; it is truncated or damaged: "
            "copy it again, or cut the good part out"
        )
    if (promised := promised_frames(path)) > max(declared, held) + empty_frames(path, stream.index):
        log.warn(
            f"{path}: its main header promises {counted(promised, 'frame')}; it holds {held}, as the header of its stream says"
        )
    if left := empty_frames(path, stream.index):
        log.warn(
            f"{path}: {counted(left, 'frame')} without bytes: the program that recorded it left them out, and so does this"
        )
    if (joined := joined_videos(path)) > 1:
        log.warn(
            f"{path}: holds {joined} videos, one behind another, of which only the first is sure to be read; join them by"
            " ffmpeg -f concat instead"
        )
    if cut:
        log.warn(f"{path}: the file ends before its container does; frames after the {held} that it holds may be lost")


def _declared_and_held(
    path: Path, container, stream, count: int, times: np.ndarray | None, cut: bool
) -> tuple[int, int]:
    """Returns how many frames a file declares, 0 where it doesn't, and how many of them lie in it; cut: it ends early."""
    if stream.frames > count + (not cut):
        return stream.frames, count + _hidden_packets(path) + empty_frames(path, stream.index)
    if not stream.frames and times is not None and stream.average_rate and len(container.streams) == 1:
        begins = float((stream.start_time or 0) * stream.time_base)  # some containers count their duration from 0
        seconds = float(container.duration or 0) / 1e6 - max(begins, 0.0)
        estimate = round(seconds * float(stream.average_rate))
        if cut:
            return estimate, count
        sure = estimate > 1.05 * count + 3 and not lasts(times, seconds)  # some containers round their duration up
        return (estimate if sure else 0), count
    return stream.frames, count


def _hidden_packets(path: Path) -> int:
    """Returns how many whole packets of the video lie before and after what plays, as an edit list says."""
    return _packets(path, ignore_editlist="1") - _packets(path)


def _packets(path: Path, **options: str) -> int:
    """Returns how many whole packets of the video are shown, by FFmpeg's demuxer with these options."""
    import av

    with open_container(path, **options) as container:
        packets = container.demux(_streams(container)[0])
        try:
            return sum(1 for one in packets if one.size and not one.is_corrupt and not one.is_discard)
        except av.FFmpegError:
            return 0


def frame_times(stamps: np.ndarray, rate: float | None) -> np.ndarray | None:
    """Returns seconds of a video's frames from its first: by its rate where that is what their time stamps say, else
    the stamps.

    Recordings of screens and phones have frames when something happens; their rate is a mean. Stamps are rounded to
    milliseconds in some containers and missing (0) in others. Browsers give some frames the stamp of the one before, after
    which they are put by as little as keeps times rising.
    """
    steady = np.arange(len(stamps)) / rate if rate else None
    since, steps = stamps - stamps[0], np.diff(stamps)
    known = len(stamps) > 1 and bool((steps >= 0).all() and (steps > 0).mean() > 0.5 and np.isfinite(stamps).all())
    if not known or (steady is not None and np.abs(since - steady).max() <= _STAMP_STEP):
        return steady
    if (steps > 0).all():
        return since
    apart = _APART * np.arange(len(stamps))
    return np.maximum.accumulate(since - apart) + apart


def lasts(times: np.ndarray, duration: float) -> bool:
    """Returns whether frames at these times fill a clip that is said to last so long: the last one may stay for a
    while.
    """
    steps = np.diff(times)
    return len(steps) > 0 and duration - times[-1] <= max(2 * float(steps.max()), 0.1 * duration)


def _require_known_colors(path: Path, container, stream, frame) -> None:
    """Raises DataError at colors in a space that isn't converted here, such as YCgCo of screen recorders.

    Dolby Vision of profile 5 has colors of its own, and no tag says so: its configuration names its profile in the third
    byte, before the bit that ends it.
    """
    tag = int(frame.colorspace)
    place = [one.index for one in container.streams.video].index(stream.index)
    if entry_box(path, place, (b"dvcC", b"dvvC"))[2:3] in (b"\x0a", b"\x0b"):
        raise DataError(
            f"{path}: Dolby Vision of profile 5, whose colors only its own players show; ffmpeg -i IN -vf libplacebo OUT "
            "converts it, or export it as HLG or SDR"
        )
    if tag in _UNKNOWN_MATRICES and not frame.format.is_rgb and not frame.format.name.startswith("gray"):
        raise DataError(
            f"{path}: its colors are {_UNKNOWN_MATRICES[tag]}; expected RGB, or YCbCr of BT.601, 709 or 2020; "
            "ffmpeg -i IN -vf zscale=matrix=709 OUT converts some"
        )


def _require_one_layer(path: Path, stream) -> None:
    """Raises DataError for HEVC with an alpha layer, as QuickTime writes it: FFmpeg shows what lies below as opaque."""
    if stream.codec_context.name != "hevc":
        return
    with open_container(path) as container:
        packet = next((packet for packet in container.demux(stream.index) if packet.size), b"")
        if _ALPHA_LAYER.search((stream.codec_context.extradata or b"") + bytes(packet)[:_HEAD]):
            raise DataError(
                f"{path}: its alpha is in a layer of HEVC that is not decoded; FFmpeg 9 converts it: "
                "ffmpeg -view_ids -1 -i IN -c:v prores_ks -pix_fmt yuva444p10le OUT.mov"
            )


def _tell_streams(path: Path, container, stream) -> None:
    others = [one for one in _streams(container) if one.index != stream.index and one.codec_context]
    if others:
        found = ", ".join(f"{one.index}: {one.codec_context.width}x{one.codec_context.height}" for one in others)
        log.info(
            f"{path}: {len(others) + 1} videos in it; {stream.index}, {stream.width}x{stream.height}, is read, as players do; "
            f"ffmpeg -i IN -map 0:NUMBER -c copy OUT takes out another ({found})"
        )


def _tell_display(path: Path, frame, stream) -> None:
    aspect = stream.sample_aspect_ratio
    if aspect and aspect != 1:
        log.info(f"{path}: its pixels are {aspect.numerator}:{aspect.denominator}; stretched to square ones")
    a, b, c, d = display_matrix(frame)
    if a * d < b * c:
        log.info(f"{path}: mirrored, as it plays")
    elif turn := round(frame.rotation / 90) % 4:
        log.info(f"{path}: turned by {90 * turn} degrees, as it plays")
    if min(abs(a) + abs(d), abs(b) + abs(c)) > _ASKEW * max(map(abs, (a, b, c, d))):
        log.warn(
            f"{path}: its display matrix turns it by {abs(np.degrees(np.arctan2(b, a))):.0f} degrees, of which only quarter "
            "turns are applied; ffmpeg -i IN OUT turns it"
        )
    if more := more_than_a_picture(frame):
        log.warn(
            f"{path}: {more}, as the file says; all of each frame is read as one picture: cut out a plain one first"
        )
    if int(frame.color_trc) in _HDR:
        log.warn(
            f"{path}: an HDR clip ({_HDR[int(frame.color_trc)]}): tone-mapped to SDR as ITU-R BT.2390 has it; players "
            "differ in this, so convert it to SDR first where colors must be theirs"
        )
    elif wide_color.is_wide(int(frame.color_trc), int(frame.color_primaries)):
        kind = "linear light" if int(frame.color_trc) == wide_color.LINEAR else "colors of a wide gamut"
        log.info(f"{path}: {kind}; converted to sRGB")


def _margins(path: Path, container, stream) -> Margins:
    """Returns what isn't shown of the frames of a stream."""
    place = [one.index for one in container.streams.video].index(stream.index)
    return margins(path, place, (stream.width, stream.height))


# frame: av.VideoFrame, aspect: Fraction | None
def _rgba(frame, aspect, hidden: Margins) -> np.ndarray:
    """Returns u8 (H,W,4) of a decoded frame as it is shown but for turns: full range, square pixels, without margins."""
    width = round(frame.width * aspect) if aspect and aspect != 1 else frame.width
    options = {"threads": 1}  # more convert strips of their own: other rounding at other numbers of cores
    if not frame.format.is_rgb:
        options |= {"src_colorspace": _matrix(frame), "dst_color_range": _FULL_RANGE}
    if not frame.format.is_rgb and not frame.format.name.startswith("gray"):
        options["src_color_range"] = int(frame.color_range) or (_FULL_RANGE if "yuvj" in frame.format.name else 1)
    transfer, primaries = int(frame.color_trc), int(frame.color_primaries)
    if wide_color.is_wide(transfer, primaries):
        deep = frame.reformat(width, frame.height, "rgba64le", **options).to_ndarray()
        rgb, alpha = wide_color.to_srgb(deep[..., :3], transfer, primaries), deep[..., 3:] >> 8
        picture = np.concatenate((rgb, alpha.astype(np.uint8)), axis=-1)
    else:
        picture = _levels(frame, width, options)
    left, right, top, bottom = hidden
    left, right = (round(margin * width / frame.width) for margin in (left, right))
    return picture[top : picture.shape[0] - bottom, left : width - right]


def _levels(frame, width: int, options: dict[str, int]) -> np.ndarray:
    """Returns u8 (H,W,4) of a frame, opaque where it has no alpha.

    FFmpeg's fast way from 4:2:0 and 4:2:2 to four bytes a pixel leaves the last columns of most widths unwritten, whatever
    memory held: so three bytes are asked for, and planes where there is alpha. It also rounds down, so that white of 10 bits is 253,
    unless it is asked to be exact; into 16 bits a channel, being exact breaks it.
    """
    options = {**options, "interpolation": _EXACTLY}
    if not _has_alpha(frame):
        rgb = frame.reformat(width, frame.height, "rgb24", **options).to_ndarray()
        return np.dstack((rgb, np.full(rgb.shape[:2], 255, np.uint8)))
    return frame.reformat(width, frame.height, "rgba" if frame.format.is_rgb else "gbrap", **options).to_ndarray()


def _matrix(frame) -> int:
    """Returns the color matrix of a frame, as H.273 numbers them: the tagged one, else what players take for its size."""
    tag = int(frame.colorspace)
    if tag == 10:  # BT.2020 of constant luminance, which no converter here knows better
        return _BT2020
    if tag in _MATRICES:
        return tag
    return _BT709 if frame.height > _SD_LINES or frame.width > _SD_COLUMNS else _BT601
