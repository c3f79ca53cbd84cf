"""The segmenter of scenes: every point gets a label, 0 for all that stands, and every moving object a number."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.runtime.progress import log
from dpcli.segment.rigid_motions import move, move_each
from dpcli.segment.scene.explain import SceneExplanation, explain_scene
from dpcli.segment.scene.settings import SceneSettings
from dpcli.segment.segmenters import Segmenter
from dpcli.store import CloudSequence
from dpcli.store.parts import PartsSample
from dpcli.store.schema import METERS

_FARTHEST = 1e7  # meters, between points of a scene
_ROOM = 5.0  # meters from the middle, within which half of the points of a room lie: nobody drives there
_DRIVES = 20.0  # meters per second that something in a street may well have
_SLOW = 2.0  # seconds between frames beyond which nothing that drives is met twice
_USUAL = (0.3, 2000.0)  # meters from the middle, within which half of the points of a room or a street lie


@dataclass(frozen=True)
class SceneSegmenter(Segmenter):
    """Explains lidar scans and depth images of streets: the sensor's own motion, and objects that move on their own."""

    settings: SceneSettings

    @property
    def slots(self) -> int:
        """Returns how many objects a sequence may have at most, the background included."""
        return self.settings.max_objects + 1

    def explain(
        self, sequence: CloudSequence, pairs: list[tuple[int, int]], length_unit: str
    ) -> tuple[np.ndarray, PartsSample]:
        """Returns the labels i16 (P) of a sequence, and masks, motions and flow of the pairs of frames, in its own unit.

        Frames are looked at in the order of `time` where it is known, one that repeats the one before only once; units that
        are no lengths count as meters. Raises DataError for points farther apart than any two on Earth.
        """
        count, unit = sequence.num_frames, METERS.get(length_unit, 1.0)
        order = np.arange(count) if sequence.time is None else np.argsort(sequence.time, kind="stable")
        to_meters = np.diag([unit, unit, unit, 1.0])
        to_meters[:3, 3] = -unit * np.median(sequence.points, axis=0)
        clouds = [move(to_meters, np.float64(sequence.frame(t))) for t in range(count)]
        reach = unit * float(np.ptp(sequence.points, axis=0).max())
        if reach > _FARTHEST:
            raise DataError(
                f"points lie {reach:.3g} m apart, expected a street or a room; convert the data again with"
                f" the right --unit (the file's is {length_unit or 'unknown'})"
            )
        origins = np.zeros((2, 3)) if sequence.shift is None else np.stack([np.zeros(3), -sequence.shift])
        seen, place = _without_repeats(clouds, order)
        found = explain_scene([clouds[t] for t in seen], list(move(to_meters, origins)), self.settings)
        radius = _tell_size(sequence.name, clouds, length_unit)
        if sequence.time is not None and radius > _ROOM:
            self._tell_pace(sequence.name, np.diff(sequence.time[seen]))
        self._tell(sequence.name, [seen[t] for t in found.apart], found, count - len(seen))
        label = np.concatenate([found.labels[place[t]] for t in range(count)])
        motions, flows = np.tile(np.eye(4), (len(pairs), self.slots, 1, 1)), []
        for own, (i, j) in zip(motions, pairs):
            for part in range(len(found.objects) + 1):
                own[part] = found.motion(part, place[i], place[j])
            target = move_each(own[found.labels[place[i]]], clouds[i])
            flows.append(np.float32((target - clouds[i]) / unit))
        motions = np.linalg.inv(to_meters) @ motions @ to_meters
        sure = np.eye(self.slots, dtype=np.float32)
        for part, confidence in enumerate(found.confidence, 1):
            sure[part, [0, part]] = 1 - confidence, confidence
        sample = PartsSample(sure[label], np.array(pairs, np.int32).reshape(-1, 2), np.float32(motions), flows)
        return label.astype(np.int16), sample

    def _tell(self, name: str, apart: list[int], found: SceneExplanation, repeats: int) -> None:
        """Warns of what was assumed: of frames whose place is unknown, since they overlap with none before them, of objects
        left out, of an unknown sensor, ground or way, and of frames that repeat others.
        """
        if found.dropped:
            log.warn(
                f"{name}: {found.dropped} moving objects besides the largest {self.settings.max_objects} are assumed to stand"
                " still; --set max_objects= keeps more"
            )
        if apart:
            log.warn(
                f"{name}: frame {', '.join(map(str, apart))}: too little in common with the frame before to tell how the"
                " sensor moved; its motion is assumed to continue, and nothing is compared across the gap"
            )
        if not found.sensor_known:
            log.warn(
                f"{name}: the ranges don't fit a sensor at the origin, before or after shift, in all frames (are they in"
                " one map's coordinates?), so what it saw through is unknown, or wrong; expect false alarms and misses, or give"
                " each frame in the sensor's own coordinates"
            )
        if not found.ground_seen:
            log.warn(
                f"{name}: no ground plane was found, so which way is up is a guess; where the ground was removed,"
                " give --set ground=0.02, else turn the clouds so that an axis points up"
            )
        if not found.way_shown:
            log.warn(
                f"{name}: hardly anything stands across some way that the sensor may have gone (a corridor, a tunnel, open land),"
                " so how far it went is uncertain; compare its speed below with what you know: if that is wrong, so is what moves"
            )
        if repeats:
            log.warn(f"{name}: {counted(repeats, 'frame')} looked at once with the one before: the points are the same")

    def _tell_pace(self, name: str, steps: np.ndarray) -> None:
        """Warns where frames are so many seconds (T-1) apart that usual speeds take things farther than they are sought."""
        step = float(np.median(steps)) if len(steps) else 0.0
        if step * _DRIVES > self.settings.travel + 1e-6:
            advice = (
                f"--set travel={np.ceil(_DRIVES * step):g} looks farther" if step <= _SLOW else "is time in seconds?"
            )
            log.warn(
                f"{name}: frames are {step:.3g} s apart, and things are sought up to {self.settings.travel:g} m a frame: what"
                f" moves faster than {self.settings.travel / step:.3g} m/s is missed, or gets a lower speed; {advice}"
            )


def _without_repeats(clouds: list[np.ndarray], order: np.ndarray) -> tuple[list[int], np.ndarray]:
    """Returns the frames in their order without those that repeat the one before, and the place i64 (T) there of each."""
    seen: list[int] = []
    place = np.zeros(len(clouds), np.int64)
    for t in order.tolist():
        if not seen or len(clouds[t]) == 0 or not np.array_equal(clouds[t], clouds[seen[-1]]):
            seen.append(t)
        place[t] = len(seen) - 1
    return seen, place


def _tell_size(name: str, clouds: list[np.ndarray], length_unit: str) -> float:
    """Returns from how far around its middle half of a cloud's points lie, meters; clouds f64 (N_t,3).

    Warns where they are too small or large for a scene, as they are in a wrong unit.
    """
    radii = [float(np.median(np.linalg.norm(own - np.median(own, axis=0), axis=1))) for own in clouds if len(own)]
    radius = float(np.median(radii)) if radii else 0.0
    if 0 < radius and not _USUAL[0] <= radius <= _USUAL[1]:
        log.warn(
            f"{name}: half of a frame's points lie within {radius:.2g} m, expected a street or a room; if that is wrong,"
            f" convert the data again with the right --unit (the file's is {length_unit or 'unknown'})"
        )
    return radius
