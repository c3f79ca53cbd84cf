"""Neighborhoods of clips that training comes back to: searched once, then read from a nameless file of the run folder.

A static network is frozen while the dynamic stream learns, and what it groups follows from a clip's points alone. Where an
epoch shows one of a few fixed draws of every clip (the setting `draws`), its neighborhoods are those of the draw's first time.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dpcli.classify.network.backbones.interface import Grouping, clip_points
from dpcli.errors import UsageError
from dpcli.runtime.progress import log
from dpcli.runtime.whole_file import disk_full, reserve

Search = Callable[[Tensor], list[Grouping]]


class NeighborCache:
    """Keeps what `search` finds for each of `clips` numbered clips of one shape: centroids and indices of neighbors, on disk.

    Memory: a byte a clip. The file has no name and goes with the process, killed or not; a run that is continued fills a new
    one. Raises DiskFull (with a sentence) at the first batch when `folder` has no room for it.
    """

    def __init__(self, search: Search, folder: Path, clips: int) -> None:
        self.search, self.folder = search, folder
        self._known = np.zeros(clips, bool)
        self._sources: list[_Source] = []
        self._records = np.empty(0)

    def __call__(self, points: Tensor, clips: Tensor) -> list[Grouping]:
        """Returns the neighborhoods of a batch, points (B,T,P,3) and clips i64 (B), their numbers: equal to `search(points)`."""
        numbers = clips.cpu().numpy()
        new = np.flatnonzero(~self._known[numbers])
        if len(new):
            some = points[torch.from_numpy(new).to(points.device)]
            self._keep(numbers[new], clip_points(some), self.search(some))
        return self._read(numbers, clip_points(points))

    def _keep(self, numbers: np.ndarray, cloud: tuple[Tensor, Tensor], groups: list[Grouping]) -> None:
        if not self._sources:
            self._sources = _sources(cloud, groups)
            self._records = self._new_file(_record(groups, self._sources))
        for field, (values, kind) in _stored(groups, self._sources).items():
            self._records[field][numbers] = values.cpu().numpy().astype(kind)
        self._known[numbers] = True

    def _new_file(self, record: np.dtype) -> np.ndarray:
        size = len(self._known) * record.itemsize
        log.info(
            f"keeping neighbors in {self.folder}: {size / 1e6:.0f} MB, {record.itemsize / 1e6:.2g} MB a clip and draw"
        )
        try:
            with tempfile.TemporaryFile(dir=self.folder) as file:
                file.truncate(size)
                reserve(file.fileno(), size)
                return np.memmap(file, record, "r+", shape=(len(self._known),))
        except OSError as error:
            raise disk_full(self.folder, error, needed=size) or error from None

    def _read(self, numbers: np.ndarray, cloud: tuple[Tensor, Tensor]) -> list[Grouping]:
        records = self._records[numbers]
        groups: list[Grouping] = []
        for stage, source in enumerate(self._sources):
            points, times = cloud if source.of_clip else (groups[-1].centers, groups[-1].center_times)
            if source.all_points:
                centers, center_times = points, times
            else:
                centers, center_times = (_tensor(records[f"{name}{stage}"], points) for name in ("centers", "times"))
            idx = torch.from_numpy(records[f"idx{stage}"].astype(np.int64)).to(points.device)
            groups.append(Grouping(points, times, centers, center_times, idx))
        return groups


@dataclass(frozen=True)
class _Source:
    """Says whether a stage's points come from the clip (else from the stage before), and whether each of them is a centroid."""

    of_clip: bool
    all_points: bool


def _sources(cloud: tuple[Tensor, Tensor], groups: list[Grouping]) -> list[_Source]:
    found: list[_Source] = []
    before = None
    for group in groups:
        own, centers = (group.points, group.times), (group.centers, group.center_times)
        if not (_same(own, cloud) or (before is not None and _same(own, before))):
            raise UsageError(
                "draws: this backbone groups points that are neither the clip's nor the centroids of the stage before,"
                " so its neighborhoods can't be kept; leave it out"
            )
        found.append(_Source(_same(own, cloud), _same(centers, own)))
        before = centers
    return found


def _same(some: tuple[Tensor, Tensor], others: tuple[Tensor, Tensor]) -> bool:
    return all(a.shape == b.shape and torch.equal(a, b) for a, b in zip(some, others))


def _stored(groups: list[Grouping], sources: list[_Source]) -> dict[str, tuple[Tensor, str]]:
    """Returns what of the groups is kept, by field, and as what type: indices in two bytes where they fit."""
    fields: dict[str, tuple[Tensor, str]] = {}
    for stage, (group, source) in enumerate(zip(groups, sources)):
        if not source.all_points:
            fields[f"centers{stage}"] = (group.centers, "<f4")
            fields[f"times{stage}"] = (group.center_times, "<f4")
        fields[f"idx{stage}"] = (group.idx, "<u2" if group.points.shape[1] <= 1 << 16 else "<i4")
    return fields


def _record(groups: list[Grouping], sources: list[_Source]) -> np.dtype:
    fields = _stored(groups, sources).items()
    return np.dtype([(name, kind, tuple(values.shape[1:])) for name, (values, kind) in fields])


def _tensor(values: np.ndarray, like: Tensor) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values)).to(like)
