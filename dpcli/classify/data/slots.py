"""Clips of sparse clouds: a whole video in equal slots of time, its points about their median, with columns of the file.

A radar sees a handful of points a frame, some of them far behind who moves. So several frames share a slot, place and
scale come from medians, and what lies too far off is left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dpcli.classify.data.augment import NONE, Augmentation
from dpcli.classify.data.columns import not_read, telling_columns
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.presets import PRESETS
from dpcli.runtime.progress import log
from dpcli.store import CloudSequence, CloudsReader
from dpcli.store.schema import kept_name

FARTHEST = 3.0  # units from the median: no gesture reaches farther
_EXTREME = 3.0  # spreads: a column's value beyond counts as being there
_FAST, _SLOWEST = 0.8, 0.1  # the quantile that is a video's level, which is about 1 spread; the least level
_LEAST = 4  # points that random changes leave of a video
_BOTH_SIGNS = 0.1  # of a column's values at least above and below 0: it is a speed, and 0 its middle
_NO_SPEED = 1e-30  # the middle of another column that is 0 most of the time


SPARSE = 64  # points of a frame in the median, at most: what common radars send
LONG = 4  # clips that the median video holds, at least, where a single one may show nothing of its class
_OWN_CHOICE = ("backbone", "timing", "variant", "init", "static_from", "pretrain")  # settings that name another network
_OWN_BATCHES = ("batch", "accumulate", "clips_per_video", "video_loss")  # those that `long` chooses together


def preset_for(reader: CloudsReader, given: Mapping[str, Any]) -> str:
    """Returns the preset that suits a file: `sparse` for sparse clouds, `long` for videos of `LONG` clips or more, else `quick`.

    given: the values of settings that were given, by name; where they name another network, `quick` it is, and not `long`
    where they say which clips make a step.
    """
    sizes, lengths = reader.frame_sizes, reader.frame_counts
    if not len(sizes) or any(given.get(name) for name in _OWN_CHOICE):
        return "quick"
    if float(np.median(sizes)) <= SPARSE:
        return "sparse"
    frames = int(given.get("frames") or PRESETS["quick"]["network"].num_frames)
    long = float(np.median(lengths)) >= LONG * frames and not any(name in given for name in _OWN_BATCHES)
    return "long" if long else "quick"


def measured(config: KinetConfig, reader: CloudsReader, sequences: list[int]) -> tuple[KinetConfig, dict[str, str]]:
    """Returns the configuration of a network for sparse clouds with the columns and scales of these videos, and why other
    columns are not read."""
    columns, left_out = telling_columns(reader, sequences)
    config = config.changed(columns=columns, scales=measured_scales(reader, sequences, columns))
    videos = (reader.read(i, fields=config.column_fields) for i in sequences)
    counts = [(len(one.points), len(slot_rows(one, config))) for one in videos]
    points, near = np.sum(counts, 0)
    log.info(
        f"sparse clouds: points farther than {FARTHEST * config.scales[0]:.3g} from their video's median are left out"
        f" ({points - near} of {points}); read beside places: {', '.join(columns) or 'nothing'}{not_read(left_out)}"
    )
    return config, left_out


def measured_scales(reader: CloudsReader, sequences: list[int], columns: tuple[str, ...]) -> tuple[float, ...]:
    """Returns the unit of length, then middle and spread of each column: medians over all points of some videos.

    The unit is twice the median distance of points from the median of their video. The middle of a column with both signs, a
    speed, is 0.
    """
    videos = [reader.read(i, fields=tuple(map(kept_name, columns))) for i in sequences]
    videos = [video for video in videos if len(video.points)]
    distances = [np.linalg.norm(video.points - np.median(video.points, 0), axis=1) for video in videos]
    found = [2 * float(np.median(np.concatenate(distances))) if videos else 0.0]
    for name in columns:
        values = np.concatenate([video.extra[kept_name(name)] for video in videos])
        values = values[np.isfinite(values)]
        low, middle, high = np.quantile(values, [0.1, 0.5, 0.9]) if len(values) else (0.0, 0.0, 0.0)
        signed = min((values < 0).mean(), (values > 0).mean()) >= _BOTH_SIGNS if len(values) else False
        found += [0.0 if signed else float(middle) or _NO_SPEED, float(high - low) / 2]
    units = [value if place % 2 or value > 1e-9 else 1.0 for place, value in enumerate(found)]
    return tuple(float(value) for value in units)


def slot_rows(sequence: CloudSequence, config: KinetConfig) -> np.ndarray:
    """Returns a sequence's points near their median, f32 (N,4+F): place in units, time from 0 to 1, columns in spreads."""
    count = max(sequence.num_frames, 1)
    times = (np.repeat(np.arange(count), np.diff(sequence.frame_offsets)) + 0.5) / count
    columns = []
    for name, center, spread in zip(config.columns, config.scales[1::2], config.scales[2::2]):
        columns.append((sequence.extra[kept_name(name)] - center) / spread)
    rows = np.column_stack([sequence.points, times, *columns]).astype(np.float32)
    rows = rows[np.isfinite(rows[:, :3]).all(1)]
    if not len(rows):
        return rows
    rows[:, :3] = (rows[:, :3] - np.median(rows[:, :3], 0)) / config.scales[0]
    rows[:, 4:] = _about_the_video(np.nan_to_num(rows[:, 4:]), config).clip(-_EXTREME, _EXTREME)
    return rows[np.linalg.norm(rows[:, :3], axis=1) < FARTHEST]


def _about_the_video(columns: np.ndarray, config: KinetConfig) -> np.ndarray:
    """Returns columns f32 (N,F) in which a video's own level counts half, or, but for speeds, not at all.

    Who is slow, or far away, does the same gestures with lower speeds and intensities.
    """
    signed = config.signed_columns
    level = np.quantile(np.abs(columns), _FAST, axis=0).clip(_SLOWEST)
    own = columns - np.median(columns, 0)
    own[:, signed] = (columns * 2 / (1 + level))[:, signed]
    return own


def changed_rows(rows: np.ndarray, change: Augmentation, speeds: list[int], rng: np.random.Generator) -> np.ndarray:
    """Returns the points of a training video as another person might have moved: other size, turn, place, pace and luck.

    rows f32 (N,4+F) as from `slot_rows`; speeds: which columns grow with the pace.
    """
    if change == NONE or len(rows) < _LEAST:
        return rows
    rows = rows.copy()
    early, late = rng.uniform(-change.crop, change.crop, 2)  # below 0: a rest before, or after, that isn't there
    rows[:, 3] = (rows[:, 3] - early) / (1 - early - late)
    inside = (rows[:, 3] >= 0) & (rows[:, 3] < 1) & (rng.random(len(rows)) >= rng.uniform(0, change.dropout))
    if inside.sum() >= _LEAST:
        rows = rows[inside]
    rows[:, 3] = rows[:, 3].clip(0, 1 - 1e-6)
    rows[:, :3] = change.moved(rows[None, :, :3], rng)[0]
    pace = np.log1p(change.speed)
    rows[:, [4 + k for k in speeds]] *= np.float32(np.exp(rng.uniform(-pace, pace)))
    return rows


def in_slots(rows: np.ndarray, config: KinetConfig, rng: np.random.Generator) -> np.ndarray:
    """Returns a clip f32 (T,P,5+F): place, 1 where there is a point, time within the slot, columns; at most P points a slot,
    drawn at random."""
    slots, most = config.num_frames, config.points_per_frame
    found = np.zeros((slots, most, rows.shape[1] + 1), np.float32)
    rows = rng.permutation(rows)
    slot = np.minimum((rows[:, 3] * slots).astype(int), slots - 1)
    order = np.argsort(slot, kind="stable")
    rows, slot = rows[order], slot[order]
    place = np.arange(len(slot)) - np.searchsorted(slot, slot)  # within its slot
    rows, slot, place = (values[place < most] for values in (rows, slot, place))
    within = rows[:, 3] * slots - slot - 0.5
    found[slot, place] = np.column_stack([rows[:, :3], np.ones(len(rows)), within, rows[:, 4:]])
    return found
