"""The line at the end of a conversion by which a person sees whether lengths, frames and times are right."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dpcli.counted import counted
from dpcli.prepare.median import median
from dpcli.store import CloudsReader

_SEQUENCES, _FRAMES = 16, 3  # looked at, spread evenly: the line takes milliseconds, however large the file
_POINTS = 1 << 18
_LONG_UNIT = 12  # letters of a unit that is told once only, behind the lengths
_SHIFTS_SHOWN = 20
_SAME = 1.05  # ratio of the rates of two sequences that have one
_EVEN = 1.5  # ratio of two intervals between frames of which the longer one isn't a gap


def closing_lines(reader: CloudsReader, notes: Mapping[str, int]) -> list[str]:
    """Returns the line about an open clouds file, and one for each sequence that was shifted; none of an empty file.

    notes: how many points and frames readers dropped, by reason. Distances are those from the origin, the extent is the
    box around a sequence; both are the median of up to 16 sequences, of 3 frames each, and the same in every run.
    """
    if not len(reader):
        return []
    said = [*_lengths(reader), _frames(reader), *_tracks(reader)]
    for what, count in sorted(notes.items()):
        if what.endswith("dropped") and count:
            plural, told = what.split(" ", 1)
            said.append(f"{counted(count, plural.removesuffix('s'))} {told}")
    return [", ".join(said), *_shifts(reader)]


def _lengths(reader: CloudsReader) -> list[str]:
    distances, extents = [], []
    places = _spread(len(reader), _SEQUENCES)
    left = _POINTS
    for place in places:
        frames = _spread(int(reader.frame_counts[place]), _FRAMES)
        points = np.concatenate([reader.read(place, [t], fields=()).points for t in frames])
        distances.append(float(median(np.sqrt(np.einsum("ij,ij->i", points, points)))))
        extents.append([np.ptp(points[:, axis]) for axis in range(3)])  # NumPy is slow along short rows
        left -= len(points)
        if left < 0:
            break
    long = len(reader.length_unit) > _LONG_UNIT
    unit = f" {reader.length_unit}" if reader.length_unit and not long else ""
    extent = " x ".join(_number(value) for value in median(np.array(extents)))
    shown = [f"extent {extent}{unit}"]
    if not reader.shifts[places].any():  # else the origin is no sensor
        shown.insert(0, f"median distance {_number(float(median(np.array(distances))))}{unit}")
    return [*shown[:-1], f"{shown[-1]} ({reader.length_unit})"] if long else shown


def _tracks(reader: CloudsReader) -> list[str]:
    """Returns how long points are followed, where they have identities: one frame if these aren't the same from frame to frame."""
    if "track" not in reader.fields:
        return []
    lengths, left = [], _POINTS
    for place in _spread(len(reader), _SEQUENCES):
        lengths.append(np.unique(reader.read(place, fields=("track",)).track, return_counts=True)[1])
        left -= int(lengths[-1].sum())
        if left < 0:
            break
    middle = float(median(np.concatenate(lengths)))
    return [f"tracks of {_number(middle)} frame{'' if middle == 1 else 's'} (median)"]


def _spread(count: int, wanted: int) -> list[int]:
    """Returns up to so many of the indices below `count`, spread evenly, first and last among them."""
    return sorted({int(place) for place in np.linspace(0, count - 1, min(wanted, count))})


def _frames(reader: CloudsReader) -> str:
    counts = reader.frame_counts
    low, high = int(counts.min()), int(counts.max())
    shown = f"{low}" if low == high else f"{low} to {high}"
    if len(reader) > 1:
        shown = f"{len(reader)} sequences of {shown}"
    shown += " frame" if high == 1 else " frames"
    if "time" not in reader.fields:
        return shown + (" without times" if high > 1 else "")
    steps = reader.frame_intervals()
    steps = steps[steps > 0]
    if not len(steps):
        return shown
    middle, least, most = float(median(steps)), float(steps.min()), float(steps.max())
    even = most < _EVEN * middle and middle < _EVEN * least
    apart = "" if even else f", {_number(least)} to {_number(most)} s apart"
    times, ends = reader.file["time"][:], np.cumsum(counts) - 1
    spans = times[ends[counts > 1]] - times[ends[counts > 1] - counts[counts > 1] + 1]
    rates = (counts[counts > 1] - 1)[spans > 0] / spans[spans > 0]
    rate = _number(1 / middle)
    if rates.max(initial=0) >= _SAME * rates.min(initial=np.inf):  # the middle may be the rate of none
        rate = f"{_number(rates.min())} to {_number(rates.max())}"
    return f"{shown} at {rate} fps{apart}"


def _shifts(reader: CloudsReader) -> list[str]:
    moved = np.flatnonzero(reader.shifts.any(axis=1)).tolist()
    lines = []
    for place in moved[:_SHIFTS_SHOWN]:
        shift = ", ".join(f"{value:.10g}" for value in reader.shifts[place])
        lines.append(f"{reader.names[place]}: ({shift}) was taken off its coordinates; the file keeps it as shift")
    if len(moved) > _SHIFTS_SHOWN:
        lines.append(f"... and off {len(moved) - _SHIFTS_SHOWN} more; dpc info --json lists all")
    return lines


def _number(value: float) -> str:
    """Returns three digits, or all before the point.

    >>> _number(1.41832), _number(16_012_345.6), _number(0.0)
    ('1.42', '16,012,346', '0')
    """
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
