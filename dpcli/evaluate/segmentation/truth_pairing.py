"""Pairs a parts file with its truth: the same sequences, frames and points on both sides, or an error that says where not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.evaluate.results import LeftOut, counted_split, left_out, list_names, tell_split
from dpcli.store import CloudSequence, CloudsReader, PartsReader, PartsSample


@dataclass(frozen=True)
class SequencePair:
    """Holds one sequence: truth and prediction with the same points, and the predicted probabilities, motions and flow."""

    truth: CloudSequence
    predicted: CloudSequence
    parts: PartsSample

    def span(self, frame: int) -> slice:
        """Returns where the points of a frame stand among those of the sequence."""
        return slice(*self.truth.frame_offsets[frame : frame + 2].tolist())

    @property
    def spans(self) -> list[slice]:
        """Returns the span of each frame."""
        return [self.span(frame) for frame in range(self.truth.num_frames)]


class PairedSequences:
    """Gives the sequences of a parts file that count, each beside its truth, in the order of the parts file.

    split: only sequences of this split of the truth; "all" every one; None = "test" if there are any. Sequences on
    one side only are an error, with `intersect` they are left out and listed. fields: what the truth needs; instead:
    what serves as well where it lacks some of them; the attribute `fields` tells which of the two it is.
    Raises DataError when the truth lacks a field or nothing is left to compare.
    """

    def __init__(
        self,
        path: str | Path,
        truth: str | Path,
        *,
        split: str | None = None,
        intersect: bool = False,
        fields: Sequence[str] = ("part",),
        instead: Sequence[str] = (),
    ) -> None:
        self.predicted, self.truth = PartsReader(path), CloudsReader(truth)
        missing = [field for field in fields if field not in self.truth.fields]
        serves = bool(instead) and all(field in self.truth.fields for field in instead)
        if missing and not serves:
            other = f", nor {' and '.join(instead)}" if instead else ""
            raise DataError(
                f"{truth}: no {' and no '.join(missing)} in it{other}, so it can't be the truth; "
                "`dpc prepare` writes them for data sets that have them"
            )
        self.fields = tuple(instead if missing else fields)
        self._check_unit()
        tell_split(truth, split, self.truth.splits)
        self.split = counted_split(split, self.truth.splits)
        self.rows, self.left_out = self._match_names(intersect)

    def _check_unit(self) -> None:
        """Raises DataError for two units; one that a file doesn't name may be any."""
        unit, other = self.predicted.length_unit, self.truth.length_unit
        if unit and other and unit != other:
            raise DataError(
                f"{self.predicted.path}: length_unit {unit!r}, but {other!r} in {self.truth.path}; "
                "predict again from that file"
            )

    def _match_names(self, intersect: bool) -> tuple[list[tuple[int, int]], list[LeftOut]]:
        """Returns (index in the parts file, index in the truth) of what counts, and what doesn't."""
        row_of = {name: index for index, name in enumerate(self.truth.names)}
        names = self.predicted.names
        unknown = [name for name in names if name not in row_of]
        predicted = set(names)
        of_split = [
            name for name, own in zip(self.truth.names, self.truth.splits, strict=True) if self.split in ("all", own)
        ]
        not_predicted = [name for name in of_split if name not in predicted]
        if not intersect:
            self._check_names(unknown, not_predicted)
        counted = set(of_split)
        rows = [(index, row_of[name]) for index, name in enumerate(names) if name in counted]
        if not rows:
            raise DataError(
                f"{self.predicted.path}: no sequence of split {self.split!r} of {self.truth.path}; "
                "--split all takes every one"
            )
        return rows, left_out(
            {
                "the truth doesn't have": unknown,
                "not predicted": not_predicted,
                f"not of split {self.split!r}": [n for n in names if n in row_of and n not in counted],
            }
        )

    def _check_names(self, unknown: list[str], not_predicted: list[str]) -> None:
        if unknown:
            raise DataError(
                f"{self.truth.path}: has no {list_names(unknown)}, which {self.predicted.path} has; "
                "was it predicted from another? --intersect compares what both have"
            )
        if not_predicted:
            raise DataError(
                f"{self.predicted.path}: has no {list_names(not_predicted)} of split {self.split!r} of "
                f"{self.truth.path}; predict them too, or --intersect compares what both have"
            )

    def pair(self, place: int) -> SequencePair:
        """Returns the sequence at a place of `rows`. DataError at the first point in which the two files differ."""
        own, other = self.rows[place]
        truth = self.truth.read(other, fields=self.fields)
        predicted = self.predicted.read(own, fields=("part",))
        self._check_points(truth, predicted)
        return SequencePair(truth, predicted, self.predicted.read_parts(own))

    def _check_points(self, truth: CloudSequence, predicted: CloudSequence) -> None:
        where = f"{self.predicted.path}: {truth.name!r} has"
        again = f"in {self.truth.path}; predict again from that file"
        if truth.num_frames != predicted.num_frames:
            raise DataError(f"{where} {counted(predicted.num_frames, 'frame')}, {truth.num_frames} {again}")
        sizes, others = np.diff(predicted.frame_offsets), np.diff(truth.frame_offsets)
        if (sizes != others).any():
            frame = int((sizes != others).argmax())
            raise DataError(f"{where} {counted(sizes[frame], 'point')} in frame {frame}, {others[frame]} {again}")
        differ = (truth.points != predicted.points).any(axis=1)
        if differ.any():
            row = int(differ.argmax())
            frame = int(np.searchsorted(truth.frame_offsets, row, side="right")) - 1
            ours, theirs = (_point(sequence.points[row]) for sequence in (predicted, truth))
            point = row - int(truth.frame_offsets[frame])
            raise DataError(f"{where} point {point} of frame {frame} at {ours}, but {theirs} {again}")

    def close(self) -> None:
        """Closes both files."""
        self.predicted.close()
        self.truth.close()

    def __enter__(self) -> PairedSequences:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _point(xyz: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.7g}" for value in xyz.tolist()) + ")"


def named_truth(truth: str | Path | None) -> str | Path:
    """Returns the truth that a parts file needs. UsageError where none was named."""
    if truth is None:
        raise UsageError("--truth FILE is missing: the clouds file with the truth; only kept statistics need none")
    return truth
