"""Mistakes that spoil a comparison of pictures and that the pictures themselves tell of: colors, alpha, numbers and times of frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.video.protocol import VideoProtocol, scaled
from dpcli.evaluate.video.sources.source import Picture, Source

_RATE = 0.01  # how far apart two rates are the same
_SOFT, _MANY = (0.1, 0.9), 20  # alpha in between, and pixels of such that can tell whether colors were multiplied by it


@dataclass
class Mistakes:
    """Notes what looks like a mistake in pictures of a prediction and of the truth, whatever passes go over them."""

    predicted: Source
    truth: Source
    protocol: VideoProtocol
    brightest: tuple[int, int] = (0, 0)  # 8-bit color of the prediction, of the truth, until one is plausible
    hollow: set[str] = field(default_factory=set)  # predicted pictures without an object
    swapped: str = ""  # the first picture that seems to have red and blue swapped
    multiplied: str = ""  # the side and the first picture whose colors seem multiplied by alpha
    misnumbered: str = ""  # the first frames whose names are numbered in different steps

    def look(self, predicted: Picture, truth: Picture, view: str, frame: int) -> None:
        """Notes what tells broken pictures: 0..1 saved as 8 bits, no object, red and blue swapped, colors times alpha."""
        where = f"view {view!r}, frame {frame}"
        if self.brightest[0] <= 1 and predicted.rgba is not None and truth.rgba is not None:
            pair = (int(p.rgba[..., :3].max()) for p in (predicted, truth))
            self.brightest = tuple(max(*both) for both in zip(self.brightest, pair, strict=True))  # type: ignore
        if (
            self.predicted.has_alpha
            and not (predicted.rgba if predicted.values is None else predicted.values)[..., 3].any()
        ):
            self.hollow.add(where)
        if frame:
            return
        if not self.swapped and _red_and_blue_swapped(scaled(predicted, self.protocol), scaled(truth, self.protocol)):
            self.swapped = where
        if not self.multiplied and predicted.size == truth.size:
            sides = (("prediction", predicted, truth), ("truth", truth, predicted))
            found = (side for side, own, other in sides if _multiplied_by_alpha(own, other.over((1.0, 1.0, 1.0))))
            self.multiplied = next((f"{side} ({where})" for side in found), "")

    def compare_numbers(self, ours: int, theirs: int) -> str:
        """Notes where the names of a pair of views number frames otherwise, and returns what `_numbered_otherwise` found first."""
        self.misnumbered = self.misnumbered or self._numbered_otherwise(ours, theirs)
        return self.misnumbered

    def _numbered_otherwise(self, ours: int, theirs: int) -> str:
        """Returns, in words, the first frames that the names of both sides number in different steps; "" without such.

        Of sides that have not equally many, the names count themselves: the first frame may be what one lacks. Where only one
        side has numbers, these should be even.
        """
        own, other = (s.numbers[i] if s.numbers else None for s, i in ((self.predicted, ours), (self.truth, theirs)))
        if own is None or other is None:
            return _gap_in(own or other or [])
        first = (own[0], other[0]) if len(own) == len(other) else (0, 0)
        odd = [k for k, (a, b) in enumerate(zip(own, other)) if a - first[0] != b - first[1]]
        return f"{own[odd[0]]} with {other[odd[0]]}" if odd else ""

    def _timed_otherwise(self) -> str:
        """Returns, in words, the first frames that lie more than half a frame apart in time, counted from the first frame of
        each side; "" without such. Both sides have a rate, nearly the same.
        """
        own, other = (np.asarray(s.times) - s.times[0] for s in (self.predicted, self.truth))
        count = min(len(own), len(other))
        apart = own[:count] * self.predicted.rate - other[:count] * self.truth.rate  # frames: rates may differ a little
        odd = np.flatnonzero(np.abs(apart) > 0.5)
        return f"frame {odd[0]}: after {own[odd[0]]:.4g} s and {other[odd[0]]:.4g} s" if len(odd) else ""

    def refuse_dim(self) -> None:
        """Raises DataError where colors in 0..1 were saved as whole numbers."""
        if self.brightest[0] == 1 < self.brightest[1]:
            raise DataError(
                f"{self.predicted.path}: 8-bit pictures with no value above 1; colors in 0..1 were saved without "
                "multiplying by 255"
            )

    def notes(self) -> list[str]:
        """Returns a sentence on each thing that looks like a mistake."""
        lines = []
        rates = self.predicted.rate, self.truth.rate
        if all(rates) and abs(rates[0] / rates[1] - 1) > _RATE:
            lines.append(
                f"The prediction plays {rates[0]:.4g} frames a second, the truth {rates[1]:.4g}: compared by their number."
            )
        elif all(rates) and (odd := self._timed_otherwise()):
            lines.append(
                f"Frames are compared in their order, though they were filmed at other moments ({odd}): does one side lack some?"
            )
        if self.misnumbered:
            lines.append(
                f"Frames are compared in their order, though their names number them otherwise ({self.misnumbered}): does one "
                "side lack some, or have every second one?"
            )
        if self.swapped:
            lines.append(
                f"Red and blue look swapped in the prediction ({self.swapped}): with them exchanged it is much "
                "closer to the truth; was it saved as BGR?"
            )
        if self.multiplied:
            lines.append(
                f"Colors look multiplied by alpha in the {self.multiplied}: read so, they are much closer to the other's; "
                "straight alpha is expected."
            )
        if self.hollow:
            lines.append(f"Predicted pictures without an object (alpha 0 everywhere): {len(self.hollow)}.")
        return lines


def _gap_in(numbers: Sequence[int]) -> str:
    """Returns, in words, the first two rising numbers that lie at least twice as far apart as the nearest; "" without such.

    >>> _gap_in([0, 1, 3, 4]), _gap_in([0, 5, 10])
    ('3 right after 1', '')
    """
    steps = np.diff(numbers)
    wide = np.flatnonzero(steps >= 2 * steps.min()) if len(steps) else []
    return f"{numbers[wide[0] + 1]} right after {numbers[wide[0]]}" if len(wide) else ""


def _red_and_blue_swapped(predicted: np.ndarray, truth: np.ndarray) -> bool:
    """Returns whether exchanging red and blue takes away nearly all of the error, of pictures f32 (3,H,W) in 0..1."""
    error, other = (float(np.square(p - truth).mean()) for p in (predicted, predicted[::-1]))
    return error > 1e-3 and other < 0.1 * error


def _multiplied_by_alpha(picture: Picture, other: np.ndarray) -> bool:
    """Returns whether colors that count as multiplied by alpha lose nearly all of their error where alpha is in between.

    other: the other side's picture on white, f32 (3,H,W) in 0..1.
    """
    values = picture.values if picture.rgba is None else picture.rgba.astype(np.float32) / 255
    alpha = values[..., 3]
    soft = (alpha > _SOFT[0]) & (alpha < _SOFT[1])
    if soft.sum() < _MANY or not np.isfinite(values).all():
        return False
    colors, alpha, other = values[soft, :3], alpha[soft, None], other[:, soft].T
    straight = colors / alpha if picture.rgba is None else colors
    if (straight > alpha + 0.01).any():
        return False
    error, read_so = (
        float(np.square(shown - other).mean()) for shown in (straight * alpha + 1 - alpha, straight + 1 - alpha)
    )
    return error > 1e-3 and read_so < 0.1 * error
