"""Point cloud sequences as a page: quantized positions, parts and colors, thinned so that a browser on a phone can show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dpcli.draw.page.assemble import data_blocks, data_page
from dpcli.draw.palette import UNKNOWN, part_colors

SCRIPTS = ("clip", "points_gl", "points_canvas", "floor", "points")  # of every page with clouds; what starts it follows
MOST_POINTS = 1_000_000  # of all frames on a page: about 8 MB of positions in base64
MOST_FRAMES = 2400  # of all sequences on a page
_FEWEST_POINTS, _MOST_IN_FRAME = 256, 65_536
_FEWEST_FRAMES, _MOST_IN_SEQUENCE = 24, 240
_STEPS, _MOST_PARTS = 65_535, 254  # steps of a coordinate; ids of a sequence
_STOPS, _USUAL_RATE, _RATES = 12, 10.0, (1.0, 60.0)  # colors of the ramp; frames per second


@dataclass
class PageSequence:
    """Holds one sequence as a page shows it, its frames already thinned.

    title: in the list of sequences. frames: number of each shown frame within the sequence, of frame_count in all. time: f64
    of the shown frames in seconds, or None. points: a frame's points each, f32 (N,3), x right, y up, z towards the viewer.
    part: i (N) each, or None. color: u8 (N,3) each, or None. label: -1 = unknown; class_name: its name.
    """

    title: str
    frames: list[int]
    frame_count: int
    points: list[np.ndarray]
    time: np.ndarray | None = None
    part: list[np.ndarray] | None = None
    color: list[np.ndarray] | None = None
    label: int = -1
    class_name: str = ""


@dataclass
class PageFacts:
    """Holds what a page says of its file: title, a line below it, notes on what is left out, rows of facts, commands that made it."""

    title: str
    subtitle: str
    notes: list[str] = field(default_factory=list)
    rows: list[tuple[str, str]] = field(default_factory=list)
    history: list[dict[str, Any]] = field(default_factory=list)

    def header(self) -> dict[str, Any]:
        """Returns the values that the script of every page reads."""
        history = [{"command": str(entry.get("command", ""))} for entry in self.history]
        return {
            "title": self.title,
            "subtitle": self.subtitle,
            "notes": self.notes,
            "facts": self.rows,
            "history": history,
        }


def frame_budget(sequences: int) -> int:
    """Returns how many frames of each of so many sequences a page shows."""
    return int(np.clip(MOST_FRAMES // max(sequences, 1), _FEWEST_FRAMES, _MOST_IN_SEQUENCE))


def point_budget(frames: int) -> int:
    """Returns how many points of each of so many frames a page shows."""
    return int(np.clip(MOST_POINTS // max(frames, 1), _FEWEST_POINTS, _MOST_IN_FRAME))


def points_page(facts: PageFacts, sequences: Sequence[PageSequence], *, axes: np.ndarray, unit: str) -> str:
    """Returns the page. axes: f (3,3), row k is where the file's axis k points on the page. unit: of length, "" = unknown.

    Positions are rounded to 1/65535 of the box around their sequence. Equal input gives an equal page.
    """
    header, blocks = points_parts(facts, sequences, axes=axes, unit=unit)
    return data_page(header, "points", script=(*SCRIPTS, "points_start"), data=data_blocks(blocks))


def points_parts(
    facts: PageFacts, sequences: Sequence[PageSequence], *, axes: np.ndarray, unit: str
) -> tuple[dict[str, Any], list[bytes]]:
    """Returns the header of a page with point clouds, and the block of each sequence; arguments as of `points_page`."""
    header = facts.header() | {
        "axes": axes.tolist(),
        "unit": unit,
        "looks": _looks(sequences),
        "ramp": _ramp(),
        "sequences": [_described(sequence) for sequence in sequences],
    }
    blocks = [_packed(sequence) for sequence in sequences]
    for about, block in zip(header["sequences"], blocks):
        about["bytes"] = len(block)
    return header, blocks


def _looks(sequences: Sequence[PageSequence]) -> list[str]:
    """Returns the ways to color the points that the data allow, the most telling one first."""
    first = sequences[0]
    parted, colored = first.part is not None, first.color is not None
    label = any(sequence.label >= 0 for sequence in sequences)
    moves = any(len(sequence.frames) > 1 for sequence in sequences)
    found = {"part": parted, "color": colored, "height": True, "time": moves, "label": label}
    return [look for look, there in found.items() if there]


def _ramp() -> list[list[int]]:
    """Returns colors from low to high, without the ends that vanish on a dark or a light ground."""
    from matplotlib import colormaps

    return np.rint(colormaps["turbo"](np.linspace(0.1, 0.92, _STOPS))[:, :3] * 255).astype(int).tolist()


def _described(sequence: PageSequence) -> dict[str, Any]:
    points = np.concatenate(sequence.points).astype(np.float64) if sequence.points else np.zeros((0, 3))
    low, step = _steps(points)
    time = sequence.time
    return {
        "title": sequence.title,
        "frames": sequence.frames,
        "frame_count": sequence.frame_count,
        "counts": [len(frame) for frame in sequence.points],
        "time": None if time is None else time.tolist(),
        "rate": frame_rate(time),
        "low": low.tolist(),
        "step": step.tolist(),
        "parts": _part_list(sequence),
        "colored": sequence.color is not None,
        "class": sequence.class_name or (f"label {sequence.label}" if sequence.label >= 0 else ""),
        "label_color": part_colors(np.array([sequence.label]))[0].tolist(),
    }


def _steps(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lowest corner and the step (3) of positions rounded to 16 bits; a step is never 0."""
    if not len(points):
        return np.zeros(3), np.ones(3)
    low = points.min(0)
    return low, np.maximum((points.max(0) - low) / _STEPS, 1e-12)


def frame_rate(time: np.ndarray | None) -> float:
    """Returns the frames per second that the times give, limited to what a screen shows and a person waits for."""
    if time is None or len(time) < 2 or not np.isfinite(time).all():
        return _USUAL_RATE
    interval = float(np.median(np.diff(time)))
    return float(np.clip(1 / interval, *_RATES)) if interval > 0 else _USUAL_RATE


def _ids(sequence: PageSequence) -> tuple[np.ndarray, np.ndarray]:
    """Returns the part ids of a sequence, ascending, and their counts; of more than 254, those with the most points."""
    ids, counts = np.unique(np.concatenate(sequence.part), return_counts=True)
    if len(ids) > _MOST_PARTS:
        kept = np.sort(np.argsort(-counts, kind="stable")[:_MOST_PARTS])
        ids, counts = ids[kept], counts[kept]
    return ids, counts


def _part_list(sequence: PageSequence) -> list[dict[str, Any]]:
    if sequence.part is None:
        return []
    ids, counts = _ids(sequence)
    total = max(sum(len(frame) for frame in sequence.part), 1)
    told = [
        {"id": int(one), "share": _percent(count / total), "color": part_colors(np.array([one]))[0].tolist()}
        for one, count in zip(ids, counts)
    ]
    if counts.sum() < total and -1 not in ids:  # some ids were cut: their points count as none
        told.append({"id": -1, "share": _percent(1 - counts.sum() / total), "color": list(UNKNOWN)})
    return told


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if share < 0.1 else f"{100 * share:.0f} %"


def _packed(sequence: PageSequence) -> bytes:
    """Returns u8 planes: low and high bytes of x, of y, of z (6 N), the place of the part in the list (N), r, g, b (3 N)."""
    points = np.concatenate(sequence.points).astype(np.float64) if sequence.points else np.zeros((0, 3))
    low, step = _steps(points)
    steps = np.rint((points - low) / step).clip(0, _STEPS).astype(np.uint16).T
    planes = [plane for axis in steps for plane in ((axis & 255).astype(np.uint8), (axis >> 8).astype(np.uint8))]
    if sequence.part is not None:
        planes.append(_places(sequence))
    if sequence.color is not None:
        planes.append(np.concatenate(sequence.color).astype(np.uint8))
    return b"".join(plane.tobytes() for plane in planes)


def _places(sequence: PageSequence) -> np.ndarray:
    """Returns where each point's part stands in the list; ids that are not listed count as none."""
    listed = [one["id"] for one in _part_list(sequence)]
    given = np.concatenate(sequence.part)
    order = np.argsort(listed, kind="stable")
    ranks = np.searchsorted(np.array(listed)[order], given).clip(0, len(listed) - 1)
    places = order[ranks]
    none = listed.index(-1) if -1 in listed else 0
    return np.where(np.array(listed)[places] == given, places, none).astype(np.uint8)
