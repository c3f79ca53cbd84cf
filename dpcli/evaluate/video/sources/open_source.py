"""Opens the video at a path, of any kind: a views file, a Gaussian scene, a folder of images, an array, or a video file."""

from __future__ import annotations

from pathlib import Path

from dpcli.errors import DataError
from dpcli.evaluate.video.sources.media import VIDEO_SUFFIXES, ArraySource, FolderSource, VideoSource
from dpcli.evaluate.video.sources.source import Source
from dpcli.evaluate.video.sources.stored import SceneSource, ViewsSource
from dpcli.store import file_kind

_EXPECTED = "expected a views or gaussians file, a folder of images, an .npy array, or a video file"


def is_media(path: Path) -> bool:
    """Returns whether a path holds a video that is no HDF5 file: a folder, an array or a video file."""
    return path.is_dir() or path.suffix.lower() in (".npy", *VIDEO_SUFFIXES)


def open_source(path: Path, *, truth: Source | None = None) -> Source:
    """Returns the videos at `path`; `truth` gives a Gaussian scene its cameras and times. DataError for anything else."""
    if path.is_dir():
        return FolderSource(path)
    if not path.is_file():
        raise DataError(f"{path}: no such file or folder; {_EXPECTED}")
    if path.suffix.lower() == ".npy":
        return ArraySource(path)
    if path.suffix.lower() in VIDEO_SUFFIXES:
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
