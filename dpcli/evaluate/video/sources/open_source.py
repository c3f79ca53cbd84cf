"""Opens the video at a path, of any kind: a views file, a Gaussian scene, a folder of images, an array, or a video file."""

from __future__ import annotations

from pathlib import Path

from dpcli.errors import DataError
from dpcli.evaluate.video.sources.media import ArraySource, FolderSource, VideoSource
from dpcli.evaluate.video.sources.source import Source
from dpcli.evaluate.video.sources.stored import SceneSource, ViewsSource
from dpcli.regular_files import why_unreadable
from dpcli.runtime.clips.images import IMAGE_SUFFIXES
from dpcli.runtime.clips.video_frames import VIDEO_SUFFIXES
from dpcli.store import file_kind

_CLIPS = (*VIDEO_SUFFIXES, ".gif", ".apng", *IMAGE_SUFFIXES)
_EXPECTED = "expected a views or gaussians file, a folder of images, an .npy array, or a video file"


def is_media(path: Path) -> bool:
    """Returns whether a path holds a video that is no HDF5 file: a folder, an array or a video file."""
    return path.is_dir() or path.suffix.lower() == ".npy" or _is_clip(path)


def _is_clip(path: Path) -> bool:
    """Returns whether a file is taken for a video: by its suffix, or without one, when it is neither HDF5 nor text."""
    if path.suffix or not path.is_file():
        return path.suffix.lower() in _CLIPS
    with open(path, "rb") as file:
        start = file.read(64)
    return bool(start) and not start.startswith(b"\x89HDF\r\n") and any(byte < 9 for byte in start)


def open_source(path: Path, *, truth: Source | None = None) -> Source:
    """Returns the videos at `path`; `truth` gives Gaussian scenes their cameras and times. Raises DataError for others."""
    if path.is_dir():
        return FolderSource(path)
    if not path.is_file():
        raise DataError(f"{path}: {why_unreadable(path) or 'no such file or folder'}; {_EXPECTED}")
    if path.suffix.lower() == ".npy":
        return ArraySource(path)
    if _is_clip(path):
        return VideoSource(path)
    kind = file_kind(path)
    if kind == "views":
        return ViewsSource(path)
    if kind != "gaussians":
        raise DataError(f"{path}: holds {kind!r}; {_EXPECTED}")
    if truth is None:
        raise DataError(f"{path}: a Gaussian scene has no pictures, so it can't be the truth; give the views file")
    if not isinstance(truth, ViewsSource):
        raise DataError(
            f"{truth.path}: a {truth.kind} has no cameras to render {path} with; give the views file, "
            "or render the scene first (`dpc generate4d render`)"
        )
    return SceneSource(path, truth.header, truth.path)
