"""Streets with traffic, scanned by a spinning lidar that drives along: true parts, poses and motion."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.prepare.reader import Item, Reader, Sample, describe, require_least
from dpcli.prepare.synthetic.spinning_lidar import LIDARS, scan
from dpcli.prepare.synthetic.street_world import Mover, draw_movers, planar_pose, standing_street
from dpcli.store import CloudSequence

_LANE = 1.75  # meters that the lidar's car drives beside the middle


@dataclass(frozen=True)
class SyntheticStreets(Reader):
    """Makes streets. ``rows``: beams of the lidar; ``movers``: the most moving bodies; ``speed``: fastest own, m/s.

    Part 0 is all that stands; a pose takes a part to the lidar's own coordinates of a frame (x ahead, z up).
    """

    streets: int = 10
    frames: int = 4
    rows: int = 64
    movers: int = 6
    fps: float = 10.0
    speed: float = 12.0
    noise: float = 0.02
    dropout: float = 0.05
    seed: int = 0
    length_unit: ClassVar[str] = "m"
    fields: ClassVar[tuple[str, ...]] = ("part", "pose", "time")

    def __post_init__(self) -> None:
        require_least(self, streets=1, frames=1, movers=0)
        if self.rows not in LIDARS:
            raise UsageError(f"--rows {self.rows}: expected {', '.join(map(str, LIDARS))}")
        if not (self.fps > 0 and 0 <= self.dropout < 1 and self.noise >= 0 and self.speed >= 0):
            raise UsageError("--fps must be above 0, --dropout in 0..1, --noise and --speed 0 or more")

    def items(self) -> list[Item]:
        return [Item(f"street_{number:04}", Path("street"), split="test") for number in range(self.streets)]

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        standing, lidar = standing_street(rng), LIDARS[self.rows]
        movers = draw_movers(int(rng.integers(min(1, self.movers), self.movers + 1)), rng)
        drive = (np.array([0, -_LANE]), rng.normal(0, 0.05), rng.uniform(0, self.speed), rng.normal(0, 0.05))
        times = np.arange(self.frames) / self.fps
        clouds, parts, poses = [], [], []
        for time in times:
            to_lidar = np.linalg.inv(planar_pose(*drive, time))
            to_lidar[2, 3] -= lidar.height
            world = [standing, *(mover.surface(time) for mover in movers)]
            owner = np.repeat(np.arange(len(world)), [len(surface) for surface in world])
            seen, triangle = scan(
                np.concatenate(world) @ to_lidar[:3, :3].T + to_lidar[:3, 3], lidar, self.noise, self.dropout, rng
            )
            if not len(seen):
                raise DataError(f"{item.name}: the lidar sees nothing")
            clouds.append(seen)
            parts.append(owner[triangle].astype(np.int16))
            poses.append(to_lidar @ self._poses(movers, time))
        sequence = CloudSequence.from_frames(
            item.name, clouds, part=parts, pose=np.stack(poses), time=times, **describe(item)
        )
        return Sample(sequence)

    def _poses(self, movers: list[Mover], time: float) -> np.ndarray:
        """Returns f64 (movers + 1,4,4): where the street and every body are; padded with identities."""
        poses = np.tile(np.eye(4), (self.movers + 1, 1, 1))
        for number, mover in enumerate(movers):
            poses[number + 1] = mover.pose(time)
        return poses

    def summary(self, items: list[Item]) -> list[str]:
        counts = Counter(item.split for item in items)
        return [
            f"{counted(counts['test'], 'street')}, {counted(self.frames, 'frame')} of a lidar with {self.rows} beams"
        ]
