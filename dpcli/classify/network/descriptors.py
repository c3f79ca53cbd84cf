"""Points in all and in slots of time: the hand-made numbers that forests classify by."""

from __future__ import annotations

import numpy as np

SLOTS = 6  # parts of a video, equally long
LEVELS = (0.1, 0.25, 0.5, 0.75, 0.9)  # of the quantiles that are taken


def clip_descriptors(clips: np.ndarray) -> np.ndarray:
    """Returns the descriptors f32 (B,D) of clips of sparse clouds, f32 (B,T,P,5+F) as `data/slots.py` makes them: as of videos,
    without what they say of place and length."""
    found = []
    for clip in clips:
        slot, place = np.nonzero(clip[..., 3] > 0)
        rows = clip[slot, place] if len(slot) else np.zeros((1, clip.shape[-1]), np.float32)
        within = (slot + 0.5 if len(slot) else np.zeros(1)) + rows[:, 4]
        times = np.clip(within / len(clip) * SLOTS, 0, SLOTS - 1).astype(int)
        found.append(described(rows[:, [0, 1, 2, *range(5, rows.shape[1])]].astype(np.float64), times))
    return np.stack(found).astype(np.float32)


def described(values: np.ndarray, slot: np.ndarray) -> np.ndarray:
    """Returns what the points' values f64 (N,C) are like in all and in each slot, i (N): shares, quantiles, shifts."""
    whole = np.quantile(values, LEVELS, axis=0)
    slots = _slots(values, slot, whole)
    middles = slots[:, len(LEVELS) // 2]
    counts = np.bincount(slot, minlength=SLOTS) / max(len(slot), 1)
    return np.concatenate([counts, whole.ravel(), slots.ravel(), np.diff(middles, axis=0).ravel()])


def _slots(values: np.ndarray, slot: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Returns the quantiles of each slot, f64 (slots,levels,columns); `whole`, of all points, before the first with any."""
    found = [whole]
    for number in range(SLOTS):
        own = values[slot == number]
        found.append(np.quantile(own, LEVELS, axis=0) if len(own) else found[-1])
    return np.stack(found[1:])
