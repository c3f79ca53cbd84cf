"""Lines that tell people what was found in scenes, to be checked against what they know of these."""

from __future__ import annotations

import numpy as np

from dpcli.counted import counted
from dpcli.runtime.progress import log
from dpcli.segment.pictures import Look
from dpcli.segment.scene.explain import SENSOR_NEAR
from dpcli.segment.scene.ground import find_up
from dpcli.store import CloudSequence
from dpcli.store.parts import PartsReader, PartsSample
from dpcli.store.schema import METERS

_NAMED = 8  # objects of a sequence that are named one by one
_SHOWN = 30.0  # meters around the middle that a picture shows


def scene_lines(reader: PartsReader) -> list[str]:
    """Returns a line for each sequence: how far the sensor moved, and how many objects moved, how fast."""
    lines = []
    for index, name in enumerate(reader.names):
        sequence, said = reader.read(index), reader.read_parts(index)
        objects = [int(part) for part in np.unique(sequence.part) if part > 0]
        speeds = [_speed(sequence, said, part, reader.length_unit) for part in objects]
        told = ", ".join(f"{part}: {text}" for part, text in list(zip(objects, speeds))[:_NAMED])
        more = f", and {len(objects) - _NAMED} more" if len(objects) > _NAMED else ""
        sensor = _speed(sequence, said, 0, reader.length_unit)
        few = counted(len(objects), "moving object")
        lines.append(f"{name}: the sensor moves {sensor}; {few}{f' ({told}{more})' if told else ''}")
    return lines


def _speed(sequence: CloudSequence, said: PartsSample, part: int, unit: str) -> str:
    """Returns how far a part (0: the sensor) moves over the ground in a frame, in the median, and per second.

    Frames that repeat the one before count as one with it, from the time of the first.
    """
    steps, times = [], []
    for (i, j), motion in zip(said.pairs.tolist(), said.motion.astype(np.float64)):
        own = sequence.frame(i)[sequence.part[sequence.frame_offsets[i] : sequence.frame_offsets[i + 1]] == part]
        if abs(i - j) == 1 and len(own) and not _same(sequence, i, j):
            place = np.median(own, axis=0) if part else _sensor_place(sequence, own, METERS.get(unit, 1.0))
            middle = np.append(place, 1.0).astype(np.float64)
            moved = np.linalg.solve(motion[0], motion[part] @ middle) if part else motion[0] @ middle
            steps.append(np.linalg.norm((moved - middle)[:3]))
            since = min(i, j)
            while since > 0 and _same(sequence, since - 1, since):
                since -= 1
            times.append(np.nan if sequence.time is None else abs(sequence.time[max(i, j)] - sequence.time[since]))
    if not steps:
        return "unknown"
    step = f"{np.median(steps):.2f} {unit} a frame"
    rate = np.median(np.array(steps) / np.where(np.array(times) > 0, times, np.nan))
    return f"{step} ({rate:.1f} {unit}/s)" if np.isfinite(rate) else step


def _sensor_place(sequence: CloudSequence, points: np.ndarray, meters: float) -> np.ndarray:
    """Returns where the sensor was that saw points (N,3): at the origin, before or after `shift`, if that is near them.

    Else their middle, as of frames in one map's coordinates. meters: in a unit of length.
    """
    places = [np.zeros(3)] if sequence.shift is None else [np.zeros(3), -sequence.shift]
    near = (place for place in places if meters * np.linalg.norm(points - place, axis=1).min() < SENSOR_NEAR)
    return next(near, np.median(points, axis=0))


def _same(sequence: CloudSequence, first: int, second: int) -> bool:
    """Returns whether two frames have the same points in the same order."""
    return np.array_equal(sequence.frame(first), sequence.frame(second))


def _names(objects: list[int]) -> str:
    more = f" and {len(objects) - _NAMED} more" if len(objects) > _NAMED else ""
    return f"object{'s' if len(objects) > 1 else ''} {', '.join(map(str, objects[:_NAMED]))}{more}"


def picture_of_scene(sequence: CloudSequence, length_unit: str) -> tuple[CloudSequence, Look]:
    """Returns what a picture shows of a scene, what stands without a color, and from where: obliquely from above.

    A message names the objects that are so far away that the picture doesn't show them.
    """
    sequence.points = sequence.points * np.float32(METERS.get(length_unit, 1.0))
    middle = np.median(sequence.points, axis=0)
    reach = np.linalg.norm(sequence.points - middle, axis=1)
    farthest = max(_SHOWN, float(np.percentile(reach, 20)))
    shown = np.flatnonzero(reach <= farthest)
    beyond = np.setdiff1d(sequence.part, sequence.part[shown]).tolist()
    if beyond:
        log.info(f"{sequence.name}: the picture shows {farthest:.0f} m around the middle, and so not {_names(beyond)}")
    offsets = np.searchsorted(shown, sequence.frame_offsets)
    first = next(frame for frame in map(sequence.frame, range(sequence.num_frames)) if len(frame))
    up = find_up(first.astype(np.float64), None)[0]
    axis = int(np.abs(up).argmax())
    sequence.take_points(shown, offsets)
    sequence.part = np.where(sequence.part == 0, -1, sequence.part).astype(np.int16)
    upwards = ("-" if up[axis] < 0 else "") + "xyz"[axis]
    return sequence, Look(cell=420, up=upwards, elevation=np.deg2rad(50.0), gray="0, stands")
