"""The flow of every training pair, kept in a file of the run folder and corrected while the network learns (eq. 4.6)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch


class FlowStore:
    """flow f32 (pairs,2,N,3), forth and back, in `flows.npy`; u8 (pairs) beside tells which are there: 0 not yet, 1 there,
    2 there and telling (the first flow showed more than one body).

    Changes wait in memory until `flush`, which the trainer calls after it has saved them with its own state: a run that
    is killed finds either both or neither, and changes nothing twice. Memory: the changes since the last checkpoint.
    """

    def __init__(self, folder: Path, pairs: int, points: int, fresh: bool) -> None:
        self._flow = self._open(folder / "flows.npy", (pairs, 2, points, 3), np.float32, fresh)
        self._known = self._open(folder / "flows_known.npy", (pairs,), np.uint8, fresh)
        self.pending: dict[int, torch.Tensor] = {}
        self.pending_telling: dict[int, bool] = {}

    @staticmethod
    def _open(path: Path, shape: tuple[int, ...], dtype: type, fresh: bool) -> np.ndarray:
        if not fresh and path.exists():
            array = np.lib.format.open_memmap(path, "r+")
            if array.shape == shape:
                return array
        return np.lib.format.open_memmap(path, "w+", dtype, shape)

    def get(self, pair: int) -> torch.Tensor | None:
        """(2,N,3), or None when it has not been estimated yet."""
        if pair in self.pending:
            return self.pending[pair]
        return torch.from_numpy(np.array(self._flow[pair])) if self._known[pair] else None

    def telling(self, pair: int) -> bool | None:
        """Whether the pair's first flow showed more than one body; None when it has not been estimated yet."""
        if pair in self.pending_telling:
            return self.pending_telling[pair]
        return bool(self._known[pair] == 2) if self._known[pair] else None

    def put(self, pair: int, flow: torch.Tensor, telling: bool | None = None) -> None:
        """Keep a flow (2,N,3); telling is given with the first one."""
        self.pending[pair] = flow.detach().clone()
        if telling is not None:
            self.pending_telling[pair] = telling

    def flush(self) -> None:
        """Write what is pending."""
        for pair, flow in self.pending.items():
            self._flow[pair] = flow.numpy()
            self._known[pair] = max(self._known[pair], 1 + int(self.pending_telling.get(pair, False)))
        self._flow.flush()
        self._known.flush()
        self.pending, self.pending_telling = {}, {}
