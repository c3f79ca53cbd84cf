"""Declares what the drawing of point clouds needs from a sequence and from a reader, whatever their classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np


class PointSequence(Protocol):
    """Describes a point cloud sequence: frame t is points[frame_offsets[t]:frame_offsets[t + 1]]."""

    name: str
    points: np.ndarray  # [P, 3]
    frame_offsets: np.ndarray  # [T + 1]
    color: np.ndarray | None  # [P, 3]
    part: np.ndarray | None  # [P]
    shift: np.ndarray | None  # [3], what was taken off the original coordinates

    @property
    def num_frames(self) -> int:
        """Returns the number of frames, T."""


class CloudsSource(Protocol):
    """Describes an open file of S sequences."""

    path: Path
    length_unit: str
    class_names: Sequence[str]
    fields: Sequence[str]
    names: Sequence[str]
    splits: Sequence[str]
    labels: np.ndarray  # [S]
    frame_counts: np.ndarray  # [S]
    provenance: Sequence[Mapping[str, Any]]

    def read(self, index: int, frames: Any, fields: Any) -> PointSequence:
        """Returns some frames of a sequence with some of its fields."""


class ViewsSource(Protocol):
    """Describes an open file of pictures of V cameras at T times."""

    header: Any  # num_views, num_frames, size, role, reference, camera_centers()

    def rgba(self, view: int, frame: int) -> np.ndarray:
        """Returns a picture u8 (H,W,4) with straight alpha."""
