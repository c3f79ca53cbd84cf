"""Big ZIP archives read in place: which folders they hold, and a folder's files, without listing the archive again."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from dpcli.errors import DataError
from dpcli.npy_files import require_distinct
from dpcli.prepare.series import is_hidden

# the header in front of a file's own bytes: signature, lengths of name and extra field
_LOCAL = struct.Struct("<4s22x2H")
_COLUMNS = {"offset": "i8", "packed": "i8", "size": "i8", "crc": "u4", "method": "u2", "flags": "u2", "name": "u2"}
_ENTRY = np.dtype(list(_COLUMNS.items()))  # of each file; name is the length of its whole name, bytes
_ENCRYPTED, _UTF8 = 1, 0x800  # bits of the flags
_MOST_BYTES = 1 << 26  # of one unpacked file; a depth frame takes half a megabyte


@dataclass(frozen=True)
class ZipFolder:
    """Holds the files directly in one folder of an archive: their base names, and where and how each is stored.

    It is small and pickles, so that a worker process reads the folder without opening the archive's directory.
    """

    names: tuple[str, ...]
    entries: np.ndarray  # one of _ENTRY for each name


def list_folders(path: Path) -> dict[str, ZipFolder]:
    """Returns every folder of an archive that directly holds files, by its name with forward slashes, "" for the top; files that
    are hidden, such as what macOS packs beside every file, are passed over.

    Raises DataError when the archive is no ZIP, cut short or damaged.
    """
    found: dict[str, list[zipfile.ZipInfo]] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for info in archive.infolist():
                folder, _, name = _named(info).rpartition("/")
                if name and not is_hidden(name):
                    found.setdefault(folder, []).append(info)
    except (zipfile.BadZipFile, NotImplementedError, UnicodeDecodeError, ValueError, struct.error) as error:
        raise DataError(
            f"{path}: no ZIP, or cut short, or its directory is damaged ({error or type(error).__name__}); copy it again"
        ) from None
    return {folder: _folder(infos) for folder, infos in found.items()}


def _folder(infos: list[zipfile.ZipInfo]) -> ZipFolder:
    rows = [
        (i.header_offset, i.compress_size, i.file_size, i.CRC, i.compress_type, i.flag_bits, _name_length(i))
        for i in infos
    ]
    return ZipFolder(tuple(_named(info).rpartition("/")[2] for info in infos), np.array(rows, _ENTRY))


def _named(info: zipfile.ZipInfo) -> str:
    """Returns the name of an entry with forward slashes; some programs of Windows write others."""
    return info.filename.replace("\\", "/")


def _name_length(info: zipfile.ZipInfo) -> int:
    return len(info.orig_filename.encode("utf-8" if info.flag_bits & _UTF8 else "cp437"))


def read_files(path: Path, folder: ZipFolder) -> Iterator[tuple[str, bytes]]:
    """Yields (base name, content) of the folder's files, in the order of the archive's directory.

    Raises DataError when a file is damaged, encrypted, or packed by a method other than stored or deflated.
    """
    require_distinct(path, folder.names)
    with open(path, "rb") as file:
        for name, entry in zip(folder.names, folder.entries, strict=True):
            yield name, _content(file, f"{path}/{name}", *entry.tolist())


def _content(
    file: BinaryIO, where: str, offset: int, packed: int, size: int, crc: int, method: int, flags: int, name: int
) -> bytes:
    if flags & _ENCRYPTED:
        raise DataError(f"{where}: encrypted; unpack the archive with its password first")
    if method not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise DataError(
            f"{where}: packed by ZIP method {method}; expected stored or deflated: unpack the archive first"
        )
    if max(size, packed) > _MOST_BYTES:
        raise DataError(f"{where}: takes {max(size, packed)} bytes; expected less than {_MOST_BYTES}")
    file.seek(max(offset, 0))
    header = file.read(_LOCAL.size)
    if offset < 0 or len(header) < _LOCAL.size or header[:4] != b"PK\x03\x04" or _LOCAL.unpack(header)[1] != name:
        raise DataError(f"{where}: its data are not where the ZIP's directory says; the archive is damaged")
    file.seek(sum(_LOCAL.unpack(header)[1:]), 1)
    data = file.read(packed)
    if method == zipfile.ZIP_DEFLATED:
        data = _inflate(data, size, where)
    if len(data) != size or zlib.crc32(data) != crc:
        raise DataError(f"{where}: damaged inside the ZIP (wrong checksum); copy the archive again")
    return data


def _inflate(data: bytes, size: int, where: str) -> bytes:
    unpack = zlib.decompressobj(-15)
    try:
        return unpack.decompress(data, size + 1)  # never more than it says, whatever the data are
    except zlib.error as error:
        raise DataError(f"{where}: damaged inside the ZIP ({error}); copy the archive again") from None
