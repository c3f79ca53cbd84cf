"""Files of kind `parts`: predictions for the points and frame pairs of each sequence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, UsageError, reading
from dpcli.store.clouds_reader import CloudsReader
from dpcli.store.clouds_writer import CloudsWriter
from dpcli.store.file import PACKED, data_set
from dpcli.store.schema import fields_of
from dpcli.store.sequence import LONGEST, NO_LENGTHS, TOLERANCE, CloudSequence, are_lengths, are_rigid

_FIELD = fields_of("parts")


@dataclass
class PartsSample:
    """Holds what was predicted for one sequence beside the part id of each point, which is the sequence's `part`.

    probability f32 (P,K) of each part, 0..1; pairs i32 (Q,2) source and target frame; motion f32 (Q,K,4,4) with
    x_target = R x_source + t; flow: for each pair f32 (N_source,3), the displacement of the source frame's points.
    """

    probability: np.ndarray
    pairs: np.ndarray
    motion: np.ndarray
    flow: list[np.ndarray]

    def validate(self, sequence: CloudSequence, num_parts: int) -> None:
        """Raises DataError unless shapes, ids, frames and values fit the sequence and the K parts of the file."""
        where = f"sample {sequence.name!r}"
        count, pairs = len(sequence.points), len(self.pairs)
        for key, value, shape in (
            ("probability", self.probability, (count, num_parts)),
            ("pairs", self.pairs, (pairs, 2)),
            ("motion", self.motion, (pairs, num_parts, 4, 4)),
        ):
            if value.shape != shape:
                raise DataError(f"{where}: {key} has shape {value.shape}, expected {shape}")
        self._check_ids(sequence, num_parts, where)
        _check_probability(self.probability, where)
        _check_motion(self.motion, where)
        self._check_flow(sequence, where)

    def _check_ids(self, sequence: CloudSequence, num_parts: int, where: str) -> None:
        for key, values, low, high in (
            ("part", sequence.part, -1, num_parts),
            ("pairs", self.pairs, 0, sequence.num_frames),
        ):
            wrong = (values < low) | (values >= high)
            if wrong.any():
                raise DataError(f"{where}: {key} holds {values[wrong][0]}, expected {low}..{high - 1}")

    def _check_flow(self, sequence: CloudSequence, where: str) -> None:
        if len(self.flow) != len(self.pairs):
            raise DataError(
                f"{where}: flow of {counted(len(self.flow), 'pair')}, expected {len(self.pairs)}, one array for each"
            )
        sizes = np.diff(sequence.frame_offsets)
        for (source, target), flow in zip(self.pairs.tolist(), self.flow, strict=True):
            if flow.shape != (sizes[source], 3):
                raise DataError(
                    f"{where}: flow {source} -> {target} has shape {flow.shape}, expected one row for each "
                    f"of the {sizes[source]} points of frame {source}"
                )
        if all(map(are_lengths, self.flow)):
            return
        bad = [np.flatnonzero(~np.isfinite(flow).all(axis=1)) for flow in self.flow]
        count, total = sum(map(len, bad)), sum(map(len, self.flow))
        if count:
            row = next(row for row, own in enumerate(bad) if len(own))
            source, target = self.pairs[row].tolist()
            raise DataError(
                f"{where}: {count} of {total} points with NaN or infinite flow, the first is point "
                f"{bad[row][0]} of flow {source} -> {target}"
            )
        raise DataError(f"{where}: flow holds {NO_LENGTHS}; predict again")


def _check_probability(probability: np.ndarray, where: str) -> None:
    bad = np.flatnonzero(~np.isfinite(probability).all(axis=1))
    if len(bad):
        raise DataError(
            f"{where}: {len(bad)} of {len(probability)} points with NaN or infinite probability, "
            f"the first is point {bad[0]}"
        )
    wrong = (probability < -TOLERANCE) | (probability > 1 + TOLERANCE)
    if wrong.any():
        raise DataError(f"{where}: probability holds {probability[wrong][0]}, expected 0..1")


def _check_motion(motion: np.ndarray, where: str) -> None:
    rigid = are_rigid(motion) & (np.abs(motion) < LONGEST).all((-1, -2))
    if not rigid.all():
        pair, part = np.argwhere(~rigid)[0]
        raise DataError(
            f"{where}: motion of part {part} in pair {pair} is not a rigid one "
            "(a rotation and a translation, last row 0 0 0 1)"
        )


class PartsWriter(CloudsWriter):
    """Writes what CloudsWriter does (same options and guarantees), and with each sample a PartsSample; K = `num_parts`.

    `part` is always among the fields. Motions of parts that a sequence lacks are the identity, probabilities 0.
    """

    kind = "parts"
    types = _FIELD

    def __init__(self, path: str | Path, *, num_parts: int, fields: Sequence[str] = (), **options: Any) -> None:
        if num_parts < 1:
            raise UsageError(f"a parts file of {num_parts} parts: expected at least one")
        self.num_parts = num_parts
        super().__init__(path, fields=fields if "part" in fields else (*fields, "part"), **options)

    def _about(self) -> dict[str, Any]:
        return super()._about() | {"num_parts": self.num_parts}

    def _create(self) -> None:
        super()._create()
        self._create_floats("part_probability", self.num_parts)
        self._create_floats("flow", 3)
        file, shape = self._file, (self.num_parts, 4, 4)
        file.create_dataset(
            "part_motion", (0, *shape), _FIELD["part_motion"].dtype, maxshape=(None, *shape), chunks=(64, *shape)
        )
        file.create_dataset("pair", (0, 2), _FIELD["pair"].dtype, maxshape=(None, 2), chunks=(1024, 2), **PACKED)
        for name in ("pair_offsets", "flow_offsets"):
            file.create_dataset(name, data=np.zeros(1, _FIELD[name].dtype), maxshape=(None,), chunks=(4096,), **PACKED)

    def write(  # type: ignore[override]
        self,
        sequence: CloudSequence,
        probability: np.ndarray,  # f32 (P,K)
        pairs: np.ndarray,  # i32 (Q,2)
        motion: np.ndarray,  # f32 (Q,K,4,4)
        flow: Sequence[np.ndarray],  # Q times f32 (N_source,3)
    ) -> None:
        """Appends one sample, whose `part` are the hard ids. Raises as `CloudsWriter.write`, `PartsSample.validate`."""
        self._check(sequence)
        said = PartsSample(
            np.asarray(probability, _FIELD["part_probability"].dtype),
            np.asarray(pairs, _FIELD["pair"].dtype).reshape(-1, 2),
            np.asarray(motion, _FIELD["part_motion"].dtype),
            [np.asarray(one, _FIELD["flow"].dtype) for one in flow],
        )
        said.validate(sequence, self.num_parts)
        self._append_said(said)
        self._append_sequence(sequence)
        self._note(sequence, said.probability, said.pairs, said.motion, said.flow)

    def _append_said(self, said: PartsSample) -> None:
        pairs, rows = len(self._file["pair"]), len(self._file["flow"])
        self._append("part_probability", said.probability)
        self._append("pair", said.pairs)
        self._append("pair_offsets", np.array([pairs + len(said.pairs)]))
        self._append("part_motion", said.motion)
        self._append("flow", np.concatenate([np.zeros((0, 3), np.float32), *said.flow]))
        self._append("flow_offsets", rows + np.cumsum([len(one) for one in said.flow], dtype=np.int64))


class PartsReader(CloudsReader):
    """Reads a `parts` file as CloudsReader does; `read_parts` reads what was predicted for one sequence. `num_parts` = K.

    The layout is checked on opening, the values of a sequence when it is read: DataError.
    """

    kinds = ("parts",)

    def _load_index(self, file: h5py.File) -> None:
        super()._load_index(file)
        data_set(file, "part")
        probability = file.get("part_probability")
        if probability is None or len(probability) != self.num_points:
            found = "is missing" if probability is None else f"has shape {probability.shape}"
            raise DataError(f"{self.path}: part_probability {found}, expected ({self.num_points}, parts)")
        self.num_parts = int(probability.shape[1])
        self._pair_offsets = self._rising(file, "pair_offsets", len(self.names), len(data_set(file, "pair")))
        pairs = int(self._pair_offsets[-1])
        self._flow_offsets = self._rising(file, "flow_offsets", pairs, len(data_set(file, "flow")))
        motions = data_set(file, "part_motion").shape
        if motions[1] != self.num_parts:
            raise DataError(f"{self.path}: part_motion has shape {motions}, expected (n, {self.num_parts}, 4, 4)")
        if motions[0] != pairs:
            raise DataError(f"{self.path}: part_motion has {motions[0]} rows for {pairs} pairs")

    def _rising(self, file: h5py.File, name: str, spans: int, end: int) -> np.ndarray:
        offsets = self._offsets(file, name, None)
        if len(offsets) != spans + 1 or offsets[-1] != end:
            raise DataError(
                f"{self.path}: {name} has {len(offsets)} rows ending at {offsets[-1]}, "
                f"expected {spans + 1} ending at {end}"
            )
        return offsets

    @property
    def pair_counts(self) -> np.ndarray:
        """Counts the frame pairs of each sequence, i64 (S)."""
        return np.diff(self._pair_offsets)

    def given(self, index: int) -> list:
        """Returns sequence `index` as the writer of such a file takes it again."""
        said = self.read_parts(index)
        return [self.read(index), said.probability, said.pairs, said.motion, said.flow]

    def read_parts(self, index: int) -> PartsSample:
        """Reads what is said of sequence `index`; raises DataError when its values don't fit the sequence."""
        with reading(self.path):
            return self._read_parts(index, 0, int(self.frame_counts[index]))

    def read_parts_between(self, index: int, first: int, end: int) -> PartsSample:
        """Reads what `read_parts` does, but of the frames `first` to `end` - 1 and the pairs among them alone.

        Its pairs count frames from `first`.
        """
        with reading(self.path):
            return self._read_parts(index, first, end)

    def _read_parts(self, index: int, first: int, end: int) -> PartsSample:
        start = int(self._sequence_offsets[index])
        frames = self._frame_offsets[start + first : start + end + 1]
        points = slice(int(frames[0]), int(frames[-1]))
        begin, stop = map(int, self._pair_offsets[index : index + 2])
        pairs = self._set("pair")[begin:stop]
        chosen = np.arange(len(pairs))
        if end - first < self.frame_counts[index]:
            chosen = np.flatnonzero(((pairs >= first) & (pairs < end)).all(1))
        low, high = (int(chosen[0]), int(chosen[-1]) + 1) if len(chosen) else (0, 0)
        offsets = self._flow_offsets[begin + low : begin + high + 1]
        flow = np.split(self._set("flow")[int(offsets[0]) : int(offsets[-1])], offsets[1:-1] - offsets[0])
        said = PartsSample(
            self._set("part_probability")[points],
            pairs[chosen] - np.int32(first),
            self._set("part_motion")[begin + low : begin + high][chosen - low],
            [flow[i] for i in chosen - low],
        )
        sequence = CloudSequence(
            self.names[index],
            np.empty((points.stop - points.start, 3), np.float32),
            frames - frames[0],
            part=self._set("part")[points],
        )
        try:
            said.validate(sequence, self.num_parts)
        except DataError as error:
            raise DataError(f"{self.path}: {error}; predict again") from None
        return said
