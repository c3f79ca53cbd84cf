"""Reading pickled NumPy arrays without the power of pickle: an allow list of names, and nothing else is called."""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import re
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.npy_files import read_header, read_member, require_room

# of an element: a number, text, or Python object, which is checked like all else
_CODE = re.compile(r"[biufcSUO]\d{0,9}")
_FLOATS = re.compile(rb"(?:G.{8}){0,1000}", re.DOTALL)  # a float's step and its bytes
_CORES = ("numpy.core", "numpy._core")  # NumPy 1 and 2


class _Element:
    """Stands for the type of an array's elements while a pickle is read; it becomes one without fields or shape only.

    A true ``numpy.dtype`` takes fields at any offset from a pickle, and with them memory that isn't the array's.
    """

    __slots__ = ("dtype",)

    def __init__(self, code: str, *_: Any) -> None:
        if not isinstance(_text(code), str) or not _CODE.fullmatch(_text(code)):
            raise pickle.UnpicklingError(f"an array has elements of type {code!r:.80}; expected numbers")
        self.dtype = np.dtype(_text(code))

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        """Takes the byte order. Raises UnpicklingError for fields, a shape or another size."""
        _, order, *composed, size = state[:6]
        if any(part is not None for part in composed) or size not in (-1, self.dtype.itemsize) or state[8:]:
            raise pickle.UnpicklingError("an array's elements are composed of fields; expected numbers")
        self.dtype = self.dtype.newbyteorder(_text(order))


class _Array(np.ndarray):
    """Checks the state that a pickle puts into an array before NumPy's C code gets it."""

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        """Takes shape and values. Raises UnpicklingError where they don't fit each other."""
        _, shape, element, by_columns, values = state
        dtype = _dtype(element)
        given = values if dtype.hasobject and isinstance(values, list) else _raw(values)
        fits = len(given) == _count(shape) * (1 if isinstance(given, list) else dtype.itemsize)
        if not fits or isinstance(given, list) != dtype.hasobject:
            raise pickle.UnpicklingError(f"an array of shape {shape!r:.80} has {len(given)} values or bytes")
        super().__setstate__((1, shape, dtype, bool(by_columns), given))


class _Name:
    """Stands for a name of the allow list: it can be called and nothing else, for no state goes into it and it is no class."""

    __slots__ = ("_make",)

    def __init__(self, make: Callable[..., Any]) -> None:
        self._make = make

    def __call__(self, *given: Any) -> Any:
        return self._make(*given)

    def __setstate__(self, state: Any) -> None:
        """Raises UnpicklingError, whatever the state."""
        raise pickle.UnpicklingError("it puts a state into a function")


def _empty(*_: Any) -> _Array:
    return _Array((0,))  # the state says shape and type


def _scalar(element: Any, values: Any) -> Any:
    dtype, raw = _dtype(element), _raw(values)
    if dtype.hasobject or len(raw) != dtype.itemsize:
        raise pickle.UnpicklingError(f"a number of type {dtype} has {len(raw)} bytes")
    return np.frombuffer(raw, dtype)[0]


def _from_buffer(values: Any, element: Any, shape: Any, order: Any = "C") -> _Array:
    dtype, raw = _dtype(element), _raw(values)
    if dtype.hasobject or len(raw) != _count(shape) * dtype.itemsize or order not in ("C", "F"):
        raise pickle.UnpicklingError(f"an array of shape {shape!r:.80} has {len(raw)} bytes")
    return np.frombuffer(raw, dtype).reshape(shape, order=order).view(_Array)


def _encode(text: Any, encoding: Any = "latin1") -> bytes:
    if not isinstance(text, str) or encoding != "latin1":
        raise pickle.UnpicklingError(f"it asks for the encoding {encoding!r:.80}")
    return text.encode("latin1")


def _no_bytes() -> bytes:
    return b""  # of an array without elements


def _class_itself(*_: Any) -> Any:
    raise pickle.UnpicklingError("it makes an array without a state")


# what pickling an array of numbers, or an object array of plain containers of such arrays, refers to
_ALLOWED: dict[tuple[str, str], Callable[..., Any]] = {
    ("numpy", "ndarray"): _class_itself,
    ("numpy", "dtype"): _Element,
    ("_codecs", "encode"): _encode,
    ("__builtin__", "bytes"): _no_bytes,
    **{(f"{core}.multiarray", "_reconstruct"): _empty for core in _CORES},
    **{(f"{core}.multiarray", "scalar"): _scalar for core in _CORES},
    **{(f"{core}.numeric", "_frombuffer"): _from_buffer for core in _CORES},
}


def _text(given: Any) -> str:
    return given.decode("latin1") if isinstance(given, bytes) else given  # Python 2 wrote bytes


def _raw(values: Any) -> bytes | bytearray:
    """Returns the bytes of values; Python 2's arrive as text of the same numbers."""
    raw = values.encode("latin1") if isinstance(values, str) else values
    if not isinstance(raw, (bytes, bytearray)):
        raise pickle.UnpicklingError(f"an array's values are a {type(values).__name__}; expected bytes")
    return raw


def _dtype(element: Any) -> np.dtype:
    if not isinstance(element, _Element):
        raise pickle.UnpicklingError(f"an array's type is a {type(element).__name__}")
    return element.dtype


def _count(shape: Any) -> int:
    if not isinstance(shape, tuple) or not all(type(side) is int and side >= 0 for side in shape):
        raise pickle.UnpicklingError(f"an array has the shape {shape!r:.80}; expected whole numbers")
    return math.prod(shape)


def load_arrays(stream: io.BytesIO) -> Any:
    """Returns what a pickle of plain arrays, numbers, texts and containers holds; only functions of this module are called.

    Raises UnpicklingError for any other name, a state that isn't an array's, or a place in the memory of the unpickler
    that so short a pickle has no use for; also whatever a damaged one makes the unpickler raise.
    """
    begin = stream.tell()
    for read, (step, argument) in enumerate(_steps(stream)):
        if step.endswith("PUT") and argument > read:  # room is made for all places before it
            raise pickle.UnpicklingError(f"it uses place {argument} of its memory after {read} steps")
    stream.seek(begin)
    return _ArrayUnpickler(stream, encoding="latin1").load()


def _steps(stream: io.BytesIO) -> Iterator[tuple[str, Any]]:
    """Yields the name and argument of each step of a pickle; a run of floats, which holds the most bytes, is one step.

    Lengths are checked against the bytes that are there. ValueError: it ends early, or a step is none.
    """
    data = stream.getbuffer()
    while True:
        stream.seek(_FLOATS.match(data, stream.tell()).end())
        code = stream.read(1).decode("latin1")
        step = pickletools.code2op.get(code)
        if step is None:
            raise ValueError(f"the pickle has a step {code!r}, or no end")
        yield step.name, step.arg.reader(stream) if step.arg else None
        if code == ".":
            return


class _ArrayUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> _Name:
        """Returns a function of the allow list. Raises UnpicklingError for any other name."""
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}")
        return _Name(_ALLOWED[module, name])


def read_npz_member(archive: zipfile.ZipFile, path: Path, key: str, pickled: bool = False) -> Any:
    """Reads one array of an open .npz; with ``pickled`` it may be of objects, through the allow list.

    Raises DataError when the member is absent, damaged, or a pickle that needs more than plain arrays and containers.
    """
    try:
        info = archive.getinfo(f"{key}.npy")
    except KeyError:
        found = ", ".join(sorted(name.removesuffix(".npy") for name in archive.namelist()))
        raise DataError(f"{path}: no array {key!r} in it; found: {found}") from None
    require_room(path, info.file_size)
    try:
        data = archive.read(info)
        stream = io.BytesIO(data)
        if pickled and read_header(stream)[2].hasobject:
            return load_arrays(stream)
        return read_member(path, data)
    except pickle.UnpicklingError as error:
        raise DataError(f"{path}: {key} is a pickle that is not of plain arrays: {error}; it was not loaded") from None
    except DataError:
        raise
    except Exception as error:  # a damaged zip, header or pickle stream raises nearly anything
        raise DataError(f"{path}: {key} cannot be read ({type(error).__name__}: {error}); copy it again") from None
