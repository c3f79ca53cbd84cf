"""The flows of all training pairs, kept in files of the run folder: scene flow updating (eq. 4.6) corrects them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from dpcli.errors import DataError, UsageError, reading
from dpcli.npy_files import map_npy
from dpcli.runtime.whole_file import disk_full, reserve

_FIRST, _NOW, _KNOWN = "flows_first.npy", "flows.npy", "flows_known.npy"
_THERE, _BODIES, _CORRECTED = 1, 2, 4  # bits of `flows_known.npy`


class FlowStore:
    """Keeps flows f32 (pairs,2,N,3), forth and back: `flows_first.npy` as estimated, `flows.npy` as corrected since.

    `flows_known.npy` u8 (pairs) tells what is there. fresh: makes the files; else they have to be there, or DataError.
    take_from: another run's folder whose first flows a fresh run begins with.

    Changes wait in memory until `flush`, which the trainer calls after it has saved them with its own state: a run that
    is killed finds either both or neither, and changes nothing twice. Memory: the changes since the last checkpoint.
    """

    def __init__(self, folder: Path, pairs: int, points: int, fresh: bool, take_from: Path | None = None) -> None:
        shape = (pairs, 2, points, 3)
        self._first = _open(folder / _FIRST, shape, np.float32, fresh)
        self._now = _open(folder / _NOW, shape, np.float32, fresh)
        self._known = _open(folder / _KNOWN, (pairs,), np.uint8, fresh)
        self.estimated: dict[int, tuple[torch.Tensor, bool]] = {}
        self.corrected: dict[int, torch.Tensor] = {}
        if fresh and take_from is not None:
            self._take_first_flows(take_from)

    def _take_first_flows(self, folder: Path) -> None:
        """Copies the first flows of another run, which nothing has corrected yet."""
        first, known = first_flows(folder, len(self._known), self._first.shape[2])
        for pair in np.flatnonzero(known):
            self._first[pair] = first[pair]
        self._known[:] = known & (_THERE | _BODIES)

    def get(self, pair: int) -> torch.Tensor | None:
        """Returns the flow (2,N,3) of a pair, or None when it has not been estimated yet."""
        if pair in self.corrected:
            return self.corrected[pair]
        if pair in self.estimated:
            return self.estimated[pair][0]
        known = self._known[pair]
        return torch.from_numpy(np.array((self._now if known & _CORRECTED else self._first)[pair])) if known else None

    def shows_bodies(self, pair: int) -> bool | None:
        """Returns whether the pair's first flow showed more than one body; None when it has not been estimated yet."""
        if pair in self.estimated:
            return self.estimated[pair][1]
        return bool(self._known[pair] & _BODIES) if self._known[pair] else None

    def put_first(self, pair: int, flow: torch.Tensor, shows_bodies: bool) -> None:
        """Keeps an estimate (2,N,3), and whether it shows more than one body."""
        self.estimated[pair] = (flow.detach().clone(), shows_bodies)

    def put(self, pair: int, flow: torch.Tensor) -> None:
        """Keeps a corrected flow (2,N,3)."""
        self.corrected[pair] = flow.detach().clone()

    def pending(self) -> dict[str, dict[str, torch.Tensor]]:
        """Returns what `flush` will write, for the trainer's own state; `restore` takes it back."""
        return {
            "first": {str(pair): flow for pair, (flow, _) in self.estimated.items()},
            "telling": {str(pair): torch.tensor(shows_bodies) for pair, (_, shows_bodies) in self.estimated.items()},
            "corrected": {str(pair): flow for pair, flow in self.corrected.items()},
        }

    def restore(self, pending: dict[str, dict[str, torch.Tensor]]) -> None:
        """Writes what a run that was killed may not have written."""
        self.estimated = {int(p): (flow, bool(pending["telling"][p])) for p, flow in pending["first"].items()}
        self.corrected = {int(p): flow for p, flow in pending["corrected"].items()}
        self.flush()

    def flush(self) -> None:
        """Writes what is pending."""
        for pair, (flow, shows_bodies) in self.estimated.items():
            self._first[pair] = flow.numpy()
            self._known[pair] |= _THERE + _BODIES * shows_bodies
        for pair, flow in self.corrected.items():
            self._now[pair] = flow.numpy()
            self._known[pair] |= _CORRECTED
        for array in (self._first, self._now, self._known):
            array.flush()
        self.estimated, self.corrected = {}, {}


def first_flows(folder: Path, pairs: int, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns what another run's folder has estimated already: `flows_first.npy` and `flows_known.npy`.

    Raises UsageError where there is nothing, or flows of other pairs.
    """
    try:
        first, known = (map_npy(folder / name) for name in (_FIRST, _KNOWN))
    except (OSError, DataError) as error:
        raise UsageError(f"flows_of = {folder}: no flows of a `dpc segment train` run there ({error})") from None
    shape = (pairs, 2, points, 3)
    if first.shape != shape or known.shape != shape[:1] or first.dtype.kind != "f" or known.dtype != np.uint8:
        raise UsageError(f"flows_of = {folder}: flows of {first.shape} pairs, frames, points; here {shape}")
    return first, known


def _open(path: Path, shape: tuple[int, ...], dtype: type, fresh: bool) -> np.ndarray:
    """Opens an array file and reserves its bytes on the disk at once."""
    try:
        array = _map_file(path, shape, dtype, fresh)
        with path.open("r+b") as file:
            reserve(file.fileno(), path.stat().st_size)
    except OSError as error:
        size = path.stat().st_size if path.exists() else 0
        raise disk_full(path, error, needed=size) or error from None
    return array


def _map_file(path: Path, shape: tuple[int, ...], dtype: type, fresh: bool) -> np.ndarray:
    """Returns the array of a file, mapped into memory; where it is `fresh` a new one.

    Raises DataError where a file that a run goes on with is gone or another one: zeros in its place would be learned from.
    """
    if fresh:
        return np.lib.format.open_memmap(path, "w+", dtype, shape)
    if not path.exists():
        raise DataError(f"{path}: is gone, and the run goes on with its flows; bring it back, or --force to start over")
    with reading(path):
        array = np.lib.format.open_memmap(path, "r+")
    if (array.shape, array.dtype) != (shape, dtype):
        raise DataError(
            f"{path}: holds {array.dtype} {array.shape}, expected {np.dtype(dtype)} {shape}, as the run left it;"
            " bring that back, or --force to start over"
        )
    return array
