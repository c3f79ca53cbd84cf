"""Makes a sample of the clouds of one sequence, as they lie in their files: cleaned, in one unit, near the origin."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.path_names import first_names
from dpcli.prepare.cloud_formats.cloud import Cloud, as_float32, without
from dpcli.prepare.cloud_formats.colors import as_bytes
from dpcli.prepare.labels import LabelTable, labels_of_folders, read_labels
from dpcli.prepare.reader import Item, Reader, Sample, describe, drop_empty_frames, offsets
from dpcli.prepare.scans.cleaning import CROWDED, clean, ends_of, is_crowded
from dpcli.store import CloudSequence
from dpcli.store.schema import METERS, kept_name, kept_names

_JUDGED = 8  # frames, in which points are looked for that lie at one and the same place
_FAR_AWAY = 1e4  # beyond this a float32 step exceeds half a millimeter: map coordinates must be shifted first
_WIDE, _ABSURD = 1e3, 1e5  # meters around a sensor, and in any case
_NEAREST = 300.0  # meters from a sensor that are farther than any measures without measuring something before
_COUNTED, _LOOKED_AT = 20.0, 1000  # meters from which on whole numbers alone are odd, and points that tell
_DEGREES, _UPRIGHT = 0.01, 100.0  # sides as shares of how far away they lie; height as a multiple of them
_COARSE = 0.01  # meters, or share of the extent, between neighboring float32 numbers, from which on a shape is lost
_FINE = 1e-4  # share of the extent between neighboring float32 numbers, up to which nothing is lost
COARSE = (
    "sequences whose files hold map coordinates in float32, which rounds them to 1 cm, or 1 % of their extent, or more;"
    " write them in double"
)
UNREAD_COLORS = "frames with colors, which are not read, as the first of all has none"
_LISTED = 8
_PAIRS, _MANY, _LOST = 8, 50, 0.15  # frames and points that tell, and the share of lost neighbors that is odd
SCATTERED = (
    "sequences whose tracked points lose their neighbors from one frame to the next; does --track give the same number to"
    " the same point in all frames? Else leave it out"
)
SHIFTED = "sequences shifted to their first frame's corner for precision"


@dataclass(frozen=True)
class Lengths:
    """Says how lengths become the output's. scale: input units per unit of length, None where the user said nothing and
    the file's own unit counts; unit: the name of the output's.
    """

    scale: float | None = None
    unit: str = "m"

    def __post_init__(self) -> None:
        if self.scale is not None and not self.scale > 0:
            raise UsageError("--scale and --fps must be more than 0")

    def divisor(self, clouds: Sequence[Cloud]) -> tuple[float, dict[str, int]]:
        """Returns what the coordinates are divided by, and a note where the files themselves decided that."""
        declared = {cloud.unit for cloud in clouds} - {""}
        if self.scale is not None or self.unit not in METERS or not declared - {self.unit}:
            return self.scale or 1.0, {}
        if len({cloud.unit for cloud in clouds}) > 1:
            names = ", ".join(sorted(cloud.unit or "none" for cloud in clouds))
            raise DataError(f"its frames declare different units ({names[:80]}); --scale says what they are in")
        (name,) = declared
        note = f"sequences converted from {name} to {self.unit}, as their files declare"
        return METERS[self.unit] / METERS[name], {note: 1}


@dataclass(frozen=True)
class OwnScans(Reader):
    """Holds what the readers of people's own scans share: their options and one check of these, the classes of their table of
    labels, the unit, and what the provenance tells.

    scale: input units per unit of length in the output; stride: every how many frames one is kept; keep: further columns;
    track: what tells which points of two frames are one (`tracked_points.identify`).
    """

    raw: Path
    scale: float | None = None
    unit: str = "m"
    fps: float | None = None
    stride: int = 1
    label_from_folder: bool = False
    labels: Path | None = None
    keep: tuple[str, ...] = ()
    track: str = ""

    def __post_init__(self) -> None:
        """Raises UsageError for options that exclude each other, or a scale or a rate that is no positive number."""
        if self.labels and self.label_from_folder:
            raise UsageError("--labels and --label-from-folder were both given; use one")
        if self.fps is not None and not self.fps > 0:
            raise UsageError("--scale and --fps must be more than 0")
        Lengths(self.scale, self.unit)

    def _in_folders(self) -> tuple[list[str], str]:
        """Returns what `labels_of_folders` takes: the names of the samples, and what each holds at least. Raises UsageError for
        data that lie in no folders.
        """
        raise UsageError(f"{self.raw}: lies in no folder of its class; leave out --label-from-folder")

    @cached_property
    def _table(self) -> LabelTable:
        if self.label_from_folder:
            return labels_of_folders(self.raw, *self._in_folders())
        return read_labels(self.labels) if self.labels else LabelTable()

    def fields_beside(self, *, time: object, color: object) -> tuple[str, ...]:
        """Returns the optional fields that every sample has, given whether all have times, and colors."""
        told = {"time": time, "color": color, "track": self.track}
        return (*(name for name, known in told.items() if known), *kept_names(self.keep))

    @property
    def class_names(self) -> list[str]:
        return self._table.class_names

    @property
    def length_unit(self) -> str:
        return self.unit

    @property
    def config(self) -> dict[str, Any]:
        left_out = ("raw", "labels", *(() if self.track else ("track",)))
        return {k: v for k, v in asdict(self).items() if k not in left_out}

    def _assembled(self, item: Item, clouds: list[Cloud], time: np.ndarray | None, notes: Mapping[str, int]) -> Sample:
        """Returns the sample of frames that were read, in their order, with what was noted while they were."""
        sample = assemble(item, clouds, Lengths(self.scale, self.unit), color=item.extra["color"], time=time)
        sample.note(notes)
        return sample


def assemble(
    item: Item, clouds: list[Cloud], lengths: Lengths, *, color: bool = False, time: np.ndarray | None = None
) -> Sample:
    """Returns the sample of frames that were read, in their order. Raises DataError where no point is left.

    color: every frame has one. time: seconds of each frame, f64 (T), or None. What is dropped is counted by reason; so
    are colors and columns that the first cloud of all, whose unread ones are the item's ``unread``, doesn't have.
    """
    notes = dict(sum((Counter(cloud.dropped) for cloud in clouds), Counter(clean(clouds))))
    counts = np.array([len(cloud.points) for cloud in clouds], np.int64)
    kept, dropped = drop_empty_frames(str(item.path), counts)
    filled = [clouds[t] for t in kept]
    divisor, converted = lengths.divisor(filled)
    # the fullest has no padding
    crowded = any(is_crowded(cloud.points) for cloud in filled[:: -(-len(filled) // _JUDGED)])
    notes |= {**dropped, **converted, CROWDED: int(crowded)}
    notes[UNREAD_COLORS] = 0 if color else sum(cloud.color is not None for cloud in filled)
    frames = [cloud.points for cloud in filled]
    each = np.array([ends_of(frame) for frame in frames])
    ends = each[:, 0].min(0) / divisor, each[:, 1].max(0) / divisor
    points, shift = _joined(frames, divisor, ends)
    notes[SHIFTED] = int(shift is not None)
    notes |= _rounded(frames, each, divisor, _COARSE if lengths.unit == "m" else np.inf)
    if lengths.unit == "m":
        notes |= _doubts(*ends, frames[0][:_LOOKED_AT] if lengths.scale is None and divisor == 1 else None)
    notes |= _further(filled, item.extra["unread"]) if "unread" in item.extra else {}
    extra = {
        kept_name(name): np.concatenate([as_float32(item.path, name, cloud.extra[name]) for cloud in filled])
        for name in clouds[0].extra
    }
    sequence = CloudSequence(
        item.name,
        points,
        offsets(counts[kept]),
        time=None if time is None else time[kept],
        color=_colors(item, filled) if color else None,
        track=_tracks(item, filled),
        shift=shift,
        extra=extra,
        **describe(item),
    )
    notes[SCATTERED] = int(_scatters(filled))
    return Sample(sequence, notes)


def _tracks(item: Item, clouds: list[Cloud]) -> np.ndarray | None:
    """Returns the identities of all points i64 (P); None where they have none. Raises DataError where two of a frame share one."""
    tracks = [cloud.track for cloud in clouds if cloud.track is not None]
    for t, track in enumerate(tracks):
        values, counts = np.unique(track, return_counts=True)
        if counts.max() > 1:
            raise DataError(
                f"{item.path}: --track: {counts.max()} points of frame {t} share the identity {values[counts.argmax()]};"
                " expected one of its own for each, the same in every frame"
            )
    return np.concatenate(tracks) if tracks else None


def _scatters(clouds: list[Cloud]) -> bool:
    """Returns whether many tracked points are far from their nearest neighbors a frame later, as those of mixed-up rows are.

    What bodies that bend, turn, grow and shrink do leaves nearly all neighbors near.
    """
    if any(cloud.track is None for cloud in clouds) or len(clouds) < 2:
        return False
    first = np.unique(np.linspace(0, len(clouds) - 2, _PAIRS).astype(int))
    return any(_lost_neighbors(clouds[t], clouds[t + 1]) > _LOST for t in first)


def _lost_neighbors(one: Cloud, other: Cloud) -> float:
    """Returns the share of points whose nearest neighbor in one frame is half the cloud's size away in the other."""
    from scipy.spatial import cKDTree

    _, here, there = np.intersect1d(one.track, other.track, assume_unique=True, return_indices=True)
    step = max(1, len(here) // _LOOKED_AT)
    before, kept = np.unique(one.points[here[::step]].astype(np.float64), axis=0, return_index=True)
    after = other.points[there[::step][kept]].astype(np.float64)
    if len(before) < _MANY:
        return 0.0
    sizes = [np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean()) for points in (before, after)]
    if not min(sizes) > 0:
        return 0.0
    distance, neighbor = (found[:, 1] for found in cKDTree(before).query(before, k=2))
    apart = np.linalg.norm(after - after[neighbor], axis=1)
    return float((apart / sizes[1] > 0.5 + 2 * distance / sizes[0]).mean())


def _further(clouds: list[Cloud], known: tuple[str, ...]) -> dict[str, int]:
    """Returns a note of how many frames have columns that are not read, and that the first of all, which was told, has not."""
    further = [names for cloud in clouds if (names := without(cloud.unread, known, tuple(cloud.extra)))]
    if not further:
        return {}
    names = first_names(list(dict.fromkeys(name for one in further for name in one)), _LISTED)
    return {f"frames with further columns ({names}), which are not read": len(further)}


def _joined(
    frames: list[np.ndarray], divisor: float, ends: tuple[np.ndarray, ...]
) -> tuple[np.ndarray, np.ndarray | None]:
    """Returns the points of all frames f32 (P,3), divided, less the corner of the first frame, and that corner f64 (3), or
    None where float32 holds the points as they are.

    ends: the least and the greatest coordinates after the division. A small object may lie too far away for float32 nearer
    than a map does; of files in float32 nothing could be saved.
    """
    farthest, widest = max(np.abs(end).max() for end in ends), (ends[1] - ends[0]).max()
    single = all(frame.dtype == np.float32 for frame in frames)
    far = farthest > _FAR_AWAY or (not single and 0 < widest < np.spacing(np.float32(farthest)) / _FINE)
    if divisor == 1 and not far:
        points = np.empty((sum(map(len, frames)), 3), np.float32)  # by rows, where frames lie by columns
        return np.concatenate(frames, out=points, casting="same_kind"), None
    points = np.concatenate(frames, dtype=np.float64) / divisor
    corner = np.floor(points[: len(frames[0])].min(0)) if far else np.zeros(3)
    return (points - corner).astype(np.float32), corner if far else None


def _rounded(frames: Sequence[np.ndarray], ends: np.ndarray, divisor: float, coarse: float) -> dict[str, int]:
    """Returns a note where coordinates lie so far away that the float32 they were stored in rounded them.

    ends: f64 (T,2,3). coarse: the step between neighboring numbers that is too much, after the division, however wide it is.
    """
    single = [k for k, frame in enumerate(frames) if frame.dtype == np.float32]
    step = float(np.spacing(np.float32(np.abs(ends[single]).max(initial=0))))
    widest = float((ends[:, 1].max(0) - ends[:, 0].min(0)).max())
    return {COARSE: 1} if step / divisor > coarse or 0 < _COARSE * widest < step else {}


def _doubts(low: np.ndarray, high: np.ndarray, some: np.ndarray | None) -> dict[str, int]:
    """Returns notes about lengths that no sensor sees. low, high: the ends of the original coordinates, f64 (3); some:
    points as they were read, or None.
    """
    sides = high - low
    if 0 < sides[:2].max() < _DEGREES * np.abs([low, high]).max(0)[:2].min() and sides[2] > _UPRIGHT * sides[:2].max():
        return {"sequences far higher than wide, in x and y far from 0; are these degrees? Project them to meters": 1}
    widest, farthest = float((high - low).max()), float(np.abs([low, high]).max())
    if widest > _ABSURD:
        return {"sequences more than 100 km wide; are they in meters? --scale N divides them": 1}
    if some is not None and widest > _COUNTED and farthest <= _FAR_AWAY and (some == np.floor(some)).all():
        return {"sequences in whole numbers, hardly meters; if they are millimeters, give --scale 1000": 1}
    nearest = float((some.astype(np.float64) ** 2).sum(1).min()) ** 0.5 if some is not None else 0.0
    if nearest > _NEAREST and widest <= _FAR_AWAY and farthest <= _FAR_AWAY:
        return {"sequences without a point within 300 m of the origin; if these are millimeters, give --scale 1000": 1}
    if widest > _WIDE and farthest <= _FAR_AWAY:
        return {"sequences that reach 1 km around their sensor; if these are millimeters, give --scale 1000": 1}
    return {}


def _colors(item: Item, clouds: list[Cloud]) -> np.ndarray:
    colors = [cloud.color for cloud in clouds if cloud.color is not None]
    if len(colors) < len(clouds):
        raise DataError(
            f"{item.path}: {len(clouds) - len(colors)} of {counted(len(clouds), 'frame')} without colors, others with them"
        )
    try:
        return np.concatenate(as_bytes(colors))
    except DataError as error:
        raise DataError(f"{item.path}: {error}") from None
