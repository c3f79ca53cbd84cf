"""Cameras that other programs left beside the pictures of a clip: they are not read there, which a warning says."""

from __future__ import annotations

import re
from pathlib import Path

from dpcli.path_names import first_names
from dpcli.prepare.decode.color_frames import PICTURE_FOLDERS
from dpcli.runtime.progress import log

_OF_CAMERAS = (  # names that nothing else has, by COLMAP, LLFF, D-NeRF, nerfstudio, ZJU-MoCap, Panoptic, EasyMocap, Stray
    *("transforms*.json", "poses_bounds.npy", "sparse", "cameras.bin", "cameras.xml", "cameras.sfm", "cameras*.npz"),
    *("annots.npy", "calibration_*.json", "intri.yml", "extri.yml", "camera_matrix.csv", "corrected_cameras"),
)
_PERHAPS = (  # names that other things may have, too
    *("cameras.json", "cameras.txt", "images.txt", "database.db", "camera", "cameras", "cams", "pose", "poses"),
    *("poses.txt", "groundtruth.txt", "traj.txt", "intrinsic", "intrinsics", "extrinsic", "extrinsics"),
)
_OF_METADATA = re.compile(rb'"(poses|camera)"\s*:')  # in metadata.json, as Record3D and Kubric write it
_OF_PICTURES = (  # one for each picture, by RealityCapture, 3D Scanner App and 7-Scenes; and a word in it
    ("*.xmp", b"xcr:"),
    ("*.json", b"cameraPose"),
    ("*pose.txt", b""),
)
_MORE_PICTURES = {"input", "corrected_images", "hdimgs", "train", "val", "test"}
_READ = 1 << 16  # bytes of a text that tell whose it is


def tell_cameras_beside(clip: Path, given: Path | None = None) -> None:
    """Warns of cameras in a clip's folder or the ones above whose names say only that they hold pictures (`rgb/1x`).

    Above a folder or video with a name of its own only what can be nothing else counts. given: a file that is read, which
    isn't told.
    """
    found = [path for path in _beside(clip.resolve()) if given is None or path != given.resolve()]
    if found:
        names = first_names(list(dict.fromkeys(path.name for path in found)))
        log.warn(
            f"{clip}: {names}: not read; the camera of a clip is assumed to stand still; if it moves, the object will seem to."
            " Cameras are read from transforms.json, with a time for each frame"
        )


def _beside(clip: Path) -> list[Path]:
    if not clip.is_dir():
        return _cameras(clip.parent, _OF_CAMERAS)
    found = _cameras(clip, _OF_CAMERAS + _PERHAPS)
    for pattern, word in _OF_PICTURES:
        found += [path for path in sorted(clip.glob(pattern))[:1] if path.is_file() and word in _start(path)]
    place = clip
    while _says_nothing(place.name) and place != place.parent:
        place = place.parent
        found += _cameras(place, _OF_CAMERAS + _PERHAPS)
    return found if place != clip else found + _cameras(clip.parent, _OF_CAMERAS)


def _cameras(place: Path, patterns: tuple[str, ...]) -> list[Path]:
    found = [path for pattern in patterns for path in sorted(place.glob(pattern))]
    metadata = place / "metadata.json"
    return found + ([metadata] if metadata.is_file() and _OF_METADATA.search(_start(metadata)) else [])


def _says_nothing(name: str) -> bool:
    """Returns whether a folder's name says only that it holds pictures, at what scale, or of which camera: `images_4`, `1x`."""
    plain = re.sub(r"_\d+$", "", name.lower())
    return plain in PICTURE_FOLDERS | _MORE_PICTURES or re.fullmatch(r"[\d_]+x?", name) is not None


def _start(path: Path) -> bytes:
    """Returns how a file begins; nothing of one that can't be opened, which only what is converted has to be."""
    try:
        with path.open("rb") as file:
            return file.read(_READ)
    except OSError:
        return b""
