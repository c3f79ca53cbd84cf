"""NumPy's array files of others, mapped rather than read, so that what their headers claim is checked against their length."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.errors import DataError

_ROOM, _PACKED_AT_MOST = 100 << 20, 50  # bytes that any file may unpack to; and times its size beyond them


def require_room(path: Path, claimed: int) -> None:
    """Raises DataError where packed arrays claim far more bytes than clouds and depth do, which pack a few times smaller."""
    held = path.stat().st_size
    if claimed > _ROOM + _PACKED_AT_MOST * held:
        raise DataError(f"{path}: claims {claimed} bytes of arrays; a file of {held} bytes can't hold such clouds")


def map_npy(path: Path) -> np.ndarray:
    """Returns the array in a `.npy`, mapped read-only.

    Raises DataError when it is damaged, needs a pickle, or has bytes behind the array: several arrays may lie in one file, of
    which only the first would be read. FileNotFoundError passes.
    """
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except FileNotFoundError:
        raise
    except Exception as error:  # ValueError, EOFError, tokenize.TokenError, SyntaxError... of damaged headers
        said = (str(error).splitlines() or [""])[0]
        raise DataError(
            f"{path}: not a readable .npy array, perhaps truncated ({said or type(error).__name__})"
        ) from None
    if not isinstance(array, np.memmap):
        raise DataError(f"{path}: not a readable .npy array (an archive)")
    behind = path.stat().st_size - array.offset - array.nbytes
    if behind:
        raise DataError(
            f"{path}: {behind} bytes behind the array of shape {array.shape} that its header declares: several arrays in one"
            " file, or damaged; save each array as its own file"
        )
    return array
