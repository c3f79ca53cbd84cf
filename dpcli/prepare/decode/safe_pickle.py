"""Reading pickled NumPy arrays without the power of pickle: an allow list of names, and nothing else is called."""

from __future__ import annotations

import io
import pickle
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError

# what pickling an array of numbers, or an object array of plain containers of such arrays, refers to; both spellings
_ALLOWED = {(f"numpy.{core}.multiarray", name) for core in ("core", "_core") for name in ("_reconstruct", "scalar")} | {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy._core.numeric", "_frombuffer"),
    ("numpy.core.numeric", "_frombuffer"),
    ("_codecs", "encode"),
}
_MOST_BYTES = 1 << 28


class ArrayUnpickler(pickle.Unpickler):
    """Loads pickles that name nothing but NumPy's array constructors."""

    def find_class(self, module: str, name: str) -> Any:
        """Returns a constructor of the allow list. Raises UnpicklingError for any other name."""
        if (module, name) in _ALLOWED:
            home = "numpy._core" if np.lib.NumpyVersion(np.__version__) >= "2.0.0" else "numpy.core"
            return super().find_class(re.sub(r"^numpy\._?core", home, module), name)
        raise pickle.UnpicklingError(f"it asks for {module}.{name}")


def read_npz_member(archive: zipfile.ZipFile, path: Path, key: str, pickled: bool = False) -> Any:
    """Reads one array of an open .npz; with ``pickled`` an object array may be in it, and its only element is returned.

    Raises DataError when the member is absent, damaged, or a pickle that needs more than plain arrays and containers.
    """
    try:
        info = archive.getinfo(f"{key}.npy")
    except KeyError:
        found = ", ".join(sorted(name.removesuffix(".npy") for name in archive.namelist()))
        raise DataError(f"{path}: no array {key!r} in it; found: {found}") from None
    if info.file_size > _MOST_BYTES:
        raise DataError(f"{path}: {key} takes {info.file_size} bytes; expected less than {_MOST_BYTES}")
    try:
        data = archive.read(info)
        stream = io.BytesIO(data)
        if not pickled:
            return np.lib.format.read_array(stream, allow_pickle=False)
        version = np.lib.format.read_magic(stream)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = header(stream)
        if dtype.hasobject and shape != ():
            raise DataError(f"{path}: {key} is an object array of shape {shape}; expected shape ()")
        if not dtype.hasobject:
            return np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
        return ArrayUnpickler(stream, encoding="latin1").load().item()
    except pickle.UnpicklingError as error:
        raise DataError(f"{path}: {key} is a pickle that is not of plain arrays: {error}; it was not loaded") from None
    except DataError:
        raise
    except Exception as error:  # a damaged zip, header or pickle stream raises nearly anything
        raise DataError(f"{path}: {key} cannot be read ({type(error).__name__}: {error})") from None
