"""MATLAB files of version 5, arrays of numbers, cells of them and structs of both, by the published layout (MathWorks, MAT-File Format).

Every length is checked against the bytes that are there: compiled readers end the process at some damaged files.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.npy_files import PACKED_AT_MOST, ROOM
from dpcli.prepare.array_files.attributes import says_text, says_unit

_HEADER = 128
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}  # as stored
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}  # as meant
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _CHAR = 1, 2, 4  # of the classes
_COMPLEX = 8  # flag
_BEGIN = 4096  # bytes of a compressed array in which its name and shape are
_MOST = 1 << 31  # bytes of one array

Bytes = bytes | memoryview
Element = tuple[int, Bytes]  # type, content


class _Damaged(ValueError):
    """Says what in the bytes is not as it should be."""


def read_mat5(path: Path, name: str) -> np.ndarray:
    """Reads the variable ``name``, an array of real numbers of any shape; whole doubles come in the type they are stored in.

    Raises DataError when it is absent, something else, or damaged; also for files of version 4.
    """
    found = []
    data, order = _opened(path)
    try:
        for kind, content in _elements(memoryview(data)[_HEADER:], order):
            called, values = _variable(path, kind, content, order, name)
            if values is not None:
                return values
            found += [called] if called else []
    except (_Damaged, zlib.error) as error:
        raise DataError(f"{path}: not a readable MATLAB file, perhaps truncated ({error})") from None
    raise DataError(f"{path}: no variable {name!r}; found {found or 'none'}")


def _opened(path: Path) -> tuple[bytes, str]:
    """Returns the bytes of a file and their order. Raises DataError where it is none of version 5."""
    data = path.read_bytes()
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None:
        raise DataError(f"{path}: not a MATLAB file of version 5 or 7.3, perhaps truncated; save it with -v7")
    return data, order


def _elements(data: Bytes, order: str) -> Iterator[Element]:
    """Yields the elements that follow one another; a short one has its content in its head."""
    at = 0
    while at < len(data):
        if at + 8 > len(data):
            raise _Damaged(f"{len(data) - at} bytes after the last variable")
        kind, size = np.frombuffer(data, order + "u4", 2, at).tolist()
        start, short = at + 8, kind >> 16
        if short:
            kind, size, start = kind & 0xFFFF, short, at + 4
        if size > (4 if short else len(data) - start):
            raise _Damaged(f"an element of {size} bytes, of which {len(data) - start} are left")
        yield kind, data[start : start + size]
        at = at + 8 if short else start + size + (0 if kind == _COMPRESSED else -size % 8)


def _variable(path: Path, kind: int, content: Bytes, order: str, wanted: str) -> tuple[str, np.ndarray | None]:
    """Returns the name of a variable, and its values where it is the one that is wanted."""
    begin = zlib.decompressobj().decompress(content, _BEGIN) if kind == _COMPRESSED else content
    if kind == _COMPRESSED:
        kind = int(np.frombuffer(begin, order + "u4", 1)[0]) if len(begin) >= 8 else 0
        begin = begin[8:]
    if kind != _MATRIX:
        return "", None
    flags, shape, name, used = _head(begin, order)
    if name != wanted:
        return name, None
    dtype = _type_of(flags, order)
    if dtype is None:
        raise DataError(f"{path}: {wanted!r} is text, or of another type; expected numbers")
    if begin is not content:
        _require_room(dtype, shape, name)
        content = zlib.decompressobj().decompress(content, 8 + used + 8 + 8 * math.prod(shape))
        content = memoryview(content)[8:]
    return name, _numbers(memoryview(content)[used:], dtype, shape, name, order)


def read_variables(path: Path) -> dict[str, np.ndarray | list[np.ndarray]]:
    """Returns all variables that are arrays of real numbers, or cells of such arrays (as lists, column after column), by
    name, and such fields of structs as ``struct/field``, as MATLAB 7.3 has them, and texts that tell units (each an array of one);
    others are passed over.

    Raises DataError as `read_mat5`, and where a file unpacks to far more than it has.
    """
    found: dict[str, np.ndarray | list[np.ndarray]] = {}
    data, order = _opened(path)
    left = ROOM + PACKED_AT_MOST * len(data)
    try:
        for kind, content in _elements(memoryview(data)[_HEADER:], order):
            if kind == _COMPRESSED:
                content = zlib.decompressobj().decompress(content, left + 1)
                left -= len(content)
                if left < 0:
                    raise _Damaged(f"its variables claim more than {ROOM + PACKED_AT_MOST * len(data)} bytes")
                kind, content = next(_elements(memoryview(content), order), (0, b""))
            if kind == _MATRIX:
                found |= _of_variable(content, order)
    except (_Damaged, zlib.error) as error:
        raise DataError(f"{path}: not a readable MATLAB file, perhaps truncated ({error})") from None
    return found


def _of_variable(content: Bytes, order: str, above: str = "") -> dict[str, np.ndarray | list[np.ndarray]]:
    """Returns what `read_variables` does of one variable, or of the field of a struct, whose whole name is ``above``."""
    name, values = _matrix(content, order)
    name = above or name
    if values is None and says_text(name) and (text := _text(content, order)):
        values = np.array(text)
    return {name: values} if values is not None else _fields(content, order, name)


def _text(content: Bytes, order: str) -> str:
    """Returns the letters of a matrix of them, "" of any other."""
    flags, _, _, used = _head(content, order)
    if flags & 0xFF != _CHAR:
        return ""
    stored, raw = next(_elements(memoryview(content)[used:], order), (0, b""))
    wide = "utf-16-le" if order == "<" else "utf-16-be"
    return bytes(raw).decode(wide if stored in (4, 17) else "utf-8", "replace")


def _matrix(content: Bytes, order: str) -> tuple[str, np.ndarray | list[np.ndarray] | None]:
    """Returns name and values of a matrix, a list of those of a cell; None of what is neither numbers nor cells of them."""
    flags, shape, name, used = _head(content, order)
    rest = memoryview(content)[used:]
    if flags & 0xFF == _CELL:
        parts = [part for kind, part in _elements(rest, order) if kind == _MATRIX]
        inside = [_matrix(part, order)[1] if len(part) else np.zeros((0, 0)) for part in parts]
        plain = [one for one in inside if isinstance(one, np.ndarray)]
        return name, joined(plain) if plain and len(plain) == len(inside) else None
    dtype = _type_of(flags, order)
    return name, None if dtype is None else _numbers(rest, dtype, shape, name, order)


def joined(parts: list[np.ndarray]) -> np.ndarray | list[np.ndarray]:
    """Returns the contents of a cell, or of one field of several structs: an array where each is one number, such as a time."""
    return np.concatenate(parts, axis=None) if len(parts) > 1 and all(one.size == 1 for one in parts) else parts


def _fields(content: Bytes, order: str, name: str) -> dict[str, np.ndarray | list[np.ndarray]]:
    """Returns what `_matrix` does of each field of a struct, by ``struct/field``, a list of an array of several structs; {} of
    anything else. Of structs in structs only those are read that are single. name: the struct's.
    """
    flags, _, _, used = _head(content, order)
    if flags & 0xFF != _STRUCT:
        return {}
    parts = [part for _, part in _elements(memoryview(content)[used:], order)]
    size = int(np.frombuffer(parts[0], order + "i4", 1)[0]) if len(parts) > 1 and len(parts[0]) >= 4 else 0
    if size < 1 or len(parts[1]) % size or (len(parts) - 2) % max(1, len(parts[1]) // size):
        raise _Damaged(f"{name!r}, a struct that lacks names of fields, or some fields")
    names, values = parts[1], parts[2:]
    words = [bytes(names[at : at + size]).split(b"\0")[0].decode("latin1") for at in range(0, len(names), size)]
    found: dict[str, np.ndarray | list[np.ndarray]] = {}
    for place, word in enumerate(words):
        fields = values[place :: len(words)]
        if len(fields) == 1 and len(fields[0]):
            found |= _of_variable(fields[0], order, f"{name}/{word}")
            continue
        texts = {_text(part, order) for part in fields if len(part)} if says_unit(word) else set()
        if len(texts) == 1 and "" not in texts:
            found[f"{name}/{word}"] = np.array(texts.pop())
            continue
        own = [_matrix(part, order)[1] if len(part) else np.zeros((0, 0)) for part in fields]
        arrays = [one for one in own if isinstance(one, np.ndarray)]
        if len(own) == len(arrays):
            found[f"{name}/{word}"] = joined(arrays) if len(own) > 1 else arrays[0]
    return found


def _type_of(flags: int, order: str) -> np.dtype | None:
    """Returns the type of a matrix of real numbers, None of any other."""
    dtype = np.dtype(order + _CLASSES.get(flags & 0xFF, "V0"))
    return None if dtype.kind == "V" or flags >> 8 & _COMPLEX else dtype


def _require_room(dtype: np.dtype, shape: tuple[int, ...], name: str) -> None:
    if math.prod(shape) * dtype.itemsize > _MOST:
        raise _Damaged(f"{name!r} of shape {shape} takes more than {_MOST} bytes")


def _numbers(content: memoryview, dtype: np.dtype, shape: tuple[int, ...], name: str, order: str) -> np.ndarray:
    """Returns the values of a matrix, of which content is what follows its head."""
    _require_room(dtype, shape, name)
    stored, raw = next(_elements(content, order), (0, b""))  # no copies: videos are large
    if stored not in _NUMBERS:
        raise _Damaged(f"{name!r} has no numbers")
    values = np.frombuffer(raw[: len(raw) - len(raw) % np.dtype(_NUMBERS[stored]).itemsize], order + _NUMBERS[stored])
    if len(values) != math.prod(shape):
        raise _Damaged(f"{name!r} of shape {shape} has {len(values)} numbers")
    if dtype.kind == "f" and values.dtype.kind in "iu" and values.dtype.itemsize < dtype.itemsize:
        dtype = values.dtype  # MATLAB stores whole doubles in few bytes: the same numbers, a quarter of the memory
    return values.astype(dtype.newbyteorder("="), copy=False).reshape(shape, order="F")


def _head(data: Bytes, order: str) -> tuple[int, tuple[int, ...], str, int]:
    """Returns flags, shape and name of a matrix, and how many bytes these take."""
    parts: list[Any] = []
    at = 0
    for _ in range(3):
        tag = np.frombuffer(bytes(data[at : at + 8]).ljust(8, b"\0"), order + "u4", 2).tolist()
        size = 8 if tag[0] >> 16 else 8 + tag[1] + -tag[1] % 8
        parts.append(next(_elements(data[at : at + size], order), (0, b""))[1])
        at += size
    flags, shape, name = parts
    if len(flags) < 8 or len(shape) < 8 or len(shape) % 4 or len(shape) > 128:
        raise _Damaged("a matrix without type or shape")
    sides = tuple(np.frombuffer(shape, order + "i4").tolist())
    if min(sides) < 0:
        raise _Damaged(f"a matrix of shape {sides}")
    return int(np.frombuffer(flags, order + "u4", 1)[0]), sides, bytes(name).decode("latin1"), at
