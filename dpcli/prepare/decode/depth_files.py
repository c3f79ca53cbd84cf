"""Decoding depth videos (8 or 16 bits), folders of images and NumPy arrays; frames come out as stored."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dpcli.errors import DataError
from dpcli.npy_files import map_npy
from dpcli.path_names import utf8_path
from dpcli.prepare.array_files.choosing import says_times
from dpcli.prepare.array_files.containers import open_arrays
from dpcli.prepare.array_files.depth_arrays import DEPTH_NAME, ArchivedDepth, archived_depth, depth_frames, says_depth
from dpcli.prepare.cloud_formats.column_names import first_unit
from dpcli.prepare.decode.cv2_import import load_cv2
from dpcli.prepare.decode.pictures import tiff
from dpcli.prepare.decode.pictures.portable_maps import read_portable_map
from dpcli.prepare.decode.png import check_picture, decode_gray_png, read_header, significant_bits
from dpcli.prepare.series import Series, choose_series, is_hidden
from dpcli.runtime.clips.container_ends import empty_frames, ends_early, joined_videos, promised_frames
from dpcli.runtime.clips.cropping import margins
from dpcli.runtime.clips.other_files import stand_ins_named
from dpcli.store.schema import METERS

if TYPE_CHECKING:
    from dpcli.prepare.decode.pinhole_camera import Calibration
    from dpcli.prepare.decode.video_streams import VideoStream

VIDEO_SUFFIXES = (".avi", ".mp4", ".mkv", ".mov", ".m4v", ".webm", ".nut", ".y4m")
IMAGE_SUFFIXES = (".png", ".tif", ".tiff", ".pgm", ".jp2", ".pfm", ".exr")
ARRAY_SUFFIXES = (".npy", ".npz", ".mat", ".h5", ".hdf5")
FRAME_SUFFIXES = (*IMAGE_SUFFIXES, *ARRAY_SUFFIXES)  # of two files of one frame the earlier is preferred
_OTHERWISE = re.compile(r"disparit|(?<![a-z])disp(_?map)?(?![a-z])|(?<![a-z])inv(erse)?[-_ ]?depth", re.IGNORECASE)
_INFRARED = re.compile(
    r"(^|[^a-z])(n?ir|lwir|infra(red|[0-9])?|thermal|amplitudes?|ab_?images?|active_?brightness)([^a-z]|$)",
    re.IGNORECASE,
)
_BRIGHTNESS = re.compile(r"[-_.]ab$", re.IGNORECASE)  # what HoloLens puts beside each frame of depth
# levels between channels, and share of pixels beyond: a color map has most of them
_GRAY_NOISE, _COLORED_SHARE = 24, 0.02
_QUICKTIME = (".mov", ".mp4", ".m4v")
_GRAY16 = 0x10003159  # what OpenCV calls the pixel format gray16le
_EIGHT_BITS = {int.from_bytes(tag, "little") for tag in (b"Y800", b"I420", b"Y42B", b"444P", b"NV12", b"YUY2", b"UYVY")}
WHITE_AT_ZERO = (
    "videos of TIFFs that say their 0 is white; their numbers are taken as stored (--invert if larger ones are nearer)"
)
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # the last two: of more than 4 GB
SPREAD = (
    "videos of PNGs that say {} of 16 bits are significant (sBIT), as where numbers were multiplied to fill them; taken as stored"
    " (--depth-scale)"
)
_MARGINS = "says that margins of its frames are cut off; write it again without them: ffmpeg -i IN -c:v ffv1 depth.mkv"
LEFT_OUT = "frames without bytes, which the recording program left out"
TURNED = "videos turned upright as their files say; --fov, --fx and the like are those of the turned pictures"
ZOOMS = "videos whose frames have files with different cameras, of which the first counts (--fx ... gives another)"
JOINED = "videos behind the first in one file, whose frames may not be read; join them by ffmpeg -f concat instead"
_TICK = 0.0011  # seconds by which a container's time stamps may be off: it counts milliseconds


@dataclass
class DepthVideo:
    """Holds raw frames (T,H,W) u8, u16, or float, and the seconds of each since the first, f64 (T), None = not known.

    missing: how many more frames the file declares than it holds, such as a recording that was cut. ends_early: the file
    stops before its container does, whether or not it says how many frames there were. notes: counts of what else is
    missing or doubtful. camera, scale: of raw units per meter, where the file itself tells them.
    """

    frames: np.ndarray
    time: np.ndarray | None = None
    missing: int = 0
    ends_early: bool = False
    notes: dict[str, int] = field(default_factory=dict)
    scale: float | None = None
    camera: Calibration | None = None


def open_video(path: Path):  # -> cv2.VideoCapture
    """Opens an OpenCV capture that yields 16-bit gray frames unharmed and 8-bit ones expanded to the full range."""
    capture = _opened(path)
    if not capture.isOpened():
        raise DataError(f"{path}: not a readable video (empty, truncated, or of an unknown codec)")
    return capture


def _opened(path: Path):  # -> cv2.VideoCapture
    """Returns the capture of `open_video`, also one that could not be opened. Raises DataError when there is no file."""
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
    return capture


def read_video(path: Path, start: int = 0, stop: int | None = None) -> tuple[list[np.ndarray], float | None]:
    """Returns frames ``start`` to ``stop`` - 1, or those that the file has of them, each (H,W) u8 or u16, and the frames
    per second that the file declares (None = says nothing).

    Decodes from the beginning: jumping to a frame of an inter-coded video isn't exact in every container.
    """
    capture = open_video(path)
    try:
        return list(_decoded(capture, path, start, stop, 1)), _declared_rate(capture)
    finally:
        capture.release()


def read_timed_video(path: Path, stride: int = 1) -> tuple[list[np.ndarray], np.ndarray | None, int]:
    """Returns every ``stride``-th frame of a depth video, (H,W) u8, u16 or f32 as stored, their seconds since the first,
    f64 (T), None where the file has no time stamps that rise, and how many more frames the file declares than it holds.

    Of several streams the one of depth is taken. Raises DataError where gray of more than 8 bits would be cut.
    """
    from dpcli.prepare.decode.deep_video import deep_frames  # for videos alone: folders of images start without it
    from dpcli.prepare.decode.video_streams import depth_stream, how_shown

    capture = _opened(path)
    try:
        tag, rate = int(capture.get(load_cv2().CAP_PROP_CODEC_PIXEL_FORMAT)), _declared_rate(capture)
        declared = _declared_frames(capture)
        # in others depth often lies beside color; asking takes a tenth of a second
        one_stream = path.suffix.lower() == ".avi"
        stream = None if one_stream and tag in (_GRAY16, *_EIGHT_BITS) else depth_stream(path)
        if stream and (stream.codec, stream.pixel_format) == ("rawvideo", "gray") and path.suffix.lower() in _QUICKTIME:
            raise DataError(
                f"{path}: raw gray of 8 bits in QuickTime, of which some programs write 0 for white and others 0 for black, and"
                " nothing tells which; write it again from its source: -c:v ffv1"
            )
        if stream is None or (stream.place == 0 and _is_plain(stream)):
            stamps: list[float | None] = []
            frames = list(_decoded(capture, path, 0, None, stride, stamps))
            times = rising_times(stamps, rate, stride)
            return frames, times, _missing(path, declared, len(frames), times, stride)
    finally:
        capture.release()
    if stream.is_eight_bits:
        raise DataError(
            f"{path}: its depth is stream {stream.place} ({stream.described()}) of several; copy it to a file of its own:"
            f" ffmpeg -i {path.name} -map 0:v:{stream.place} -c copy depth{path.suffix}"
        )
    if any(margins(path, stream.place, (stream.width, stream.height))):
        raise DataError(f"{path}: {_MARGINS}")
    turned = how_shown(path, stream.place)[1]
    kept = [pair for index, pair in enumerate(deep_frames(path, stream)) if index % stride == 0]
    times = rising_times([seconds for _, seconds in kept], rate, stride)
    return (
        [np.rot90(frame, turned) for frame, _ in kept],
        times,
        0 if stream.place else _missing(path, declared, len(kept), times, stride),
    )


def _declared_frames(capture) -> int:
    count = float(capture.get(load_cv2().CAP_PROP_FRAME_COUNT))
    return int(count) if 0 < count < 1e9 else 0


def _missing(path: Path, declared: int, count: int, times: np.ndarray | None, stride: int) -> int:
    """Returns how many frames the file lacks; it is opened again only where OpenCV's guess of its length says more."""
    from dpcli.runtime.clips.video_frames import missing_frames

    seen = count * stride  # but for the last few
    missing = missing_frames(path, seen, times if stride == 1 else None) if declared > seen else 0
    return missing or max(promised_frames(path) - max(declared, seen), 0)


def _is_plain(stream: VideoStream) -> bool:
    """Returns whether OpenCV gives a stream's pixels unharmed."""
    return stream.is_eight_bits or (stream.pixel_format == "gray16le" and not stream.written_bits)


def rising_times(stamps: Sequence[float | None], rate: float | None, stride: int = 1) -> np.ndarray | None:
    """Returns seconds since the first of ``stamps``, those of every ``stride``-th frame; None when they are not known.

    Where they are those of a constant rate (frames per second) but for the milliseconds of the container, the rate counts.

    >>> rising_times([0.0, 0.033, 0.067], 30.0).round(4).tolist()
    [0.0, 0.0333, 0.0667]
    """
    even = np.arange(len(stamps)) * stride / rate if rate else None
    if any(stamp is None for stamp in stamps):
        return None
    seconds = np.array(stamps, np.float64)
    if len(seconds) > 1 and not (np.diff(seconds) > 0).all():
        return None
    since = seconds - seconds[:1]
    return even if even is not None and np.abs(since - even).max(initial=0) <= _TICK else since


def _declared_rate(capture) -> float | None:
    rate = float(capture.get(load_cv2().CAP_PROP_FPS))
    return rate if np.isfinite(rate) and 0 < rate < 10_000 else None


def _decoded(
    capture, path: Path, start: int, stop: int | None, stride: int, stamps: list[float | None] | None = None
) -> Iterator[np.ndarray]:
    """Yields the wanted frames (H,W), and appends the seconds of their time stamps to ``stamps``."""
    cv2, index, last, repeats = load_cv2(), 0, None, False
    _require_progressive(path, every=False)
    while (stop is None or index < stop) and capture.grab():
        if index >= start and (index - start) % stride == 0:
            if stamps is not None:
                stamps.append(capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
            ok, frame = capture.retrieve()
            if not ok:
                raise DataError(f"{path}: frame {index} cannot be decoded")
            if frame.ndim == 3 and _colored(frame):
                raise DataError(
                    f"{path}: frame {index} is colored; expected a depth video whose gray is the depth, not a picture of it"
                )
            gray = np.ascontiguousarray(frame[..., 0]) if frame.ndim == 3 else frame  # strided, all after is slower
            if not repeats and last is not None and np.array_equal(last, gray):
                _require_progressive(path, every=True)
                repeats = True
            last = gray
            yield gray
        index += 1


def _require_progressive(path: Path, *, every: bool) -> None:
    """Raises DataError for interlaced frames, which some versions of OpenCV replace by the frame before, or by anything."""
    from dpcli.prepare.decode.video_streams import cuts_left, how_shown

    if not every and cuts_left(path):
        raise DataError(f"{path}: {_MARGINS}")
    if how_shown(path, every=every)[0]:
        raise DataError(
            f"{path}: interlaced: each frame may show two moments, line by line, between which depth is none; if each shows one,"
            f" say so: ffmpeg -i {path.name} -vf setfield=prog,format=gray -c:v ffv1 depth.mkv (format=gray16le of 16 bits)"
        )


def _colored(frame: np.ndarray) -> bool:
    """Returns whether a decoded frame (H,W,3) u8 has colors, beyond what lossy codecs make of gray; looks at some of
    its pixels.
    """
    some = frame[::8, ::8].astype(np.int16)
    return bool((np.ptp(some, axis=2) > _GRAY_NOISE).mean() > _COLORED_SHARE)


def read_image(path: Path) -> np.ndarray:
    """Reads one gray depth image (H,W) u8, u16 or f32. Raises DataError when unreadable or colored."""
    if path.suffix.lower() == ".exr":
        from dpcli.prepare.decode.pictures.exr import read_exr

        frame, channel = read_exr(path)
        require_depth(path, channel)
        return frame
    data = path.read_bytes()
    image = decode_gray_png(data)
    if image is not None:
        return image
    check_picture(data, path)
    if (image := read_portable_map(data, path)) is not None:
        return image
    if (header := read_header(data)) and header.bits < 8 and header.color == 0:
        raise DataError(f"{path}: {header.bits} bits a pixel, too few for depth; expected 8 or 16")
    spread = tiff.require_unchanged(data, path)
    cv2 = load_cv2()
    pages = cv2.imdecodemulti(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)[1] if data else ()
    if not pages and data.startswith(_TIFF):
        raise DataError(f"{path}: {tiff.UNREAD}")
    if not pages:
        raise DataError(f"{path}: not a readable image (empty, truncated, or not an image)")
    if len(pages) > 1:  # which of them is the frame?
        raise DataError(
            f"{path}: holds {len(pages)} pages; expected one depth image a file: save each page as its own file"
        )
    image = pages[0]
    if image.ndim == 3:
        opaque = image.shape[2] == 4 and image.dtype.kind == "u" and (image[..., 3] == np.iinfo(image.dtype).max).all()
        if image.shape[2] != 3 + opaque or (image[..., :3] != image[..., :1]).any():
            raise DataError(f"{path}: a color image of shape {image.shape}; expected one gray channel of depth")
        image = image[..., 0]
    if image.dtype == np.uint8 and has_white_at_zero(data):
        return 255 - image  # which OpenCV turned round, of 8 bits alone
    return image >> spread if spread else image


def has_white_at_zero(data: bytes) -> bool:
    """Returns whether the bytes are those of a TIFF that says its 0 is white, which has no defined meaning for depth."""
    return tiff.read_tags(data).get(tiff.PHOTOMETRIC, (1,))[0] == 0


def read_frame(path: Path) -> np.ndarray:
    """Reads one frame (H,W) of a folder: an image, or an array in ``.npy`` or ``.npz``."""
    with stand_ins_named(path):
        if path.suffix.lower() not in ARRAY_SUFFIXES:
            return read_image(path)
        array = read_array(path)
        if len(array) != 1:
            raise DataError(f"{path}: holds {len(array)} frames; expected one (height, width), as its neighbors have")
        return array[0]


def read_frames(series: Series, stride: int = 1) -> np.ndarray:
    """Reads every ``stride``-th frame of a series as (T,H,W). Raises DataError when sizes or types differ."""
    paths = series.paths[::stride]
    first = read_frame(paths[0])
    frames = np.empty((len(paths), *first.shape), first.dtype)
    frames[0] = first
    for index, path in enumerate(paths[1:], start=1):
        frame = read_frame(path)
        if (frame.shape, frame.dtype) != (first.shape, first.dtype):
            size = f"{first.shape[1]}x{first.shape[0]} {first.dtype}"
            raise DataError(f"{path}: {frame.shape[1]}x{frame.shape[0]} {frame.dtype}; the first image is {size}")
        frames[index] = frame  # while it is in the cache
    return frames


def frame_series(folder: Path, pattern: str = "") -> Series | None:
    """Returns the frames of depth directly in a folder, in order; None when it holds none.

    Of several series, the one whose name says depth is taken, or else the only one that holds gray images. Several arrays
    of more than one frame each are videos of their own, not a series.
    """
    with os.scandir(folder) as entries:
        names = [entry.name for entry in entries if entry.name.lower().endswith(FRAME_SUFFIXES)]
    if not any(name.lower().endswith(IMAGE_SUFFIXES) for name in names):
        arrays = sorted(name for name in names if not is_hidden(name))
        if len(arrays) < 2 or not _is_frame(folder / arrays[0]):
            return None
    return choose_series(folder, names, pattern=pattern, suffixes=FRAME_SUFFIXES, wanted=DEPTH_NAME, judge=_holds_depth)


def require_depth(path: Path, name: str) -> None:
    """Raises DataError where a video's name says that it holds disparities or the inverse of depth, or the name of its own
    folder or file that these are pictures of an infrared camera.
    """
    own = name.rpartition("/")[2]
    if _INFRARED.search(own) and not says_depth(own):
        raise DataError(
            f"{path}: by its name it holds pictures of an infrared camera, not depth; give the folder of the depth, or call"
            " this one otherwise if it is depth"
        )
    said = _OTHERWISE.search(name)
    if said and (said[0].lower().startswith("inv") or not says_depth(name)):
        what = "the inverse of depth" if said[0].lower().startswith("inv") else "disparities"
        raise DataError(
            f"{path}: by its name it holds {what}, not depth; depth is focal length x baseline / disparity. Save it as depth,"
            " or call it otherwise if it is"
        )


def _is_frame(path: Path) -> bool:
    """Returns whether an array file holds one frame, (H,W) or (H,W,1), by its header where it has one."""
    try:
        npy = path.suffix.lower() == ".npy"
        return map_npy(path).shape[2:] in ((), (1,)) if npy else len(read_array(path)) == 1
    except (DataError, OSError):  # reading the file says so
        return False


def _holds_depth(path: Path) -> bool:
    """Returns whether a file can be a frame of depth: gray of more than 8 bits, by its name not of an infrared camera."""
    if not says_depth(path.stem) and (_INFRARED.search(path.stem) or _BRIGHTNESS.search(path.stem)):
        return False
    try:
        return read_frame(path).dtype != np.uint8
    except DataError:
        return False


def read_array(path: Path, stride: int = 1) -> np.ndarray:
    """Reads depth frames (T,H,W), or one frame (H,W), of a ``.npy``, mapped so that a stride reads less, or of a file of
    named arrays; those of MATLAB are (H,W,T).

    Raises DataError of what is none, such as the poses of a camera.
    """
    return depth_frames(path, map_npy(path) if path.suffix.lower() == ".npy" else archived_depth(path).depth, stride)


def _told_beside(path: Path, found: ArchivedDepth, frames: int, with_camera: bool) -> dict[str, Any]:
    """Returns what the arrays beside those of so many frames of depth tell, and their attributes, by the fields of a `DepthVideo`."""
    from dpcli.prepare.decode.calibration import camera_of_any
    from dpcli.prepare.times_beside import seconds_beside

    attributes, whole, unit = found.attributes, found.depth.dtype.kind != "f", first_unit(found.lengths)
    own = {"depth_unit": np.array(unit)} if unit and whole else {}
    clocks = [name for name, one in found.small.items() if says_times(name.rpartition("/")[2]) and one.size == frames]
    times = [(name, seconds_beside(name, found.small[name], found.units[name])) for name in clocks if frames > 1]
    name, time = next(((name, seconds) for name, seconds in times if seconds is not None), ("", None))
    further = ({**attributes, **own}, attributes, own, {})  # a unit may be that of numbers once they are scaled
    (camera, scale, rest), used = camera_of_any(path, further, found.small, frames, with_camera=with_camera)
    rest += tuple(f"attribute {one}" for one in attributes if one not in used)
    scale = scale if whole else 1 / METERS[unit] if unit not in ("", "m") else None  # fractions are lengths
    unread = [one for one in (*rest, *found.large) if one != name and one not in attributes]
    notes = {f"videos whose file holds arrays that are not read ({', '.join(unread[:5])})": 1} if unread else {}
    return {"camera": camera, "scale": scale, "notes": notes, "time": time}


def tells_times(path: Path) -> bool:
    """Returns whether an array beside the depth in a file of named arrays tells when each frame was taken."""
    if path.suffix.lower() not in ARRAY_SUFFIXES[1:] or not path.is_file():
        return False
    try:
        with open_arrays(path) as arrays:
            if not any(says_times(name.rpartition("/")[2]) for name in arrays):
                return False
        return _read_file(path, 1, with_camera=False).time is not None
    except DataError:  # reading says so
        return False


def read_depth_video(
    path: Path, stride: int = 1, series: Series | None = None, *, with_camera: bool = True
) -> DepthVideo:
    """Reads any depth video: a video file, a file of arrays, or a folder of frames, of which ``series`` says which; of every
    ``stride``-th frame. with_camera: whether a camera that it tells is wanted. Raises DataError when nothing can be read.
    """
    suffix = path.suffix.lower()
    if path.is_dir():
        series = series or frame_series(path)
        if series is None:
            raise DataError(f"{path}: no depth images ({', '.join(FRAME_SUFFIXES)})")
        times = series.times()
        first = series.paths[0]
        data = first.read_bytes() if first.suffix.lower() in (".tif", ".tiff") else b""
        turned = tiff.read_tags(data).get(tiff.ORIENTATION, (1,))[0] != 1  # which OpenCV does
        known = {WHITE_AT_ZERO: int(has_white_at_zero(data)), TURNED: int(turned)}
        told: dict[str, Any] = {"notes": {what: count for what, count in known.items() if count}}
        if first.suffix.lower() in ARRAY_SUFFIXES[1:]:
            told, last = (_told_beside(one, archived_depth(one), 1, with_camera) for one in (first, series.paths[-1]))
            told["notes"] |= {ZOOMS: 1} if told["camera"] and not told["camera"].is_like(last["camera"]) else {}
        video = DepthVideo(read_frames(series, stride), **{**told, "time": None if times is None else times[::stride]})
        bits = significant_bits(first) if first.suffix.lower() == ".png" and video.frames.dtype == np.uint16 else 16
        if bits < 16 and video.frames.max(initial=0) >= 1 << bits:
            video.notes[SPREAD.format(bits)] = 1
    elif suffix in (*ARRAY_SUFFIXES, *VIDEO_SUFFIXES):
        with stand_ins_named(path):
            video = _read_file(path, stride, with_camera)
    else:
        kinds = ", ".join((*ARRAY_SUFFIXES, *VIDEO_SUFFIXES))
        raise DataError(f"{path}: unknown kind; expected a folder of images, or one of {kinds}")
    if video.frames.size == 0:
        raise DataError(f"{path}: an empty video: shape {video.frames.shape}")
    return video


def _read_file(path: Path, stride: int, with_camera: bool) -> DepthVideo:
    """Reads an array or a video file. Raises DataError when it can't be read, or holds no frame."""
    if path.suffix.lower() in ARRAY_SUFFIXES[1:]:
        found = archived_depth(path)
        frames = depth_frames(path, found.depth)
        told = _told_beside(path, found, len(frames), with_camera)
        if told["time"] is not None:
            told["time"] = told["time"][::stride]
        return DepthVideo(np.ascontiguousarray(frames[::stride]), **told)
    if path.suffix.lower() in ARRAY_SUFFIXES:
        return DepthVideo(read_array(path, stride))
    from dpcli.prepare.decode.video_streams import attached_json, how_shown

    frames, time, missing = read_timed_video(path, stride)
    if not frames:
        raise DataError(f"{path}: an empty video: no frame can be decoded")
    told = {
        LEFT_OUT: empty_frames(path, 0),
        TURNED: int(how_shown(path)[1] > 0),
        JOINED: max(joined_videos(path) - 1, 0),
    }
    notes = {what: count for what, count in told.items() if count}
    camera = None
    if with_camera and path.suffix.lower() == ".mkv" and (text := attached_json(path)):
        from dpcli.prepare.decode.calibration import attached_calibration

        try:
            camera = attached_calibration(path, text)
        except DataError as error:
            notes[f"videos whose attached calibration is not used ({error})"] = 1
    return DepthVideo(np.stack(frames), time, missing, ends_early(path), notes, camera=camera)
