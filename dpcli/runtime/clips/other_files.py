"""Other files than videos, given for one: told by their first bytes, with what to do."""

from __future__ import annotations

from pathlib import Path

_ARCHIVE = "an archive; unpack it first"
_DRAW = "where it holds annotations, draw their masks into a folder as PNG"
_PICTURE = "which is not read; convert it to PNG"
_BEGINNINGS = (  # what of a file comes where, and what the file then is
    (0, b"PK\x03\x04", _ARCHIVE),
    (0, b"7z\xbc\xaf\x27\x1c", _ARCHIVE),
    (0, b"Rar!", _ARCHIVE),
    (257, b"ustar", _ARCHIVE),
    (0, b"\x1f\x8b", "compressed by gzip; unpack it first, or export it again (a .tgs sticker: as WebM)"),
    (4, b"ftyphe", f"a HEIC picture, {_PICTURE}"),
    (4, b"ftypmif1", f"a HEIF picture, {_PICTURE}"),
    (4, b"JXL ", f"a JPEG XL picture, {_PICTURE}"),
    (0, b"\xff\x0a", f"a JPEG XL picture, {_PICTURE}"),
    (0, b"8BPS", f"a Photoshop picture, {_PICTURE}"),
    (0, b"\x93NUMPY", "an array of NumPy; write its pictures into a folder as PNG"),
    (0, b"\x89HDF", "an HDF5 file; write its pictures into a folder as PNG"),
    (0, b"glTF", "a glTF model, which `dpc prepare animation` reads"),
    (0, b"version https://git-lfs", "a pointer of Git LFS; `git lfs pull` brings the file itself"),
    (0, b"#EXTM3U", "a playlist; name the video that it plays"),
    (0, b"<", "a text, such as a web page in place of a download; download it again"),
    (0, b"{", f"JSON; {_DRAW}, or export a Lottie animation as WebM"),
    (0, b"[", f"JSON; {_DRAW}"),
)
_START = 512


def no_video(path: Path) -> str:
    """Returns what a file is that no decoder takes for a video, and what to do about it."""
    try:
        with open(path, "rb") as file:
            start = file.read(_START).removeprefix(b"\xef\xbb\xbf")
    except OSError as error:
        return str(error.strerror)
    kinds = (kind for at, word, kind in _BEGINNINGS if start.startswith(word, at))
    return next(kinds, "empty, damaged, or of an unknown kind" if start else "empty")
