"""Gaussians in the files of players, their centers and colors: `.splat` (antimatter15), `.spz` (Niantic, versions 1 to 3), and
the columns of a `.ply` that SuperSplat compressed.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.cloud import Cloud, color_of_harmonics

_SPLAT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quaternion", "u1", 4)])
_HEAD = struct.Struct("<IIIBBBB")  # magic, version, Gaussians, degree, bits of the fraction, flags, nothing
_MAGIC = 0x5053474E
_REST = {1: 10, 2: 10, 3: 11}  # bytes of a Gaussian after its center, by version: opacity, color, scales, rotation
_COLOR_SCALE = 0.15  # of the color's harmonics in a byte
_PACKED_AT_MOST = 1100  # times that zlib makes anything smaller
_IN_CHUNK = 256  # Gaussians that SuperSplat packs between the same ends
_UNREAD = ("opacity, size and rotation of Gaussians (no names)",)


def read_splat(path: Path, keep: Sequence[str] = ()) -> Cloud:
    """Reads centers and colors of a ``.splat``. Raises DataError where its bytes are no Gaussians."""
    _refuse_kept(path, keep)
    size = path.stat().st_size
    if size % _SPLAT.itemsize:
        raise DataError(f"{path}: {size} bytes are no whole number of Gaussians of {_SPLAT.itemsize}; truncated")
    rows = np.fromfile(path, _SPLAT)
    if not (np.isfinite(rows["mean"]).all() and (rows["scale"] >= 0).all() and np.isfinite(rows["scale"]).all()):
        raise DataError(f"{path}: holds sizes below 0 or numbers that aren't finite; damaged, or no .splat")
    return Cloud(rows["mean"].copy(), rows["rgba"][:, :3].copy(), unread=_UNREAD)


def read_spz(path: Path, keep: Sequence[str] = ()) -> Cloud:
    """Reads centers and colors of an ``.spz``. Raises DataError at another version, and where it ends early."""
    _refuse_kept(path, keep)
    packed = path.read_bytes()
    unpacking = zlib.decompressobj(zlib.MAX_WBITS | 16)
    if (
        packed.startswith(_MAGIC.to_bytes(4, "little"))
        and max(_REST) < (version := int.from_bytes(packed[4:8], "little")) < 256
    ):
        raise _other_version(path, version)  # later versions are not packed as a whole, so that their head lies open
    try:
        head = unpacking.decompress(packed, _HEAD.size)
        magic, version, count, _, bits, _, _ = _HEAD.unpack(head)
        if magic != _MAGIC or version not in _REST:
            raise _other_version(path, version)
        width = 6 if version == 1 else 9
        needed = count * (width + _REST[version])
        if needed > _PACKED_AT_MOST * len(packed):
            raise DataError(f"{path}: claims {count} Gaussians, which its {len(packed)} bytes can't hold; damaged")
        body = unpacking.decompress(unpacking.unconsumed_tail, needed) if needed else b""
    except (zlib.error, struct.error) as error:
        raise DataError(f"{path}: not a readable .spz ({error}); save it as .ply") from None
    if len(body) < needed:
        raise DataError(f"{path}: truncated: {len(body)} of {needed} bytes of its {count} Gaussians are left")
    colors = np.frombuffer(body, np.uint8, 3 * count, (width + 1) * count).reshape(-1, 3)
    color = color_of_harmonics((colors / 255 - 0.5) / _COLOR_SCALE)
    return Cloud(_centers(body, count, bits if version > 1 else None), color, unread=_UNREAD)


def _other_version(path: Path, version: int) -> DataError:
    return DataError(f"{path}: version {version} of .spz; 1 to 3 are read: save it as version 3, or as .ply")


def _centers(body: bytes, count: int, bits: int | None) -> np.ndarray:
    """Returns the centers f32 (N,3): halves, or whole numbers of 24 bits, of which some are behind the point."""
    if bits is None:
        return np.frombuffer(body, "<f2", 3 * count).reshape(-1, 3).astype(np.float32)
    low, middle, high = np.frombuffer(body, np.uint8, 9 * count).reshape(-1, 3, 3).astype(np.int32).transpose(2, 0, 1)
    whole = low | middle << 8 | high << 16
    return ((whole - ((whole & 1 << 23) << 1)) / 2.0**bits).astype(np.float32)


def unpack_supersplat(
    path: Path, chunks: Mapping[str, np.ndarray], rows: Mapping[str, np.ndarray], keep: Sequence[str]
) -> Cloud:
    """Returns the Gaussians of the packed columns (N) of a compressed ``.ply``, between the ends that chunks of 256 tell.

    Raises DataError where chunks lack, or columns.
    """
    _refuse_kept(path, keep)
    try:
        packed, shades = (rows[f"packed_{name}"].astype(np.int64) for name in ("position", "color"))
        low, high = (np.stack([chunks[f"{end}_{axis}"] for axis in "xyz"], 1) for end in ("min", "max"))
        tints = (
            [np.stack([chunks[f"{end}_{axis}"] for axis in "rgb"], 1) for end in ("min", "max")]
            if "min_r" in chunks
            else []
        )
    except KeyError as error:
        raise DataError(
            f"{path}: Gaussians that SuperSplat compressed, without {error}; export them as plain .ply"
        ) from None
    if len(low) * _IN_CHUNK < len(packed):
        raise DataError(f"{path}: {len(low)} chunks for {len(packed)} Gaussians; expected one for each {_IN_CHUNK}")
    own = np.arange(len(packed)) // _IN_CHUNK
    shares = np.stack([(packed >> 21 & 2047) / 2047, (packed >> 11 & 1023) / 1023, (packed & 2047) / 2047], 1)
    color = np.stack([shades >> shift & 255 for shift in (24, 16, 8)], 1) / 255
    if tints:
        color = tints[0][own] + color * (tints[1] - tints[0])[own]
    points = low[own] + shares * (high - low)[own]
    return Cloud(points.astype(np.float32), np.rint(255 * color.clip(0, 1)).astype(np.uint8), unread=_UNREAD)


def _refuse_kept(path: Path, keep: Sequence[str]) -> None:
    if keep:
        raise DataError(f"{path}: column {keep[0]}: of Gaussians only centers and colors are read; save them as .ply")
