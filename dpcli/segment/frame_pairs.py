"""Training pairs: two neighboring frames of a sequence, thinned to the network's number of points and to size 1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.errors import DataError
from dpcli.runtime.progress import log
from dpcli.runtime.seeds import SegmentStream, generator
from dpcli.segment.rigid_motions import move_each
from dpcli.store import CloudSequence, CloudsReader
from dpcli.store.parts import PartsReader, PartsSample

_SURE = 0.5  # probability below which a predicted part counts as unknown
_ONE_STRAY_OF, _MOST_STRAYS, _APART = 64, 8, 2.0  # points of a frame; and how much farther than all others they lie
MOTION_FIELDS = ("pose", "scene_flow")  # what may tell the true motion, the better one first


@dataclass(frozen=True)
class Pair:
    """Names frames `first` and `first + 1` of a sequence; `number` counts all pairs of a source."""

    number: int
    sequence: int
    first: int


@dataclass
class LoadedPair:
    """Holds one pair. points f32 (2,N,3): in units of the two frames' diameter, centered; part i64 (2,N): -1 unknown.

    flow f32 (2,N,3): the true one each way, None without poses and scene_flow. known bool (2,N): where it is true, which
    poses don't tell of points of unknown part.
    """

    points: np.ndarray
    part: np.ndarray
    flow: np.ndarray | None
    known: np.ndarray


def sequence_scale(frames: list[np.ndarray]) -> float:
    """Returns 1 / (twice the largest distance of a point from its frame's mean), stray points left out.

    A sequence times this has diameter 1 or less.

    >>> sequence_scale([np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]])])
    0.25
    """
    known = [without_strays(frame) for frame in frames if len(frame)]
    reach = max((float(np.linalg.norm(f - f.mean(0), axis=1).max()) for f in known), default=0.0)
    return 0.5 / reach if reach > 0 else 1.0


def without_strays(frame: np.ndarray) -> np.ndarray:
    """Returns the points (N,3) of a frame without stray ones, such as flying pixels, beside which an object would seem tiny:
    one of 64 and eight at most, each more than twice as far from the middle as all that stay. More may be a further object.
    """
    most = min(len(frame) // _ONE_STRAY_OF, _MOST_STRAYS)
    if not most:
        return frame
    distance = np.linalg.norm(frame - np.median(frame, axis=0), axis=1)
    far = np.sort(distance)[-most - 1 :]
    apart = np.flatnonzero((far[:-1] > 0) & (far[1:] > _APART * far[:-1]))
    return frame[distance <= far[apart[0]]] if len(apart) else frame


def first_copies(points: np.ndarray) -> np.ndarray:
    """Returns the indices, ascending, of the points (N,D) that no earlier one equals.

    >>> first_copies(np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]])).tolist()
    [0, 1]
    """
    return np.sort(np.unique(points, axis=0, return_index=True)[1])


def choose_points(count: int, wanted: int, rng: np.random.Generator) -> np.ndarray:
    """Returns random indices i64 (wanted) into `count` points.

    No index repeats where there are enough points; else all are there, and some again.
    """
    if count >= wanted:
        return rng.permutation(count)[:wanted]
    return np.concatenate([rng.permutation(count), rng.integers(0, count, wanted - count)])


class PairSource:
    """Gives all pairs of adjacent frames with points of some sequences.

    A frame's points are drawn once, since its flow belongs to them. With a PartsReader, parts and flow are those that the
    file predicts. Raises DataError where there is no pair.
    """

    def __init__(self, reader: CloudsReader, sequences: list[int], points: int, seed: int) -> None:
        self.reader, self.points, self.seed = reader, points, seed
        sizes = np.split(reader.frame_sizes, np.cumsum(reader.frame_counts)[:-1])
        spots = [(s, f) for s in sequences for f in range(len(sizes[s]) - 1)]
        both = [(s, f) for s, f in spots if sizes[s][f : f + 2].all()]
        if not both:
            without = ", all with a frame without points" if spots else ""
            raise DataError(
                f"{reader.path}: no two frames that follow each other in {len(sequences)} sequences to train on{without}"
            )
        if len(both) < len(spots):
            log.warn(
                f"{reader.path}: {len(spots) - len(both)} of {len(spots)} pairs of frames left out: one has no points"
            )
        self.pairs = [Pair(n, s, f) for n, (s, f) in enumerate(both)]
        truth = next((name for name in MOTION_FIELDS if name in reader.fields), None)
        self.fields = [name for name in ("part", truth) if name in reader.fields]

    def load(self, pair: Pair) -> LoadedPair:
        """Returns one pair from the file."""
        frames = [pair.first, pair.first + 1]
        sample = self.reader.read(pair.sequence, frames, self.fields)
        clouds = [sample.frame(t) for t in range(2)]
        picks = [
            choose_points(len(c), self.points, generator(self.seed, SegmentStream.FRAME_POINTS, pair.sequence, f))
            for c, f in zip(clouds, frames)
        ]
        points = np.stack([cloud[pick] for cloud, pick in zip(clouds, picks)])
        parts = np.stack([frame_parts(sample, t)[pick] for t, pick in enumerate(picks)])
        if isinstance(self.reader, PartsReader):
            said = self.reader.read_parts_between(pair.sequence, pair.first, pair.first + 2)
            flow = _predicted_flow(said, pair, points, parts, f"{self.reader.path}: {sample.name!r}")
            sure = np.split(said.probability.max(1) >= _SURE, [len(clouds[0])])
            parts = np.where(np.stack([own[pick] for own, pick in zip(sure, picks)]), parts, -1)
        else:
            flow = self._flow(pair, sample, points, parts, picks)
        scale = sequence_scale(clouds)
        center = np.float32(points.mean((0, 1)))
        known = parts >= 0 if sample.scene_flow is None else np.ones(parts.shape, bool)
        return LoadedPair(
            np.float32((points - center) * scale), parts, None if flow is None else np.float32(flow * scale), known
        )

    def _flow(
        self, pair: Pair, sample: CloudSequence, points: np.ndarray, parts: np.ndarray, picks: list[np.ndarray]
    ) -> np.ndarray | None:
        """Returns the true flow (2,N,3) of the chosen points, each way."""
        if sample.pose is not None:
            if not (np.isfinite(sample.pose).all() and np.linalg.det(sample.pose).all()):
                raise DataError(f"{sample.name}: a pose is not a rigid motion: its matrix has no inverse")
            return np.stack([true_flow(points[t], parts[t], sample.pose[t], sample.pose[1 - t]) for t in range(2)])
        if sample.scene_flow is None:
            return None
        forth, back = np.split(sample.scene_flow, [sample.frame_offsets[1]])
        if pair.first + 2 < self.reader.frame_counts[pair.sequence]:  # scene_flow leads on, to a third frame
            back = backward_flow(sample.frame(0), forth, sample.frame(1))
        return np.stack([forth[picks[0]], back[picks[1]]])


def _predicted_flow(said: PartsSample, pair: Pair, points: np.ndarray, parts: np.ndarray, where: str) -> np.ndarray:
    """Returns the flow (2,N,3) that the predicted motions, of the pair's frames alone, give points of parts (2,N), each way."""
    known = np.flatnonzero((said.pairs == [0, 1]).all(1))
    if not len(known):
        raise DataError(f"{where} has no motion from frame {pair.first} to {pair.first + 1}; predict it again")
    motion = said.motion[known[0]].astype(np.float64)
    still = np.broadcast_to(np.eye(4), motion.shape)
    return np.stack([true_flow(points[0], parts[0], still, motion), true_flow(points[1], parts[1], motion, still)])


def backward_flow(points: np.ndarray, flow: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Returns the flow (M,3) of `others`, the next frame's points, back.

    It is minus the flow of the point (N,3) that its flow leads nearest.
    """
    from scipy.spatial import cKDTree

    return -flow[cKDTree(points + flow).query(others)[1]]


def frame_parts(sample: CloudSequence, t: int) -> np.ndarray:
    """Returns the part ids i64 of frame t, -1 where unknown."""
    bounds = slice(sample.frame_offsets[t], sample.frame_offsets[t + 1])
    count = bounds.stop - bounds.start
    return np.full(count, -1) if sample.part is None else sample.part[bounds].astype(np.int64)


def true_flow(points: np.ndarray, part: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Returns the flow (N,3) of points whose parts have the poses source (parts,4,4), to the poses target.

    Points of unknown parts move as part 0.
    """
    return move_each((target @ np.linalg.inv(source))[np.clip(part, 0, None)], points) - points


def epoch_order(source: PairSource, epoch: int, most: int | None) -> list[Pair]:
    """Returns the epoch's pairs, shuffled; at most `most`, another draw each epoch."""
    order = generator(source.seed, SegmentStream.PAIR_ORDER, epoch).permutation(len(source.pairs))
    return [source.pairs[i] for i in order[:most]]
