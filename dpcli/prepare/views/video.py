"""One clip of an object, filmed or generated, into the pictures that 4D fitting starts from."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.ops.cameras import DEFAULT_FOVY, DEFAULT_RADIUS, orbit_pose, pinhole
from dpcli.path_names import first_names
from dpcli.prepare.decode.color_frames import (
    FOLDER_FPS,
    PICTURE_FOLDERS,
    Frames,
    image_paths,
    image_size,
    integers,
    open_frames,
    read_rgba,
)
from dpcli.prepare.reader import ON_ERROR, require_folder, require_known
from dpcli.prepare.views import matting
from dpcli.prepare.views.cameras_beside import tell_cameras_beside
from dpcli.prepare.views.given_views import OrbitCamera, find_views, read_cameras, six_views
from dpcli.prepare.views.masks import mask_of_video, read_mask
from dpcli.prepare.views.square_crop import (
    Box,
    Crop,
    Piece,
    crop_around,
    fills_sides,
    pieces,
    still_box,
    touches_border,
    union,
    visible_box,
    whole_picture,
)
from dpcli.prepare.views.views_pipeline import Clip, digest_of
from dpcli.runtime.progress import log
from dpcli.store.views import ViewsHeader

_LISTED = 8
_ISLAND = 0.01  # of the object: a smaller piece apart from it does not widen the crop
_OBJECT = 0.2  # of the largest piece: one that large, apart from it, is another object
_KEPT = 1 << 28  # bytes of cut frames that stay in memory
_STILL = 2  # pixels that the sides of something still move by
_ANNOTATIONS = (".json", ".txt", ".xml", ".npy", ".npz")  # of LabelMe, YOLO, CVAT, SAM


@dataclass(frozen=True, kw_only=True)
class VideoOptions:
    """Says how a clip is read. Angles in degrees here, as typed; `frames` 0 keeps all; `views` is a multi-view folder.

    Raises UsageError on values that make no sense.
    """

    frames: int = 32
    size: int = 512
    recenter: bool = True
    border: float = 0.2
    background: str = "auto"
    tolerance: float = matting.TOLERANCE
    holes: str = "auto"
    mask: Path | None = None
    fps: float | None = None
    on_error: str = "stop"
    name: str = ""
    pattern: str = ""
    elevation: float = 0.0
    radius: float = DEFAULT_RADIUS
    fovy: float = float(np.rad2deg(DEFAULT_FOVY))
    views: Path | None = None
    views_cameras: Path | None = None

    def __post_init__(self) -> None:
        for option, value, low, high in (
            ("--border", self.border, 0.0, 0.9),
            ("--tolerance", self.tolerance, 0.0, 0.5),
        ):
            if not low <= value <= high:
                raise UsageError(f"{option} {value:g}: expected {low:g} to {high:g}")
        if not (self.radius > 0 and 0 < self.fovy < 180 and abs(self.elevation) <= 90):
            raise UsageError("--radius > 0, --fovy between 0 and 180 and --elevation within +-90 degrees expected")
        if self.fps is not None and not 0 < self.fps < 10_000:
            raise UsageError(f"--fps {self.fps:g}: expected frames per second, above 0")
        require_known(self, on_error=ON_ERROR)
        if self.holes not in matting.HOLES:
            raise UsageError(f"--holes {self.holes}: expected {', '.join(matting.HOLES)}")
        if self.mask and self.background != "auto":
            raise UsageError("--mask and --background were both given; a mask already says what the object is")
        if self.border != VideoOptions.border and not self.crops:
            raise UsageError(
                f"--border {self.border:g}: belongs to the crop, which --views and --no-recenter leave out"
            )
        if self.views_cameras and not self.views:
            raise UsageError("--views-cameras describes the cameras of --views FOLDER; give both")
        matting.named_background(self.background)

    @property
    def crops(self) -> bool:
        """Returns whether the clip is cropped around the object; beside other views it isn't, since a crop moves the camera."""
        return self.recenter and self.views is None

    @property
    def config(self) -> dict[str, Any]:
        """Returns the options for provenance: paths as they were typed, and no pattern where none was."""
        typed = {key: str(value) if isinstance(value, Path) else value for key, value in asdict(self).items()}
        return {key: value for key, value in typed.items() if value or key != "pattern"}

    def camera(self) -> OrbitCamera:
        """Returns the reference camera: azimuth 0."""
        return OrbitCamera(0.0, float(np.deg2rad(self.elevation)), self.radius, float(np.deg2rad(self.fovy)))


def video_clip(path: Path, options: VideoOptions) -> Clip:
    """Reads the clip of a folder, video or GIF.

    Raises DataError on frames that can't be used; the log says what was chosen.
    """
    frames = open_frames(path, options.pattern)
    tell_cameras_beside(path, options.views_cameras)
    cutter, wanted, crop, size = _plan_clip(frames, options)
    given, cameras = find_given_views(frames, wanted, options)
    all_cameras = [options.camera(), *cameras]
    sizes = [(options.size, options.size) if options.crops else size, *(image_size(paths[0]) for paths in given)]
    header = ViewsHeader(
        options.name or clip_name(path),
        np.stack([_lens(camera.fovy, own, options.size) for camera, own in zip(all_cameras, sizes, strict=True)]),
        np.stack([orbit_pose(camera.azimuth, camera.elevation, camera.radius) for camera in all_cameras]),
        _times(frames, wanted, options.fps),
        ["reference", *(camera.role for camera in cameras)],
        0,
        (options.size, options.size),
    )

    def pictures() -> Iterator[tuple[int, int, np.ndarray]]:
        for row, rgba in enumerate(cutter.cut(wanted)):
            yield 0, row, crop.apply(rgba, options.size)
        for view, paths in enumerate(given, 1):
            for row, rgba in enumerate(_given_pictures(paths, options)):
                yield view, row, rgba

    return Clip(header, pictures)


def _lens(fovy: float, picture: tuple[int, int], size: int) -> np.ndarray:
    """Returns intrinsics f64 (3,3) of the square around a whole picture (width, height) whose own height the angle spans."""
    return whole_picture(*picture).intrinsics(pinhole(fovy, *picture), size)


def clip_name(path: Path) -> str:
    """Returns the file's or folder's name, or that of the folder above when it says nothing (`minions/rgba`)."""
    path = path.resolve()
    return path.parent.name if path.is_dir() and path.name.lower() in PICTURE_FOLDERS else path.stem


def video_config(path: Path, options: VideoOptions) -> dict[str, Any]:
    """Returns options and digests of everything read, for provenance: equal configurations give equal files."""
    config = options.config
    frames = open_frames(path, options.pattern, quiet=True)
    config["input_digest"] = digest_of(frames.files)
    if path.is_dir() and frames.times is not None and options.fps is None:  # those of a video are in its bytes
        config["times_digest"] = hashlib.sha256(np.array(frames.times).tobytes()).hexdigest()[:16]
    if options.mask:
        masks = require_folder(options.mask, "a mask per frame") if not options.mask.is_file() else None
        config["mask_digest"] = digest_of(image_paths(masks) if masks else [options.mask])
    if options.views:
        folder = require_folder(options.views, "pictures of other views")
        config["views_digest"] = digest_of(
            p for one in sorted(folder.iterdir()) if one.is_dir() for p in image_paths(one)
        )
    if options.views_cameras:
        config["cameras"] = [asdict(camera) for camera in read_cameras(options.views_cameras)]
    return config


@dataclass
class Cutter:
    """Cuts the object out of frames: by its own alpha, a mask, a plain background's color, or not at all (keep)."""

    frames: Frames
    options: VideoOptions
    mode: str
    background: np.ndarray | None = None
    masks: tuple[Path, ...] | Frames = ()
    gaps: dict[int, int] = field(default_factory=dict)  # pixels taken for holes, by frame
    kept: dict[int, Piece] = field(default_factory=dict)  # frames that were cut already, as far as they fit

    def cut(self, wanted: list[int]) -> Iterator[np.ndarray]:
        """Yields u8 (H,W,4), straight alpha, of the frames `wanted`, rising. What fits into memory is cut but once."""
        anew = self._cut_anew([index for index in wanted if index not in self.kept])
        size = sum(piece.rgba.nbytes for piece in self.kept.values())
        for index in wanted:
            if index in self.kept:
                yield self.kept[index].whole()
                continue
            piece = Piece.of(rgba := next(anew))
            size += piece.rgba.nbytes
            if size <= _KEPT:
                self.kept[index] = piece
            yield rgba

    def _cut_anew(self, wanted: list[int]) -> Iterator[np.ndarray]:
        masks = self._read_masks(wanted)
        for index, frame in zip(wanted, self.frames.read(wanted)):
            if self.mode == "mask":
                yield matting.with_alpha(frame, *next(masks), self.frames.names[index])
            elif self.mode == "plain":
                rgba, gap = matting.key_out(frame[..., :3], self.background, self.options.tolerance, self.options.holes)
                self.gaps[index] = gap
                yield rgba
            elif self.mode == "keep":
                yield matting.opaque(frame)
            else:
                yield matting.clear_invisible(frame)

    def _read_masks(self, wanted: list[int]) -> Iterator[tuple[np.ndarray, str]]:
        """Yields the mask u8 (H,W) of each frame, and what it is called in messages."""
        if isinstance(self.masks, Frames):
            for index, rgba in zip(wanted, self.masks.read(wanted)):
                yield mask_of_video(self.masks.path, rgba), f"{self.masks.path}, frame {index}"
        else:
            yield from ((read_mask(self.masks[index]), str(self.masks[index])) for index in wanted)


def _plan_clip(frames: Frames, options: VideoOptions) -> tuple[Cutter, list[int], Crop, tuple[int, int]]:
    """Returns how to cut, which frames, the one crop of them all, and the (width, height) of the source."""
    wanted = _readable(frames, spread_frames(len(frames), options.frames), options.on_error)
    warn_gaps(frames)
    cutter, (width, height) = _make_cutter(frames, wanted, options)
    boxes, cut_off, good, empty, apart, dark, whole, framed = [], [], [], [], [], [], 0, 0
    beside = np.zeros((height, width), np.int32)  # in how many frames a pixel shows something apart from the object
    for index, rgba in zip(wanted, cutter.cut(wanted)):
        box = visible_box(rgba[..., 3], _ISLAND)
        if box is None:
            empty.append(index)
            continue
        boxes.append(box)
        good.append(index)
        framed += fills_sides(rgba[..., 3], box)
        whole += cutter.mode == "mask" and rgba[..., 3].min() > 127
        if cutter.mode != "keep" and touches_border(rgba[..., 3]):
            cut_off.append(index)
        count, rest = pieces(rgba[..., 3], _OBJECT)
        beside += rest
        if count > 1:
            apart.append(index)
        if cutter.mode == "alpha" and matting.fades_to_black(rgba):
            dark.append(index)
    _report_empty(frames, empty, good, cutter.mode, options.on_error)
    if whole == len(good):
        raise DataError(
            f"{options.mask}: every mask covers its whole picture, so nothing is cut out; the background has to be black, or "
            "label 0 (the whole picture: --background keep)"
        )
    half = len(good) / 2
    if cutter.mode != "keep" and 1 < framed == len(good) and _tell_bars(frames, boxes):
        cut_off = []
    _tell_doubts(cutter, cut_off, apart if len(apart) > half else [], dark if len(dark) > half else [])
    if len(good) == 1:
        log.warn(f"{frames.path}: one frame only; this makes a still object, motion needs two or more")
    crop = crop_around(union(boxes), options.border) if options.crops else whole_picture(width, height)
    if options.recenter and not options.crops:
        log.info(f"{frames.path}: not cropped, so that its camera stays as the other views' cameras expect it")
    if cutter.mode != "keep" and len(good) > 1 and (logo := still_box(crop.part_of(beside), len(good))):
        log.warn(
            f"{frames.path}: something apart from the object stands still in {logo[2] - logo[0]}x{logo[3] - logo[1]} pixels at"
            f" ({logo[0] + max(crop.left, 0)}, {logo[1] + max(crop.top, 0)}), as a logo does; it is taken for part of the object:"
            " paint it over, or give --mask FOLDER"
        )
    if crop.side < options.size / 1.5:
        log.warn(f"{frames.path}: the object covers few pixels: {crop.side} are enlarged to --size {options.size}")
    log.info(
        f"{frames.path}: {len(good)} of {counted(len(frames), 'frame')}, {width}x{height}; object from {_how(cutter)}; "
        f"square of {crop.side} at ({crop.left}, {crop.top})"
    )
    return cutter, good, crop, (width, height)


def _tell_doubts(cutter: Cutter, cut_off: list[int], apart: list[int], dark: list[int]) -> None:
    """Warns of the frames in which the object is cut off, lies in pieces apart, or fades to black, and tells of its gaps."""
    frames = cutter.frames
    if cut_off:
        log.warn(f"{frames.path}: the object leaves the picture in {_named(frames, cut_off)}; what is cut off is lost")
    if apart:
        log.warn(
            f"{frames.path}: several objects apart in {_named(frames, apart)}; everything after this takes them for one."
            " Cut one out with --mask FOLDER"
        )
    if dark:
        log.warn(
            f"{frames.path}: colors fade to black with the alpha in {_named(frames, dark)}, as those that were multiplied by it; they"
            " are taken as they are, so the outline will be dark; export straight (unassociated) alpha"
        )
    if cutter.options.holes == "auto" and any(cutter.gaps.values()):
        count = sum(gap > 0 for gap in cutter.gaps.values())
        log.info(
            f"{frames.path}: gaps in the object are see-through in {counted(count, 'frame')} (--holes keep fills them)"
        )


def _tell_bars(frames: Frames, boxes: list[Box]) -> bool:
    """Warns of rectangles (boxes of the object, all filled) that are the same in all frames, and returns whether they are."""
    if np.ptp(boxes, axis=0).max() > _STILL:
        return False
    left, top, right, bottom = union(boxes)
    log.warn(
        f"{frames.path}: what is cut out is the same rectangle in all frames, as a picture between bars is; where the object lies"
        f" within it, cut the bars off first: ffmpeg -i IN -vf crop={right - left}:{bottom - top}:{left}:{top} OUT"
    )
    return True


def _how(cutter: Cutter) -> str:
    if cutter.mode == "plain":
        return "background " + ",".join(f"{value:.0f}" for value in cutter.background)
    return {"alpha": "the frames' alpha", "mask": "masks", "keep": "nothing: the background is kept"}[cutter.mode]


def spread_frames(total: int, count: int) -> list[int]:
    """Returns at most `count` of `total` indices, evenly spread from the first to the last; all for 0.

    >>> spread_frames(10, 4)
    [0, 3, 6, 9]
    """
    if count == 0 or count >= total:
        return list(range(total))
    return np.linspace(0, total - 1, count).round().astype(int).tolist()


def _readable(frames: Frames, wanted: list[int], on_error: str) -> list[int]:
    """Returns the frames without the images that cannot be read when --on-error is skip."""
    if on_error == "stop" or not frames.path.is_dir():
        return wanted
    good = []
    for index in wanted:
        try:
            read_rgba(frames.files[index])
            good.append(index)
        except DataError as error:
            log.warn(f"left out: {error}")
    if not good:
        raise DataError(f"{frames.path}: none of its frames ({len(wanted)}) can be read")
    return good


def _require_one_size(frames: Frames, wanted: list[int], sizes: list[tuple[int, int]]) -> None:
    for index, size in zip(wanted, sizes):
        if size != sizes[0]:
            first, here = (f"{width}x{height}" for width, height in (sizes[0], size))
            raise DataError(
                f"{frames.path}: {frames.names[index]} is {here}, {frames.names[wanted[0]]} is {first}\n"
                "One crop serves the whole clip: export all frames at one size"
            )


def warn_gaps(frames: Frames) -> None:
    """Says in the log where the numbers of frames jump, unless their times are known, which show it."""
    if frames.times is not None:
        return
    steps = np.diff(frames.numbers)
    if len(steps) > 1 and (steps != np.median(steps)).any():
        at = int(np.argmax(steps != np.median(steps)))
        log.warn(
            f"{frames.path}: {frames.names[at + 1]} follows {frames.names[at]}: frames seem to be missing; "
            "times count those that are there as evenly spaced"
        )


def _make_cutter(frames: Frames, wanted: list[int], options: VideoOptions) -> tuple[Cutter, tuple[int, int]]:
    """Looks at every frame once: one size, alpha or none, what is around the object."""
    shape, borders, clear, seen = None, [], [], False
    if frames.path.is_dir():  # by their headers first: a damaged one may tell of 16 million pixels
        _require_one_size(frames, wanted, [image_size(frames.files[index]) for index in wanted])
    for index, frame in zip(wanted, frames.read(wanted)):
        shape = shape or frame.shape
        _require_one_size(frames, [wanted[0], index], [shape[1::-1], frame.shape[1::-1]])
        clear.append(bool((frame[..., 3] < 255).any()))
        seen = seen or bool(frame[..., 3].any())
        borders.append(matting.border_pixels(frame[..., :3]))
    size = (shape[1], shape[0])
    if options.mask:
        return Cutter(frames, options, "mask", masks=find_masks(frames, options.mask)), size
    if options.background == "keep":
        return Cutter(frames, options, "keep"), size
    if not seen:  # programs that write four bytes a pixel may leave the fourth empty
        log.info(f"{frames.path}: its alpha is 0 everywhere, which is none; read as opaque")
    elif any(clear):
        if not all(clear):
            without = [index for index, has in zip(wanted, clear) if not has]
            raise DataError(f"{frames.path}: {_named(frames, without)} without alpha, though other frames have it")
        if options.background != "auto":
            raise UsageError(f"--background {options.background}: the frames have alpha; leave the option out, or keep")
        return Cutter(frames, options, "alpha"), size
    names = [f"{frames.path}, {frames.names[index]}" for index in wanted]
    return Cutter(
        frames, options, "plain", matting.background_color(borders, names, options.background, options.tolerance)
    ), size


def open_masks(place: Path) -> Frames:
    """Opens the masks of a folder or a video. Raises DataError when there are none."""
    if place.is_file():
        return open_frames(place)
    folder = require_folder(place, "a mask per frame, as images, or a video")
    if not image_paths(folder) and (
        other := [p.name for p in sorted(folder.iterdir()) if p.suffix.lower() in _ANNOTATIONS]
    ):
        raise DataError(
            f"{place}: {first_names(other, 3)}: annotations and arrays are not read as masks; draw each frame's as a PNG, "
            '255 where the object is (labelme_export_json, CVAT\'s "Segmentation mask" and the like do it)'
        )
    return open_frames(folder)


def find_masks(frames: Frames, folder: Path) -> tuple[Path, ...] | Frames:
    """Finds a mask for every frame of the clip: by number where all numbers agree, else in order; a video's in order."""
    masks = open_masks(folder)
    numbered = folder.is_dir() and all(number in integers(name) for number, name in zip(masks.numbers, masks.names))
    if numbered and set(masks.numbers) >= set(frames.numbers) and len(set(masks.numbers)) == len(masks):
        place = dict(zip(masks.numbers, masks.files))
        return tuple(place[number] for number in frames.numbers)
    if len(masks) != len(frames):
        raise DataError(
            f"{folder}: {counted(len(masks), 'mask')} for {counted(len(frames), 'frame')}; expected one for each, named alike,"
            " with all its objects"
        )
    if folder.is_dir() and masks.numbers != frames.numbers:
        pairs = [f"{masks.names[at]} for {frames.names[at]}" for at in (0, -1)]
        log.info(f"{folder}: its numbers are not those of the frames; masks in order: {pairs[0]} to {pairs[1]}")
    return masks.files if folder.is_dir() else masks


def _report_empty(frames: Frames, empty: list[int], good: list[int], mode: str, on_error: str) -> None:
    if not empty:
        return
    why = {"plain": "one color only", "mask": "an empty mask", "alpha": "fully transparent"}.get(mode, "empty")
    if not good:
        raise DataError(f"{frames.path}: no object in any frame: each is {why}; is --tolerance too large?")
    text = f"{frames.path}: no object in {_named(frames, empty)} ({why})"
    if on_error == "stop":
        raise DataError(f"{text}\nRemove what is empty, or leave it out with --on-error skip")
    log.warn(f"{text}; left out")


def _named(frames: Frames, indices: list[int]) -> str:
    names = first_names([frames.names[index] for index in indices], _LISTED)
    return f"{len(indices)} {'frame' if len(indices) == 1 else 'frames'}: {names}"


def _times(frames: Frames, wanted: list[int], fps: float | None) -> np.ndarray:
    """Returns seconds f64 (T) from the first frame that is used."""
    if fps is None and frames.times is None:
        log.info(f"{frames.path}: no frame rate; {FOLDER_FPS:g} per second assumed (--fps)")
    rate = fps or FOLDER_FPS
    times = np.array(wanted) / rate if fps or frames.times is None else np.array(frames.times)[wanted]
    return times - times[0]


def find_given_views(
    frames: Frames, wanted: list[int], options: VideoOptions
) -> tuple[list[list[Path]], list[OrbitCamera]]:
    """Finds pictures [view][frame] of --views for the frames `wanted`, and their cameras.

    Raises DataError when some are missing.
    """
    if not options.views:
        return [], []
    reference = options.camera()
    cameras = None
    if options.views_cameras:
        cameras = read_cameras(options.views_cameras, reference.radius, reference.fovy)
    found = find_views(options.views, cameras, [frames.numbers[index] for index in wanted], len(frames))
    return found, cameras or six_views(reference.radius, reference.fovy)


def _given_pictures(paths: list[Path], options: VideoOptions) -> Iterator[np.ndarray]:
    """Yields them square as they come, so only resized; their own alpha, else their plain background cut away."""
    shape = None
    for path in paths:
        rgba = read_rgba(path)
        shape = shape or rgba.shape
        if rgba.shape != shape:
            raise DataError(f"{path}: {rgba.shape[1]}x{rgba.shape[0]}, other frames of this view {shape[1]}x{shape[0]}")
        rgba = matting.cut_alone(rgba, str(path), options.background, options.tolerance, options.holes)
        if visible_box(rgba[..., 3]) is None:
            raise DataError(f"{path}: no object in this view; generate it again or leave its view out")
        yield whole_picture(rgba.shape[1], rgba.shape[0]).apply(rgba, options.size)
