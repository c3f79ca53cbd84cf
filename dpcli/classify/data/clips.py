"""Clips of a `clouds` file: their frames, the points drawn of each, and the points' coordinates."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dpcli.classify.data.augment import NONE, Augmentation
from dpcli.classify.data.slots import changed_rows, in_slots, slot_rows
from dpcli.classify.network.config import KinetConfig
from dpcli.errors import DataError
from dpcli.runtime.seeds import ClassifyStream, generator
from dpcli.store import CloudSequence, CloudsReader
from dpcli.store.schema import KEPT, kept_name


@dataclass(frozen=True)
class Clip:
    """Names frames of one sequence by number; a number repeats where a short video is padded.

    held: one of the video's frames takes the place of all, so that nobody moves and the clip shows no class.
    """

    sequence: int
    frames: tuple[int, ...]
    held: bool = False


def clip_starts(length: int, frames: int, count: int | None) -> list[int]:
    """Returns the first frames of the clips of a video: every one (stride 1), or `count` of them spread evenly.

    >>> clip_starts(length=10, frames=4, count=3)
    [0, 3, 6]
    """
    last = max(length - frames, 0)
    if count is None or count > last:
        return list(range(last + 1))
    if count == 1:
        return [last // 2]
    return sorted({round(i * last / (count - 1)) for i in range(count)})


def clip_frames(length: int, frames: int, start: int) -> tuple[int, ...]:
    """Returns `frames` consecutive frames from `start`; the last frame is held where the video is too short.

    >>> clip_frames(length=5, frames=4, start=3)
    (3, 4, 4, 4)
    """
    return tuple(min(start + t, length - 1) for t in range(frames))


def uniform_frames(length: int, frames: int, phase: float = 0.0) -> tuple[int, ...]:
    """Returns `frames` frames over the whole video: int((j + phase) * length / frames), phase in [0, 1).

    Phase 0 is what the gesture benchmarks take. Training draws one phase a clip: one for each j would shake the
    time between frames, and with it every speed.

    >>> uniform_frames(length=10, frames=4)
    (0, 2, 5, 7)
    """
    return tuple(int(t) for t in np.minimum((np.arange(frames) + phase) * length // frames, length - 1))


class OneVideo:
    """Holds one video that is no file, or of a stream its last `size` frames, and gives them by number as a reader does.

    fields: the names of the kept columns that follow x, y and z in each frame.
    """

    def __init__(self, name: str, fields: Sequence[str] = (), size: int | None = None) -> None:
        self.path, self.names, self.fields, self.size = name, (name,), tuple(fields), size
        self._frames: deque[np.ndarray] = deque(maxlen=size)
        self.count = 0  # frames so far

    @classmethod
    def of(cls, sequence: CloudSequence) -> OneVideo:
        """Returns a sequence as such a video, with all of its kept columns."""
        video = cls(sequence.name, tuple(sequence.extra))
        for frame in frames_with_columns(sequence, video.fields):
            video.append(frame)
        return video

    def append(self, points: np.ndarray) -> None:
        """Takes the next frame, f32 (P,3+F) with the video's columns; the oldest one leaves where there are `size`."""
        self._frames.append(points)
        self.count += 1

    @property
    def frames(self) -> list[np.ndarray]:
        """Returns the frames that are held, the oldest first."""
        return list(self._frames)

    @property
    def first(self) -> int:
        """Returns the number of the oldest frame that is held."""
        return self.count - len(self._frames)

    @property
    def frame_counts(self) -> list[int]:
        """Returns the number of frames of each video, as a reader does: of this one video, those so far."""
        return [self.count]

    def read(self, sequence: int, frames: Sequence[int], fields: Sequence[str] = ()) -> CloudSequence:
        """Returns frames by their number in the video, with all columns; they must still be held."""
        shown = [self._frames[t - self.first] for t in frames]
        found = CloudSequence.from_frames(self.names[sequence], [frame[:, :3] for frame in shown])
        for place, name in enumerate(self.fields, 3):
            found.extra[name] = np.concatenate([frame[:, place] for frame in shown])
        return found


def frames_with_columns(sequence: CloudSequence, fields: Sequence[str]) -> list[np.ndarray]:
    """Returns the frames f32 (P,3+F) of a sequence, x, y and z with the kept columns of these names."""
    rows = np.column_stack([sequence.points, *(sequence.extra[name] for name in fields)])
    return [rows[start:end] for start, end in zip(sequence.frame_offsets, sequence.frame_offsets[1:])]


class ClipSource:
    """Loads clips of some sequences of a `clouds` file as arrays that a network takes. Picklable, for DataLoader workers.

    `timing` is `clips` (consecutive frames, as MSR-Action3D's peers), `uniform` (frames spread over the whole video) or `slots`
    (all frames, in as many equal parts as a clip has). `dropped` lists the videos left out because they are shorter than a
    clip (only with `drop_short`). `folds`: the member of the network that must not learn from a sequence in slots. Raises
    DataError where none is left, or the file lacks columns that the network reads.
    """

    def __init__(
        self,
        reader: CloudsReader | OneVideo,
        sequences: Sequence[int],
        config: KinetConfig,
        *,
        timing: str = "clips",
        augmentation: Augmentation = NONE,
        drop_short: bool = False,
        seed: int = 0,
        folds: Mapping[int, int] | None = None,
    ) -> None:
        self.folds = folds or {}
        self.reader, self.config, self.timing = reader, config, timing
        self.augmentation, self.drop_short, self.seed = augmentation, drop_short, seed
        check_columns(reader, config)
        lengths = reader.frame_counts
        self._rows: dict[int, np.ndarray] = {}  # of whole videos: sparse ones are small
        short = [s for s in sequences if lengths[s] < config.num_frames and timing != "slots"]
        self.dropped = [reader.names[s] for s in short] if drop_short else []
        self.padded = [] if drop_short else [reader.names[s] for s in short]
        left_out = set(short) if drop_short else set()
        self.sequences = [s for s in sequences if s not in left_out]
        if not self.sequences:
            raise DataError(
                f"{reader.path}: no video has {config.num_frames} frames; use fewer --frames or pad short videos"
            )

    def clips(self, count: int | None) -> list[Clip]:
        """Returns the clips of every video, for prediction: every start, or `count` a video."""
        return [clip for s in self.sequences for clip in self.video_clips(s, count)]

    def video_clips(self, sequence: int, count: int | None) -> list[Clip]:
        """Returns the clips of one video: every start, or `count`."""
        length, frames = int(self.reader.frame_counts[sequence]), self.config.num_frames
        if self.timing == "slots":
            return [Clip(sequence, shown) for shown in _looks(length, count or LOOKS)]
        if self.timing == "uniform":
            return [Clip(sequence, uniform_frames(length, frames, i / (count or 1))) for i in range(count or 1)]
        return [Clip(sequence, clip_frames(length, frames, start)) for start in clip_starts(length, frames, count)]

    def epoch(self, number: int, per_video: int | None, together: bool = False) -> list[Clip]:
        """Returns the clips of one training epoch in random order: every start of every video, or `per_video` random ones.

        together: a video's clips follow each other, each from another of as many equal parts of the video (Wang et al.,
        "Temporal Segment Networks", ECCV 2016).
        """
        rng = generator(self.seed, ClassifyStream.CLIPS, number)
        if together and per_video:
            videos = [[self._random_clip(s, rng, k, per_video) for k in range(per_video)] for s in self.sequences]
            return [clip for i in rng.permutation(len(videos)) for clip in self._some_still(videos[i], rng)]
        if per_video is None and self.timing == "clips":
            clips = self.clips(None)
        else:
            clips = [self._random_clip(s, rng) for s in self.sequences for _ in range(per_video or 1)]
        return [self._some_still([clips[i]], rng)[0] for i in rng.permutation(len(clips))]

    def target(self, clip: Clip) -> int:
        """Returns the number of the class that a clip should be taken for, -1 for none."""
        return -1 if clip.held else int(self.reader.labels[clip.sequence])

    def _some_still(self, clips: list[Clip], rng: np.random.Generator) -> list[Clip]:
        """Returns a video's clips, for the share `still` of all draws with one of their frames held; a single frame stays."""
        frames = min(self.config.num_frames, int(self.reader.frame_counts[clips[0].sequence]))
        if (
            self.timing == "slots"
            or frames < 2
            or not self.augmentation.still
            or rng.random() >= self.augmentation.still
        ):
            return clips
        shown = [(clip.sequence, clip.frames[rng.integers(len(clip.frames))]) for clip in clips]
        return [Clip(sequence, (frame,) * self.config.num_frames, held=True) for sequence, frame in shown]

    def _random_clip(self, sequence: int, rng: np.random.Generator, part: int = 0, parts: int = 1) -> Clip:
        """Returns a clip that starts in one of the equal parts of all starts of a video."""
        length, frames = int(self.reader.frame_counts[sequence]), self.config.num_frames
        if self.timing == "slots":
            return Clip(sequence, tuple(range(length)))
        if self.timing == "uniform":
            lost = int(rng.uniform(0, self.augmentation.crop) * length)
            start = int(rng.integers(lost + 1))
            return Clip(
                sequence, tuple(start + t for t in uniform_frames(length - lost, frames, (part + rng.random()) / parts))
            )
        steps = self.augmentation.frame_steps(frames, rng)
        span = int(steps[-1]) + 1
        starts = max(length - span, 0) + 1
        first, end = part * starts // parts, (part + 1) * starts // parts
        shown = clip_frames(length, span, int(rng.integers(first, max(end, first + 1))))
        return Clip(sequence, tuple(shown[step] for step in steps))

    def load(self, clip: Clip, *key: int) -> np.ndarray:
        """Returns the clip's points f32 (T,P,3), for timing slots (T,P,5+F) as `PointSlots` takes them; `key` (an epoch and a
        position, say) seeds the choice of points and the augmentation.
        """
        rng = generator(self.seed, ClassifyStream.POINTS, *key)
        if self.timing == "slots":
            return self._slots(clip, rng)
        sequence = self.reader.read(clip.sequence, clip.frames, fields=())
        points = np.stack(
            [sample_points(sequence.frame(t), self.config.points_per_frame, rng) for t in range(len(clip.frames))]
        )
        points = normalize(points, self.config.normalize)
        return points if self.augmentation == NONE else self.augmentation(points, rng)

    def load_shown(self, clip: Clip) -> np.ndarray:
        """Returns `load` of a clip as prediction takes it: the points drawn depend on the numbers of its frames alone, so a video has
        the same scores alone, at another place in its file, and in a stream."""
        return self.load(clip, 0, *clip.frames)

    def _slots(self, clip: Clip, rng: np.random.Generator) -> np.ndarray:
        config, number = self.config, clip.sequence
        length = int(self.reader.frame_counts[number])  # of a stream ever more, so that no list is made of it
        whole = len(clip.frames) == length and clip.frames == tuple(range(length))
        rows = self._rows.get(number) if whole else None
        if rows is None:
            rows = slot_rows(self.reader.read(number, clip.frames, fields=config.column_fields), config)
            if whole and self.augmentation != NONE:
                self._rows[number] = rows
        made = in_slots(changed_rows(rows, self.augmentation, config.signed_columns, rng), config, rng)
        if number in self.folds:
            made[..., 3] *= 2 + self.folds[number]  # 1 says no more than that there is a point
        return made


LOOKS = 4  # at a video in slots, at most
_END = 0.08  # of its frames that a look leaves out at an end


def _looks(length: int, count: int) -> list[tuple[int, ...]]:
    """Returns the frames of up to `count` looks at a video: whole, without its end, without its beginning, without both."""
    cut = int(_END * length)
    shown = ((0, length), (0, length - cut), (cut, length), (cut, length - cut))
    return [tuple(range(*ends)) for ends in dict.fromkeys(shown[:count])]


def check_columns(reader: CloudsReader | OneVideo, config: KinetConfig) -> None:
    """Raises DataError where a file, or a stream, lacks columns that the network reads."""
    fields = getattr(reader, "fields", ())
    missing = [name for name in config.columns if kept_name(name) not in fields]
    if missing:
        kept = [name for name in fields if name.startswith(KEPT) and name not in config.column_fields]
        others = sorted(name.removeprefix(KEPT) for name in kept)
        has = f" (the file has {', '.join(others)}: if one is the same by another name, call it so in the raw data)"
        raise DataError(
            f"{reader.path}: no column {', '.join(missing)}, which the network reads of every point; prepare the file with"
            f" --keep-fields {','.join(config.columns)}{has if others else ''}"
        )


def sample_points(frame: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Returns `count` points of a frame (N,3+F) in random order, drawn without replacement; of fewer, whole copies and some more.

    An empty frame gives `count` points at the origin.
    """
    if len(frame) == 0:
        return np.zeros((count, 3), np.float32)
    copies, rest = divmod(count, len(frame))
    picks = [rng.permutation(len(frame)) for _ in range(copies)]
    if rest:
        picks.append(rng.choice(len(frame), rest, replace=False))
    return frame[np.concatenate(picks)]


DEVIATION = 0.27  # length units, of y, under `height`: as of a body 1.1 tall, which the presets' radii are meant for


def normalize(points: np.ndarray, rule: str) -> np.ndarray:
    """Returns a clip's coordinates (T,P,3) as the configuration's `normalize` says.

    `height` makes bodies equally tall, whatever the unit: y, the vertical, deviates by `DEVIATION` in the median frame. One
    factor a clip, so that who crouches or rises within it still does. `image` is the gesture benchmarks' rule for (row,
    column, depth) in pixels and depth units: rows / 120, columns / 160, depth / its deviation, each about its mean over the
    clip.
    """
    if rule == "none":
        return points
    centered = points - points.mean((0, 1))
    if rule == "center":
        return centered
    if rule == "height":
        deviations = centered[..., 1].std(1, dtype=np.float64)
        seen = deviations[deviations > 1e-6]  # an empty frame says nothing about the body
        return (centered * np.float32(DEVIATION / np.median(seen) if len(seen) else 1)).astype(np.float32)
    if rule == "unit":
        return centered / max(float(np.linalg.norm(centered, axis=-1).max()), 1e-9)
    deviation = float(centered[..., 2].std())
    return (centered / np.array([120, 160, deviation if deviation > 1e-6 else 1], np.float32)).astype(np.float32)
