"""Views and pictures of a video to compare, and the source that reads them one at a time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dpcli.store.views import ViewsHeader


@dataclass(frozen=True)
class View:
    """Describes one camera's video. names: what it goes by, its own first; role: reference | train | test."""

    names: tuple[str, ...]
    role: str

    @property
    def title(self) -> str:
        """Returns the name that the view goes by first."""
        return self.names[0]


@dataclass(frozen=True)
class Picture:
    """Holds a frame as it is stored: rgba u8 (H,W,4) with straight alpha, or values f32 (H,W,4) premultiplied with alpha."""

    rgba: np.ndarray | None = None
    values: np.ndarray | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Returns width and height in pixels."""
        height, width = (self.rgba if self.values is None else self.values).shape[:2]
        return width, height

    @property
    def unusable(self) -> int:
        """Returns how many pixels have a NaN or infinite value."""
        return 0 if self.values is None else int((~np.isfinite(self.values)).any(-1).sum())

    def over(self, background: Sequence[float]) -> np.ndarray:
        """Returns the colors f32 (3,H,W) in 0..1 over a background color (3) in 0..1."""
        behind = np.asarray(background, np.float32)
        if self.values is None:
            from dpcli.evaluate.video.image_kernels import composite

            out = np.empty((3, *self.rgba.shape[:2]), np.float32)
            composite(np.ascontiguousarray(self.rgba), behind, out)
            return out
        mixed = self.values[..., :3] + (1 - self.values[..., 3:]) * behind
        return np.ascontiguousarray(np.clip(mixed, 0, 1).transpose(2, 0, 1), np.float32)

    def mask(self) -> np.ndarray:
        """Returns the pixels of the object, u8 (H,W): alpha of one half or more."""
        alpha = self.rgba[..., 3] >= 128 if self.values is None else self.values[..., 3] >= 0.5
        return alpha.astype(np.uint8)


def mean_rate(times: Sequence[float] | None) -> float | None:
    """Returns frames a second of rising times in seconds, None where they tell none.

    >>> mean_rate([0.0, 0.5, 1.0])
    2.0
    """
    return (len(times) - 1) / float(times[-1] - times[0]) if times is not None and len(times) > 1 else None


class Source(ABC):
    """Gives the videos of one object. `pictures` reads the frames of a view in rising order, one in memory at a time.

    frames: of each view, None = any (a scene can be seen at any time). has_alpha: whether the object is cut out.
    times: of the frames, rising seconds, None where they aren't known. numbers: those in the names of each view's frames,
    None where names have none, or several.
    """

    path: Path
    kind: str
    views: list[View]
    frames: list[int] | None
    has_alpha: bool = True
    times: Sequence[float] | None = None
    numbers: Sequence[Sequence[int] | None] | None = None
    header: ViewsHeader | None = None
    provenance: list[dict] = []

    @property
    def rate(self) -> float | None:
        """Returns the frames a second in the mean, None where it isn't known."""
        return mean_rate(self.times)

    @abstractmethod
    def pictures(self, view: int, frames: Sequence[int]) -> Iterator[Picture]:
        """Yields the frames of a view, in rising order."""

    def close(self) -> None:  # noqa: B027  most sources hold nothing open
        """Lets go of open files."""
