"""Anybody's depth video: video files, folders of depth images, or arrays, to points in meters (camera axes OpenCV)."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.path_names import as_utf8, first_names
from dpcli.prepare.actions.depth_units import (
    doubts_of_marks,
    doubts_of_name,
    doubts_of_place,
    doubts_of_shape,
    doubts_of_units,
    require_byte_order,
    require_plausible,
    usual_scale,
    without_marks,
)
from dpcli.prepare.array_files.containers import made_by_dpc
from dpcli.prepare.array_files.depth_arrays import says_depth
from dpcli.prepare.decode.depth_files import (
    ARRAY_SUFFIXES,
    VIDEO_SUFFIXES,
    DepthVideo,
    frame_series,
    read_depth_video,
    require_depth,
    tells_times,
)
from dpcli.prepare.decode.folder_listing import (
    calibrations_below,
    count_suffixes,
    poses_below,
    scales_below,
    stores,
    walk_folders,
)
from dpcli.prepare.decode.pinhole_camera import Intrinsics, back_project, count_blind
from dpcli.prepare.labels import LabelTable, labels_of_folders, read_labels
from dpcli.prepare.reader import Item, Reader, Sample, natural_key, sample_of_frames
from dpcli.prepare.recordings.recording import find_recordings, is_recording
from dpcli.prepare.series import Series, about_series, is_hidden
from dpcli.prepare.times_beside import with_times

if TYPE_CHECKING:
    from dpcli.prepare.decode.pinhole_camera import Calibration

MISSING = "frames that videos declare and don't hold (truncated or damaged)"
CUT = "videos that end before their container does (truncated: frames may be lost)"
BLIND = "pixels with a depth that no ray reaches through the lens of the calibration (of another camera?) dropped"
_FARTHEST = 300.0  # meters
DEFAULT_FOV = 60.0  # degrees; between Kinect v1 (57) and most depth cameras of today (65 to 75)
BACKGROUNDS = ("none", "median", "first")
_OTHER_PICTURES = re.compile(
    r"vis|colou?r|preview|rgb|jet|mask|conf|normal|amplitude|intensity|label|disparit|semantic|instance|segm|albedo|flow|image|photo"
    r"|(?<![a-z])seg(?![a-z])|infra|thermal|reflect|ambient|uncertain|varianc|fisheye|skelet|inerti|temperature|active_?brightness"
    r"|(?<![a-z])(n?ir|lwir|ab|gray|grey|mono)(?![a-z])",
    re.IGNORECASE,
)
_ALIGNED = re.compile(r"align|regist|depth_?(2|to)_?(colou?r|rgb)", re.IGNORECASE)
_CLOUDS = (".ply", ".pcd", ".las", ".laz", ".xyz")  # points, not pictures
_FOREIGN = tuple(  # that may hold depth, and are not read
    ".gif .ts .mts .wmv .flv .mpg .pam .ppm .bmp .zip .gz .7z .rar .tar .jpg .jpeg .webp .raw .bin .oni .svo"
    " .svo2 .r3d .sens .xef .klg .dpt .depth .dat .pkl .vrs .rrd .nc .zarr".split()
)
_HALF_OF_16_BITS = 1 << 15  # below, inverted millimeters are farther than depth cameras see
_BACKGROUND_FRAMES = 64  # the median of more changes nothing but the time it takes


def background_depth(depth: np.ndarray, kind: str) -> np.ndarray:
    """Returns the depth of the still scene, (H,W), 0 where nothing was ever seen, of depth (T,H,W), 0 = nothing seen.

    ``median``: per pixel, the lower median of the frames in which something was seen; ``first``: the first frame.
    """
    if kind == "first":
        return depth[0]
    some = depth[np.linspace(0, len(depth) - 1, min(len(depth), _BACKGROUND_FRAMES)).astype(int)]
    seen = np.count_nonzero(some, axis=0)
    ordered = np.sort(some, axis=0)  # the unseen zeros come first
    middle = len(some) - seen + np.maximum(seen - 1, 0) // 2
    return np.take_along_axis(ordered, np.minimum(middle, len(some) - 1)[None], axis=0)[0]


@dataclass(frozen=True, kw_only=True)
class DepthVideos(Reader):
    """Reads anybody's depth videos.

    Lengths in meters, focal lengths and centers in pixels, the field of view in degrees.
    """

    inputs: tuple[Path, ...]
    intrinsics: Intrinsics | None = None
    fov: float | None = None
    depth_scale: float | None = None
    invert: bool = False
    near: float = 0.0
    far: float = float("inf")
    background: str = "none"
    margin: float = 0.05
    fps: float | None = None
    stride: int = 1
    labels: Path | None = None
    label_from_folder: bool = False
    calibration: Calibration | None = None
    pattern: str = ""
    topic: str = ""
    length_unit: ClassVar[str] = "m"

    def __post_init__(self) -> None:
        if self.background not in BACKGROUNDS:
            raise UsageError(f"--background {self.background}: expected one of {', '.join(BACKGROUNDS)}")
        if not 0 <= self.near < self.far:
            raise UsageError(f"--near {self.near:g} --far {self.far:g}: expected 0 <= near < far, in meters")
        if self.depth_scale is not None and not self.depth_scale > 0:
            raise UsageError(f"--depth-scale {self.depth_scale:g}: expected raw units per meter, more than 0")
        if self.fps is not None and not self.fps > 0:
            raise UsageError(f"--fps {self.fps:g}: expected more than 0")
        if not self.margin >= 0:
            raise UsageError(f"--margin {self.margin:g}: expected meters, 0 or more")
        if (self.intrinsics or self.calibration) and self.fov is not None:
            raise UsageError("--fov and intrinsics were both given; use one")
        if self.fov is not None and not 0 < self.fov < 180:
            raise UsageError(f"--fov {self.fov:g}: expected degrees, more than 0 and below 180")
        if self.labels and self.label_from_folder:
            raise UsageError("--labels and --label-from-folder were both given; use one")

    @property
    def class_names(self) -> list[str]:
        return self._table.class_names

    @property
    def config(self) -> dict[str, Any]:
        apart = ("inputs", "labels", "label_from_folder", "far", "calibration", "pattern", "topic")
        values = {k: v for k, v in asdict(self).items() if k not in apart}
        given = {"label_from_folder": self.label_from_folder, "pattern": self.pattern, "topic": self.topic}
        if self.calibration:
            given["calibration"] = {k: v for k, v in asdict(self.calibration).items() if k not in ("source", "chosen")}
        return {**values, "far": self.far if np.isfinite(self.far) else None, **{k: v for k, v in given.items() if v}}

    @property
    def fields(self) -> tuple[str, ...]:
        """Returns ``time`` when the seconds of every frame are known."""
        return ("time",) if self._timed else ()

    @cached_property
    def _timed(self) -> bool:
        """Returns whether the time of every frame is known: by ``fps``, by time stamps, or because all names are times."""
        return self.fps is not None or all(_tells_time(item) for item in self._found)

    @cached_property
    def _table(self) -> LabelTable:
        if self.label_from_folder:
            return labels_of_folders(self.inputs[0], [item.name for item in self._found], "CLASS/VIDEO")
        return read_labels(self.labels) if self.labels else LabelTable()

    @cached_property
    def _chosen(self) -> tuple[list[tuple[Path, Series | None, Path]], list[str]]:
        """Returns the videos with their series and the inputs they come from, and the names of what only lies beside them."""
        kept, left_out = [], []
        for given in self.inputs:
            found = find_videos(given, self.pattern)
            beside = pictures_beside_depth({path.relative_to(given): series for path, series in found})
            left_out += [as_utf8(path.as_posix()) for path in sorted(beside)]
            kept += [(path, series, given) for path, series in found if path.relative_to(given) not in beside]
        return kept, left_out

    @cached_property
    def _found(self) -> list[Item]:
        items: dict[str, Item] = {}
        for path, series, given in self._chosen[0]:
            name = as_utf8(path.relative_to(given).as_posix() if path != given else path.name)
            if name in items:
                raise DataError(
                    f"{path}: another input is called {name!r}, too ({items[name].path}); rename one, or give the folder"
                    " that holds both"
                )
            items[name] = Item(name, path, extra={"series": series, "recording": is_recording(path)})
        if self.topic and not any(item.extra["recording"] for item in items.values()):
            raise UsageError(f"--topic {self.topic}: no recording (.bag, .mcap, .db3) among the inputs; leave it out")
        return list(items.values())

    def items(self) -> list[Item]:
        told = {"timed": self._timed}
        items = [replace(item, extra={**item.extra, **told}) for item in self._found]
        return self._table.apply(items)

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        series: Series | None = item.extra["series"]
        name = f"{item.name} {series.pattern if series else ''}"
        require_depth(item.path, name)
        if self.calibration and self.calibration.chosen and not self.calibration.is_of_colors and _ALIGNED.search(name):
            raise DataError(
                f"{item.path}: by its name its depth was aligned to the color camera, but of the cameras in"
                f" {self.calibration.source} the one called {self.calibration.chosen} is taken; expected --intrinsics of the color"
                " camera: save it as a file of its own"
            )
        video = self._video(item)
        height, width = video.frames.shape[1:]
        odd = doubts_of_shape(item.path, name, width, height)
        camera = self._camera(width, height, video.camera)
        scale, told = self._scale(video)
        depth, notes = without_marks(video.frames)
        require_byte_order(str(item.path), depth)
        notes |= (
            doubts_of_name(name)
            | odd
            | video.notes
            | ({} if told or odd else doubts_of_units(depth) or doubts_of_place(item.path, depth))
        )
        notes |= {} if self.invert or np.isfinite(self.far) else doubts_of_marks(depth)
        depth, unit = self._inverted(depth, item.path), 1 / scale
        notes |= {
            MISSING: video.missing,
            CUT: int(video.ends_early and not video.missing),
            BLIND: count_blind(depth, camera),
        }
        seen = depth
        if self.background != "none":
            depth, unit = depth.astype(np.float32) * np.float32(unit), 1.0
            still = background_depth(depth, self.background)
            depth[(still > 0) & (depth > still - np.float32(self.margin))] = 0
        points, counts = back_project(depth, camera, unit=unit, near=self.near, far=self.far)
        if not counts.any() and (seen > 0).any():
            raise DataError(f"{item.path}: {self._nothing_left(seen[seen > 0] / scale)}")
        require_plausible(str(item.path), points[:, 2], scale, asked=told)
        if item.extra["recording"] and not (video.camera or self._given_camera):
            notes[f"recordings without camera_info of their depth, taken for {DEFAULT_FOV:g} degrees wide (--fov)"] = 1
        return sample_of_frames(item, points, counts, notes, time=self._times(item, video))

    def _nothing_left(self, seen: np.ndarray) -> str:
        """Returns which options took all that was seen, depths in meters."""
        told = [f"--background {self.background} --margin {self.margin:g}"] if self.background != "none" else []
        told += [f"--near {self.near:g} --far {self.far:g}"] if self.near > 0 or self.far < np.inf else []
        span = f"{float(seen.min()):.4g} to {float(seen.max()):.4g} m"
        return f"nothing is left of it; it sees depths of {span}, and {' and '.join(told)} (meters) takes all of them"

    def _video(self, item: Item) -> DepthVideo:
        """Returns the frames of an item, with the camera that a recording describes."""
        if not item.extra["recording"]:
            return read_depth_video(item.path, self.stride, item.extra["series"], with_camera=not self._given_camera)
        from dpcli.prepare.recordings.depth import read_recorded_depth  # which few need, and all would wait for

        read, camera, scale = read_recorded_depth(
            item.path, self.topic, self.stride, with_camera=not self._given_camera
        )
        scale = None if read.frames[0].dtype.kind == "f" else scale  # these are meters
        return DepthVideo(np.stack(read.frames), read.time, notes=read.notes, scale=scale, camera=camera)

    def _times(self, item: Item, video: DepthVideo) -> np.ndarray | None:
        """Returns seconds since the first frame, f64 (T), of the frames that were read; None when they are not known for all."""
        if not item.extra["timed"]:
            return None
        series: Series | None = item.extra["series"]
        if self.fps and series:
            return series.frame_times(self.fps)[:: self.stride]
        if self.fps:
            return np.arange(len(video.frames)) * self.stride / self.fps
        if video.time is None:
            cut = (
                f"truncated, it lacks {counted(video.missing, 'frame')} that it declares, and " if video.missing else ""
            )
            raise DataError(f"{item.path}: {cut}its frames have no time stamps that rise; give their rate with --fps")
        return video.time

    @property
    def _given_camera(self) -> bool:
        return bool(self.intrinsics or self.calibration or self.fov)

    @property
    def _declared_scale(self) -> float | None:
        """Returns raw units per meter as the user or the calibration says them."""
        return self.depth_scale or (self.calibration.depth_scale if self.calibration else None)

    def _scale(self, video: DepthVideo) -> tuple[float, bool]:
        """Returns raw units per meter (the user's, the calibration's, the recording's, or what is usual for the type of
        number) and whether they were given.
        """
        kind = video.frames.dtype
        if self.calibration and not self.depth_scale and kind.kind != "f":
            self.calibration.require_clear_scale()
        told = self._declared_scale or video.scale
        return told or usual_scale(kind), told is not None

    def _inverted(self, frames: np.ndarray, path: Path) -> np.ndarray:
        """Returns depth (T,H,W) as the sensor counts it, 0 = nothing seen."""
        kind = frames.dtype
        if not self.invert:
            return frames
        if kind.kind != "u":
            raise DataError(f"{path}: depths of type {kind}; --invert needs unsigned integers, whose range is known")
        largest = int(frames.max(initial=0))
        if self._declared_scale is None and kind.itemsize == 2 and largest < _HALF_OF_16_BITS:
            raise DataError(
                f"{path}: its raw values end at {largest}, and --invert counts back from {np.iinfo(kind).max}; invert the"
                " bits that it uses before, or give --depth-scale if they are meant so"
            )
        return np.where(frames > 0, np.iinfo(kind).max - frames, 0)

    def _camera(self, width: int, height: int, recorded: Calibration | None) -> Intrinsics:
        """Returns the user's camera, or the one that a recording describes, or one of a usual field of view."""
        calibration = self.calibration or (None if self._given_camera else recorded)
        if calibration:
            return calibration.of_pictures(width, height)
        return self.intrinsics or Intrinsics.from_field_of_view(self.fov or DEFAULT_FOV, width, height)

    def summary(self, items: list[Item]) -> list[str]:
        lines = [f"{counted(len(items), 'depth video')} found"]
        if unread := [
            one for given in self.inputs for one in _not_read(given, {path for path, _, _ in self._chosen[0]})
        ]:
            lines.append(f"not read: {first_names(unread)}")
        if left_out := self._chosen[1]:
            lines.append(f"left out, by their names beside depth: {first_names(left_out)}")
        if not self._given_camera and not all(item.extra["recording"] for item in items):
            lines.append(
                f"no intrinsics given: assuming a horizontal field of view of {DEFAULT_FOV:g} degrees (--fov, --fx ...)"
                " where a file tells none"
            )
            if cameras := [one for given in self.inputs for one in calibrations_below(given)]:
                lines.append(f"{first_names(cameras, 3)}: not read; if the camera is in there, give --intrinsics FILE")
        if poses := [one for given in self.inputs for one in poses_below(given)]:
            lines.append(
                f"{first_names(poses, 3)}: not read; if the camera moved, points stay in its axes of each moment"
            )
        scales = [] if self._declared_scale else [one for given in self.inputs for one in scales_below(given)]
        if scales:
            lines.append(f"{first_names(scales, 3)}: not read; if it tells the unit of depth, give --depth-scale")
        if self.calibration:
            lines += [*self.calibration.notes(), *self._other_cameras(len(items))]
        if _FARTHEST < self.far < np.inf:
            lines.append(f"--far {self.far:g} cuts nothing, no depth camera sees so far; it is in meters")
        if not self._timed:
            silent = [item.name for item in items if not _tells_time(item)]
            lines.append(
                f"no times are written: {first_names(silent, 3)} {'say' if silent[1:] else 'says'} none (--fps)"
            )
        lines += about_series([(item.name, item.extra["series"]) for item in items if item.extra["series"]])
        return lines + self._table.unnamed(items)

    def _other_cameras(self, count: int) -> list[str]:
        """Returns a line for the log where files called as the calibration that is taken for all videos lie beside some."""
        own = Path(self.calibration.source) if self.calibration else Path()
        below = [given.absolute().parent / one for given in self.inputs for one in calibrations_below(given)]
        others = [one for one in below if one.name == own.name and one != own.absolute()]
        if count < 2 or not others or not own.is_file():
            return []
        names = first_names([as_utf8(f"{one.parent.name}/{one.name}") for one in others], 3)
        return [
            f"{own}: is taken for all {count} videos, {names} for none; if these are other cameras, convert the videos of each"
            " by itself, and join them with `dpc prepare merge`"
        ]


def _tells_time(item: Item) -> bool:
    """Returns whether an item says when its frames were taken: by time stamps inside, or by the names of its frames."""
    series: Series | None = item.extra["series"]
    stamped = item.extra["recording"] or item.path.suffix.lower() in VIDEO_SUFFIXES
    return series.times() is not None if series else stamped or tells_times(item.path)


def pictures_beside_depth(videos: Mapping[Path, Series | None]) -> set[Path]:
    """Returns those of some relative paths that hold confidence, color, masks and the like: a part of the path says so, and
    another one at its place says depth; or a folder at its place says depth and names its frames alike, one for one.
    """
    siblings: dict[Path, set[str]] = {}
    for path in videos:
        for part in (path, *path.parents):
            siblings.setdefault(part.parent, set()).add(part.stem)
    with_depth = {folder for folder, names in siblings.items() if any(says_depth(name) for name in names)}
    frames = {  # "d" alone may be the fourth take
        (path.parent, series.stems)
        for path, series in videos.items()
        if series and says_depth(path.stem) and "depth" in path.stem.lower()
    }
    return {
        path
        for path, series in videos.items()
        if any(part.parent in with_depth and _says_other(part.stem) for part in (path, *path.parents))
        or (series and not says_depth(path.stem) and len(series.names) > 1 and (path.parent, series.stems) in frames)
    }


def _says_other(name: str) -> bool:
    return _OTHER_PICTURES.search(name) is not None and not says_depth(name)


def _not_read(root: Path, clips: Collection[Path]) -> list[str]:
    """Returns how many files outside of the clips may hold depth in formats that are not read, by folder, and the folders
    that are empty. A phrase each.
    """
    told = []
    for folder, below, names in walk_folders(root) if root not in clips else ():
        where = "" if Path(folder) == root else f"{as_utf8(Path(folder).relative_to(root).as_posix())}/"
        if where and not below and not any(not is_hidden(name) for name in names):
            told.append(f"{where[:-1]} (empty)")
        below[:] = [name for name in below if Path(folder, name) not in clips]
        found = count_suffixes([*names, *stores(below)], _FOREIGN)
        told += [f"{where}{counted(count, f'{suffix} file')}" for suffix, count in sorted(found.items())]
    return sorted(told, key=natural_key)


def find_videos(path: Path, pattern: str = "") -> list[tuple[Path, Series | None]]:
    """Returns the depth videos that an input names: itself, or what a folder holds (videos, arrays, folders of frames).

    Beside each folder stands the series of its frames. pattern: which files of a folder are its frames.
    """
    if not path.exists():
        raise DataError(f"{path}: no such file or folder")
    if not path.is_dir() or is_recording(path):
        return [(path, None)]
    if own := frame_series(path, pattern):
        return [(path, with_times(own, path))]
    found: list[tuple[Path, Series | None]] = []
    suffixes = (*VIDEO_SUFFIXES, *ARRAY_SUFFIXES)
    found += [(recording, None) for recording in find_recordings(path)]
    clips = {os.fspath(recording) for recording, _ in found}
    # frames are many: they are neither sorted nor asked what they are
    for folder, folders, files in walk_folders(path):
        depth_beside = any(says_depth(name) for name in folders)
        for name in folders:
            own = Path(folder, name)
            try:
                if series := frame_series(own, pattern):
                    found.append((own, with_times(series, path)))
                    clips.add(os.path.join(folder, name))
            except PermissionError:  # it is told as skipped
                pass
            except DataError:  # nobody has to choose among the masks of each object beside depth
                if not (depth_beside and _says_other(name)):
                    raise
                found.append((own, None))
        if folder in clips:
            files = [name for name in files if not name.lower().endswith(ARRAY_SUFFIXES)]  # its frames, or their twins
        named = (Path(folder, name) for name in files if name.lower().endswith(suffixes) and not is_hidden(name))
        found += [(file, None) for file in named if file.is_file() and not made_by_dpc(file)]
    found.sort(key=lambda one: natural_key(one[0].relative_to(path).as_posix()))
    if not found:
        asked = f" whose names fit --pattern '{pattern}'" if pattern else ""
        below = (name for _, folders, files in walk_folders(path) for name in (*files, *stores(folders)))
        there = count_suffixes(below, (*_FOREIGN, *_CLOUDS))
        seen = ", ".join(f"{count} {suffix}" for suffix, count in sorted(there.items()))
        clouds = not any(suffix.endswith(_FOREIGN) for suffix in there)
        advice = (
            "`dpc prepare clouds` reads them"
            if clouds
            else "save their depth as 16-bit PNG, or as .npy (frames, height, width)"
        )
        raise DataError(
            f"{path}: no depth video in it{asked}; expected folders of 16-bit images, .npy, .npz,"
            f" {', '.join(VIDEO_SUFFIXES)}, or recordings (.bag, .mcap, .db3)"
            + (f"; found {seen}: {advice}" if seen else "")
        )
    return found
