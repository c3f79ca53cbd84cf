"""Margins that a video file hides: those around the clean aperture of MP4 and QuickTime, PixelCrop of Matroska.

FFmpeg's decoders leave cropping to the program that shows the frames, and PyAV exposes neither it nor other boxes.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

Margins = tuple[int, int, int, int]  # left, right, top, bottom: pixels that aren't shown

_NONE: Margins = (0, 0, 0, 0)
_FIRST = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
_IN_TRACK = (b"mdia", b"minf", b"stbl", b"stsd")
_ENTRY, _SAMPLE_TABLE = 86, 16  # bytes before the boxes in a video's sample entry, and before those entries
_EBML = b"\x1aE\xdf\xa3"
_SEGMENT, _TRACKS, _TRACK, _VIDEO = 0x18538067, 0x1654AE6B, 0xAE, 0xE0
_CROPS = (0x54CC, 0x54DD, 0x54BB, 0x54AA)
_MOST = 1 << 16  # bytes of a box, and parts on a level, that are looked at


def margins(path: Path, place: int, size: tuple[int, int]) -> Margins:
    """Returns what isn't shown of the video at this place (0: the first) of a file, whose frames are of (width, height).

    None where the file says nothing, or nothing that leaves a picture.
    """
    if aperture := entry_box(path, place, (b"clap",)):
        found = _aperture(aperture, size)
    else:
        with path.open("rb") as file:
            found = _of_matroska(file, os.path.getsize(path), place) if file.read(4) == _EBML else _NONE
    left, right, top, bottom = found
    whole = min(found) >= 0 and left + right < size[0] and top + bottom < size[1]
    return found if whole else _NONE


def _boxes(file: BinaryIO, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Yields name, start of the content and end of the boxes in a part of the file."""
    for _ in range(_MOST):
        file.seek(start)
        head = file.read(16)
        length, name, inside = int.from_bytes(head[:4], "big"), head[4:8], start + 8
        if length == 1:
            length, inside = int.from_bytes(head[8:16], "big"), start + 16
        length = length or end - start
        if len(head) < 8 or length < 8 or start + length > end:
            return
        yield name, inside, start + length
        start += length


def entry_box(path: Path, place: int, names: tuple[bytes, ...]) -> bytes:
    """Returns the first box of these names that describes the video at this place (0: the first) of an MP4 or QuickTime file,
    without its head; nothing where there is none.
    """
    with path.open("rb") as file:
        entries = list(_entries(file, os.path.getsize(path))) if file.read(8)[4:] in _FIRST else []
        for name, start, stop in _boxes(file, *entries[place]) if place < len(entries) else ():
            if name in names:
                file.seek(start)
                return file.read(min(stop - start, _MOST))
    return b""


def _entries(file: BinaryIO, end: int) -> Iterator[tuple[int, int]]:
    """Yields where the boxes that describe each video of a file begin and end."""
    movie = next(((start, stop) for name, start, stop in _boxes(file, 0, end) if name == b"moov"), None)
    tracks = [(start, stop) for name, start, stop in _boxes(file, *movie) if name == b"trak"] if movie else []
    for part in tracks:
        parts = {b"trak": part}
        for above, name in zip((b"trak", *_IN_TRACK), _IN_TRACK):
            parts |= {own: (start, stop) for own, start, stop in _boxes(file, *parts.get(above, (0, 0))) if own == name}
        if b"stsd" not in parts or not any(name == b"vmhd" for name, *_ in _boxes(file, *parts[b"minf"])):
            continue
        start = parts[b"stsd"][0] + _SAMPLE_TABLE - 8
        entry = next(_boxes(file, start, parts[b"stsd"][1]), (b"", 0, 0))
        yield entry[1] - 8 + _ENTRY, entry[2]


def _aperture(data: bytes, size: tuple[int, int]) -> Margins:
    """Returns the margins of a clean aperture: its size and how far its middle lies from the frame's, as fractions."""
    numbers = struct.unpack_from(">8i", data) if len(data) >= 32 else (0,) * 8
    if not all(numbers[1::2]):
        return _NONE
    width, height, across, down = (a / b for a, b in zip(numbers[::2], numbers[1::2]))
    left, top = (size[0] - width) / 2 + across, (size[1] - height) / 2 + down
    return round(left), round(size[0] - left - width), round(top), round(size[1] - top - height)


def _elements(file: BinaryIO, start: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Yields number, start of the content and end of the EBML elements in a part of the file."""
    for _ in range(_MOST):
        file.seek(start)
        head = file.read(12)
        if len(head) < 2 or start >= end or not head[0]:
            return
        wide = 9 - head[0].bit_length()
        long = 9 - head[wide].bit_length() if wide < len(head) and head[wide] else 9
        if wide > 4 or wide + long > len(head):
            return
        length = int.from_bytes(head[wide : wide + long], "big") & ((1 << 7 * long) - 1)
        inside = start + wide + long
        stop = end if length == (1 << 7 * long) - 1 else min(inside + length, end)
        yield int.from_bytes(head[:wide], "big"), inside, stop
        start = stop


def _of_matroska(file: BinaryIO, end: int, place: int) -> Margins:
    part = (0, end)
    for wanted in (_SEGMENT, _TRACKS):
        part = next(((start, stop) for name, start, stop in _elements(file, *part) if name == wanted), (0, 0))
    found = []
    for name, *track in _elements(file, *part):
        videos = [(start, stop) for own, start, stop in _elements(file, *track) if own == _VIDEO and name == _TRACK]
        for video in videos[:1]:
            values = dict.fromkeys(_CROPS, 0)
            for own, start, stop in _elements(file, *video):
                if own in values:
                    file.seek(start)
                    values[own] = int.from_bytes(file.read(min(stop - start, 8)), "big")
            found.append(tuple(values.values()))
    return found[place] if place < len(found) else _NONE
