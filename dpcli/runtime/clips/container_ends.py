"""Tells whether a video file stops before the end that its container promises; FFmpeg reads to where the bytes end, silently.

Only lengths are read, so that a file of any size is answered at once. Containers without any promise (MPEG program streams, bare
streams) pass.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

# Files of one clip; others (playlists, lists to join, session descriptions) name further files, which would be opened.
VIDEO_FORMATS = (
    "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,mpegvideo,asf,flv,ogg,yuv4mpegpipe,ivf,h264,hevc,obu,av1,m4v,"
    "dv,mxf,nut,apng,mjpeg,swf,rm"
)
_SEGMENT = b"\x18\x53\x80\x67"  # of Matroska and WebM: all but the header
_NUT_INDEX = bytes.fromhex("4e58dd672f23e64e")
_ASF_HEAD, _ASF_FILE = bytes.fromhex("3026b2758e66cf11"), bytes.fromhex("a1dcab8c47a9cf118ee400c00c205365")
_ASF_SIZE = 40  # bytes from the file properties' name to the file's size
_TS_PACKET, _TS_STAMPED = 188, 192
_OGG_PAGE = 65_307  # bytes at most
_Y4M_SHRUNK = {
    "420": (2, 2),
    "411": (4, 1),
    "422": (2, 1),
    "444": (1, 1),
    "mono": (),
}  # both planes of color, across and down


def ends_early(path: Path) -> bool:
    """Returns whether the last box, packet, page or frame of a video file goes on beyond its end, or its end mark is missing."""
    size = os.path.getsize(path)
    with path.open("rb") as file:
        head = file.read(1024)
        check = next((check for begin, check in _CHECKS if re.match(begin, head, re.DOTALL)), None)
        return check is not None and check(file, head, size)


def empty_frames(path: Path, stream: int) -> int:
    """Returns how many frames of a stream in an AVI have no bytes, so that the one before stays; 0 for other files.

    Programs that capture write them where they dropped a frame; the header counts them.
    """
    names, size, found = (b"%02ddc" % stream, b"%02ddb" % stream), os.path.getsize(path), 0
    with path.open("rb") as file:
        if not re.match(rb"RIFF.{4}AVI ", file.read(12), re.DOTALL):
            return 0
        at = 12
        while at + 8 <= size:
            file.seek(at)
            name, length, kind = file.read(4), int.from_bytes(file.read(4), "little"), file.read(4)
            found += name in names and length == 0
            inside = name == b"RIFF" or name == b"LIST" and kind in (b"movi", b"rec ")
            at += 12 if inside else 8 + length + length % 2
    return found


def promised_frames(path: Path) -> int:
    """Returns how many frames the main header of an AVI with one stream promises; 0 for other files.

    Decoders go by the header of the stream, which may promise fewer.
    """
    with path.open("rb") as file:
        head = file.read(64)
    if not re.match(rb"RIFF.{4}AVI LIST.{8}avih", head, re.DOTALL) or len(head) < 64:
        return 0
    return int.from_bytes(head[48:52], "little") if int.from_bytes(head[56:60], "little") == 1 else 0


def joined_videos(path: Path) -> int:
    """Returns how many videos of MP4 or QuickTime a file holds one behind another, of which decoders read the first, or in pieces
    a part of the others; 0 for other files.
    """
    with path.open("rb") as file:
        if file.read(8)[4:] != b"ftyp":
            return 0
        return sum(name == b"ftyp" for name, _ in _each_box(file, os.path.getsize(path)))


def pictures_in(path: Path) -> int:
    """Returns how many pictures lie in an APNG or animated WebP, whatever its header counts; 0 for other files."""
    found, size = 0, os.path.getsize(path)
    with path.open("rb") as file:
        start = file.read(12)
        png = start.startswith(b"\x89PNG")
        if not png and start[8:] != b"WEBP":
            return 0
        at = 8 if png else 12
        while at + 8 <= size:
            file.seek(at)
            one, two = file.read(4), file.read(4)
            name, length = (two, int.from_bytes(one, "big") + 4) if png else (one, int.from_bytes(two, "little"))
            found += name in (b"fcTL", b"ANMF")
            at += 8 + length + (length % 2 if not png else 0)
    return found


def _goes_on(ends: Iterator[int], size: int) -> bool:
    """Returns whether the last of the places where parts end lies beyond the file."""
    last = 0
    for last in ends:
        if last > size:
            return True
    return last < size


def _each_box(file: BinaryIO, size: int) -> Iterator[tuple[bytes, int]]:
    """Yields the name of each box of MP4 and QuickTime, one after the other with its length before it, and where it ends."""
    at = 0
    while at + 8 <= size:
        file.seek(at)
        length, name, long = int.from_bytes(file.read(4), "big"), file.read(4), file.read(8)
        length = int.from_bytes(long, "big") if length == 1 else length or size - at
        at += max(length, 8)
        yield name, at


def _boxes(file: BinaryIO, _head: bytes, size: int) -> bool:
    """Checks MP4 and QuickTime; zeros may fill the rest."""
    at = max((end for _, end in _each_box(file, size)), default=0)
    file.seek(min(at, size))
    return at > size or any(file.read(8))


def _matroska(_file: BinaryIO, head: bytes, size: int) -> bool:
    at = head.find(_SEGMENT)
    if at < 0 or at + 12 > len(head):
        return size < len(head)
    width = 9 - head[at + 4].bit_length()
    length = int.from_bytes(head[at + 4 : at + 4 + width], "big") & ((1 << 7 * width) - 1)
    unknown = length == (1 << 7 * width) - 1  # of a live recording
    return not unknown and at + 4 + width + length > size


def _riff(file: BinaryIO, _head: bytes, size: int) -> bool:
    at = 0
    while at + 8 <= size:
        file.seek(at)
        name, length = file.read(4), int.from_bytes(file.read(4), "little")
        if name != b"RIFF" or length in (0, 0xFFFFFFFF):  # never closed, as live recordings are; or something behind it
            return False
        at += 8 + length
    return at > size


def _transport_stream(_file: BinaryIO, head: bytes, size: int) -> bool:
    packet = _TS_PACKET if head[_TS_PACKET : _TS_PACKET + 1] == b"\x47" else _TS_STAMPED
    return size % packet != 0


def _nut(file: BinaryIO, _head: bytes, size: int) -> bool:
    file.seek(max(size - 12, 0))
    back = int.from_bytes(file.read(8), "big")
    file.seek(max(size - back, 0))
    return file.read(len(_NUT_INDEX)) != _NUT_INDEX


def _flash(file: BinaryIO, head: bytes, size: int) -> bool:
    def ends() -> Iterator[int]:
        at = int.from_bytes(head[5:9], "big") + 4
        yield at
        while at < size:
            file.seek(at + 1)
            at += 11 + int.from_bytes(file.read(3), "big") + 4
            yield at

    return _goes_on(ends(), size)


def _ogg(file: BinaryIO, _head: bytes, size: int) -> bool:
    file.seek(max(size - _OGG_PAGE, 0))
    tail = file.read()
    page = tail[max(tail.rfind(b"OggS"), 0) :]
    lengths = page[27 : 27 + page[26]] if len(page) > 27 else b""
    return not lengths or len(page) < 27 + len(lengths) + sum(lengths) or not page[5] & 4  # the mark of the last page


def _asf(_file: BinaryIO, head: bytes, size: int) -> bool:
    at = head.find(_ASF_FILE) + _ASF_SIZE
    return at >= _ASF_SIZE and int.from_bytes(head[at : at + 8], "little") > size


def _yuv4mpeg(file: BinaryIO, head: bytes, size: int) -> bool:
    first = head.split(b"\n", 1)[0]
    found = {word[:1]: word[1:].decode("latin-1") for word in first.split(b" ")[1:] if word}
    shrunk = next((by for name, by in _Y4M_SHRUNK.items() if found.get(b"C", "420").startswith(name)), None)
    sides = [found.get(key, "") for key in (b"W", b"H")]
    if shrunk is None or not all(side.isdigit() for side in sides):
        return False
    deep = 2 if re.search(r"(p|mono)(9|1\d)", found.get(b"C", "")) else 1
    width, height = map(int, sides)
    colors = 2 * -(-width // shrunk[0]) * -(-height // shrunk[1]) if shrunk else 0
    frame = (width * height + colors) * deep

    def ends() -> Iterator[int]:
        at = len(first) + 1
        while at < size:
            file.seek(at)
            at += len(file.readline(1024)) + frame
            yield at

    return _goes_on(ends(), size)


_CHECKS: tuple[tuple[bytes, Callable[[BinaryIO, bytes, int], bool]], ...] = (
    (rb".{4}(ftyp|moov|mdat|free|wide|skip|pnot)", _boxes),
    (rb"\x1aE\xdf\xa3", _matroska),
    (rb"RIFF.{4}AVI ", _riff),
    (rb"\x47.{187}\x47|.{4}\x47.{191}\x47", _transport_stream),
    (rb"nut/multimedia container", _nut),
    (rb"FLV\x01", _flash),
    (rb"OggS", _ogg),
    (re.escape(_ASF_HEAD), _asf),
    (rb"YUV4MPEG2 ", _yuv4mpeg),
)
