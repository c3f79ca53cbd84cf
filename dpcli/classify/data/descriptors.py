"""Hand-made descriptors of a video: what a forest of decision trees classifies by, and every network should beat.

All of them are quantiles and slopes, so that a few points far off, or frames without any, change little.
"""

from __future__ import annotations

import numpy as np

from dpcli.store import CloudSequence, CloudsReader
from dpcli.store.schema import KEPT

_SLOTS = 6  # parts of a video, equally long
_LEVELS = (0.1, 0.25, 0.5, 0.75, 0.9)
_LARGEST = 1e30  # a forest takes float32


def descriptor(sequence: CloudSequence, fields: tuple[str, ...]) -> np.ndarray:
    """Returns the descriptor f64 (D) of a video; D depends on the number of fields alone.

    fields: kept columns, such as `field_doppler`. It holds the place and extent of the whole cloud, and for each of six
    slots of time the number of points, quantiles of position (about the video's median) and fields, and their shift
    since the slot before. A slot without points repeats the one before; a video without any is a point at the origin.
    """
    if not len(sequence.points):
        sequence = CloudSequence.from_frames(sequence.name, [np.zeros((1, 3), np.float32)])
    times = np.repeat(np.arange(sequence.num_frames), np.diff(sequence.frame_offsets))
    middle = np.median(sequence.points, 0)
    columns = [sequence.extra[name] for name in fields if name in sequence.extra]
    missing = [np.zeros(len(times))] * (len(fields) - len(columns))
    values = np.column_stack([sequence.points - middle, *columns, *missing]).astype(np.float64)
    size = [sequence.num_frames, len(times) / max(sequence.num_frames, 1), *middle]
    found = np.concatenate([size, _described(values, times * _SLOTS // max(sequence.num_frames, 1))])
    return np.nan_to_num(found).clip(-_LARGEST, _LARGEST)


def clip_descriptors(clips: np.ndarray) -> np.ndarray:
    """Returns the descriptors f32 (B,D) of clips of sparse clouds, f32 (B,T,P,5+F) as `data/slots.py` makes them: as of videos,
    without what they say of place and length."""
    found = []
    for clip in clips:
        slot, place = np.nonzero(clip[..., 3] > 0)
        rows = clip[slot, place] if len(slot) else np.zeros((1, clip.shape[-1]), np.float32)
        within = (slot + 0.5 if len(slot) else np.zeros(1)) + rows[:, 4]
        times = np.clip(within / len(clip) * _SLOTS, 0, _SLOTS - 1).astype(int)
        found.append(_described(rows[:, [0, 1, 2, *range(5, rows.shape[1])]].astype(np.float64), times))
    return np.stack(found).astype(np.float32)


def _described(values: np.ndarray, slot: np.ndarray) -> np.ndarray:
    """Returns what the points' values f64 (N,C) are like in all and in each slot, i (N): shares, quantiles, shifts."""
    whole = np.quantile(values, _LEVELS, axis=0)
    slots = _slots(values, slot, whole)
    middles = slots[:, len(_LEVELS) // 2]
    counts = np.bincount(slot, minlength=_SLOTS) / max(len(slot), 1)
    return np.concatenate([counts, whole.ravel(), slots.ravel(), np.diff(middles, axis=0).ravel()])


def _slots(values: np.ndarray, slot: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Returns the quantiles of each slot, f64 (slots,levels,columns); `whole`, of all points, before the first with any."""
    found = [whole]
    for number in range(_SLOTS):
        own = values[slot == number]
        found.append(np.quantile(own, _LEVELS, axis=0) if len(own) else found[-1])
    return np.stack(found[1:])


def descriptors(reader: CloudsReader, sequences: list[int]) -> np.ndarray:
    """Returns the descriptors f64 (N,D) of some videos of a file, with all columns that it keeps."""
    fields = tuple(name for name in reader.fields if name.startswith(KEPT))
    return np.stack([descriptor(reader.read(i, fields=fields), fields) for i in sequences])
