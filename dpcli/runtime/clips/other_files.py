"""Files of other kinds than the one that is wanted, told by their first bytes, with what to do: for clips and for models."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from dpcli.errors import DataError

_KINDS = (  # what a file is, what it is treated like, and what then comes where in it
    ("a zip archive", "archive", 0, b"PK\x03\x04"),
    ("a 7z archive", "archive", 0, b"7z\xbc\xaf\x27\x1c"),
    ("a rar archive", "archive", 0, b"Rar!"),
    ("a tar archive", "archive", 257, b"ustar"),
    ("packed by gzip (a .tgs sticker, or a compressed Blender file)", "packed", 0, b"\x1f\x8b"),
    ("packed by zstd (a compressed Blender file, perhaps)", "packed", 0, b"\x28\xb5\x2f\xfd"),
    ("a HEIC picture", "picture", 4, b"ftyphe", b"ftypmif1"),
    ("a JPEG XL picture", "picture", 4, b"JXL "),
    ("a JPEG XL picture", "picture", 0, b"\xff\x0a"),
    ("a Photoshop picture", "picture", 0, b"8BPS"),
    ("an EXR picture", "picture", 0, b"v/1\x01"),
    ("a raw picture of a camera, or a TIFF", "picture", 0, b"II*\0", b"MM\0*"),
    ("a piece of a streamed video", "piece", 4, b"styp", b"moof", b"sidx"),
    ("an array of NumPy", "arrays", 0, b"\x93NUMPY"),
    ("HDF5 (Alembic, or a file that dpc made)", "arrays", 0, b"\x89HDF"),
    ("a glTF model", "gltf", 0, b"glTF"),
    ("FBX", "model", 0, b"Kaydara FBX Binary", b"; FBX", b"FBXHeaderExtension"),
    ("USD", "model", 0, b"PXR-USDC", b"#usda"),
    ("a Blender file", "model", 0, b"BLENDER"),
    ("Alembic", "model", 0, b"Ogawa"),
    ("BVH, motion without a surface", "motion", 0, b"HIERARCHY"),
    ("Maya", "program", 0, b"//Maya ASCII", b"FOR4", b"FOR8"),
    ("3ds Max, perhaps", "program", 0, b"\xd0\xcf\x11\xe0"),
    ("a tile of 3D Tiles", "tile", 0, b"b3dm"),
    ("STL", "shape", 0, b"solid"),
    ("PLY", "shape", 0, b"ply"),
    ("a pointer of Git LFS", "pointer", 0, b"version https://git-lfs"),
    ("a playlist", "playlist", 0, b"#EXTM3U"),
    ("text in UTF-16", "wide", 0, b"\xff\xfe"),
    ("a web page", "page", 0, b"<!DOCTYPE html", b"<html"),
    ("XML (COLLADA, perhaps)", "model", 0, b"<?xml", b"<COLLADA"),
    ("a text, such as a web page in place of a download", "page", 0, b"<"),
    ("JSON", "json", 0, b"{", b"["),
)
_START = 512
PAGE = "download it again"
POINTER = "`git lfs pull` brings the file itself"
_MODEL = "for a clip of a model, export glTF 2.0, which `dpc prepare animation` reads"
_DRAW = "where it holds annotations, draw their masks into a folder as PNG, or export a Lottie animation as WebM"
_WRAPPED = {"pointer": POINTER, "archive": "unpack it first", "packed": "unpack it first"}
_FOR_CLIPS = {
    **{"archive": "unpack it first", "packed": "unpack it first, or export it again (a sticker: as WebM)"},
    **{"picture": "which is not read; convert it to PNG", "arrays": "write its pictures into a folder as PNG"},
    **dict.fromkeys(("model", "motion", "program", "tile", "shape"), _MODEL),
    **{"gltf": "which `dpc prepare animation` reads", "playlist": "name the video that it plays", "json": _DRAW},
    **{"pointer": POINTER, "page": PAGE, "wide": "name a video"},
    "piece": "put its beginning before it: cat init.mp4 PIECE ... > clip.mp4",
}


def what_it_is(start: bytes, advice: Mapping[str, str]) -> str:
    """Returns what a file is that begins so, and what to do about it; "" where no beginning tells, or there is no advice.

    advice: what to do with what is treated alike, such as "archive".
    """
    text = start.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    for what, alike, at, *words in _KINDS:
        found = any(start.startswith(word, at) or not at and text.startswith(word.lower()) for word in words)
        if found and alike in advice:
            return f"{what}{', ' if advice[alike].startswith('which') else '; '}{advice[alike]}"
    return ""


def refuse_wrapped(path: Path) -> None:
    """Raises DataError for an archive, or a pointer of Git LFS, in the place of a file of any kind."""
    with open(path, "rb") as file:
        if what := what_it_is(file.read(_START), _WRAPPED):
            raise DataError(f"{path}: {what}")


def stand_in(path: Path) -> DataError | None:
    """Returns the error about a file that could not be read because it only stands in for the data; None of other files."""
    try:
        with open(path, "rb") as file:
            what = what_it_is(file.read(_START), {"pointer": POINTER, "page": PAGE})
    except OSError:
        return None
    return DataError(f"{path}: {what}") if what else None


@contextmanager
def stand_ins_named(path: Path) -> Iterator[None]:
    """Puts the error of `stand_in`, where the file is one, in place of the DataError of whoever reads it."""
    try:
        yield
    except DataError as error:
        raise (stand_in(path) or error) from None


def no_video(path: Path) -> str:
    """Returns what a file is that no decoder takes for a video, and what to do about it."""
    try:
        return known_kind(path) or ("empty, damaged, or of an unknown kind" if path.stat().st_size else "empty")
    except OSError as error:
        return str(error.strerror)


def known_kind(path: Path) -> str:
    """Returns what a file in the place of a clip or a picture of one is, and what to do about it; "" where it doesn't tell.

    Raises OSError for one that can't be opened.
    """
    with open(path, "rb") as file:
        return what_it_is(file.read(_START), _FOR_CLIPS)
