"""The explanation of a scene: labels of all points, and the rigid motions of what stands and of what moves on its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.segment.rigid_motions import move
from dpcli.segment.scene.ego_motion import OVERLAP, register_frames, shows_the_way
from dpcli.segment.scene.ground import find_up, height_above_ground, level
from dpcli.segment.scene.line_of_sight import range_jumps
from dpcli.segment.scene.moving_objects import find_moving_objects
from dpcli.segment.scene.settings import SceneSettings
from dpcli.segment.scene.tracking import MovingObject, motion_from_to
from dpcli.segment.scene.world import Frame, World

_SURE = 50.0  # points explained better that make an object two thirds surer
_FEWEST = 50  # points of a frame that shows anything of a scene
SENSOR_NEAR = 40.0  # meters: a sensor has some point nearer than this
_JUMPS = 0.12  # share of neighboring beams that may end at different ranges, seen from where the sensor was


@dataclass
class SceneExplanation:
    """Holds what was found: labels i64 of each frame's points, 0 for all that stands, and the motions.

    pose: f64 (T,4,4), frame to world, in the input's own coordinates and unit; objects: motion f64 (4,4) in that world
    from its first frame to each that it was met in; confidence: of each, 0.5 to 1. apart: frames that overlap with none
    before them. dropped: objects beyond the most that are kept. ground_seen: whether a plane showed what is up; sensor_known:
    whether one of the places fits; way_shown: whether surfaces stand across every way that the sensor may have gone. All are
    true where no two frames were compared.
    """

    labels: list[np.ndarray]
    pose: np.ndarray
    objects: list[dict[int, np.ndarray]]
    confidence: list[float]
    apart: list[int]
    dropped: int
    ground_seen: bool = True
    sensor_known: bool = True
    way_shown: bool = True

    def motion(self, part: int, source: int, target: int) -> np.ndarray:
        """Returns the rigid motion f64 (4,4) of a part, 0 for what stands, from one frame's coordinates to another's.

        An object that was not met in one of the two frames keeps its motion between the nearest frames it was met in.
        """
        own = motion_from_to(self.objects[part - 1], source, target) if part > 0 else np.eye(4)
        return np.linalg.inv(self.pose[target]) @ own @ self.pose[source]


def explain_scene(frames: list[np.ndarray], sensor: list[np.ndarray], settings: SceneSettings) -> SceneExplanation:
    """Returns what stands and what moves in frames f64 (N_t,3), meters, in the order of time.

    sensor: places f64 (3) in the frames' coordinates where the sensor may have been; the first one that fits the largest
    frame is taken.
    """
    filled = [t for t, frame in enumerate(frames) if len(frame) >= _FEWEST]
    labels = [np.zeros(len(frame), np.int64) for frame in frames]
    if len(filled) < 2:
        return SceneExplanation(labels, np.tile(np.eye(4), (len(frames), 1, 1)), [], [], [], 0)
    shown = [frames[t] for t in filled]
    largest = max(shown, key=len)
    eye = next((place for place in sensor if _may_be_sensor(largest, place)), None)
    world, own, turn, apart, ground_seen = _build_world(shown, eye, settings)
    every = find_moving_objects(world, settings)
    found = every[: settings.max_objects]
    for number, one in enumerate(found, 1):
        for t, points in one.points.items():
            labels[filled[t]][points] = number
    before = np.maximum(np.searchsorted(filled, np.arange(len(frames)), side="right") - 1, 0)
    widest = max(world.frames, key=lambda frame: len(frame.points))
    return SceneExplanation(
        labels,
        pose=(turn.T @ own @ turn)[before],  # frames that show nothing are where the one before was
        objects=[_in_input_axes(one, filled, turn) for one in found],
        confidence=[1 - 0.5 * float(np.exp(-one.saved / _SURE)) for one in found],
        apart=[filled[t] for t in apart],
        dropped=len(every) - len(found),
        ground_seen=ground_seen,
        sensor_known=eye is not None and all(_may_be_sensor(shown[t], eye) for t in (0, -1)),
        way_shown=shows_the_way(widest.points, widest.height < settings.ground),
    )


def _in_input_axes(one: MovingObject, filled: list[int], turn: np.ndarray) -> dict[int, np.ndarray]:
    """Returns the object's motions in axes that were turned (4,4) upright before, by the numbers of all frames."""
    return {filled[t]: turn.T @ motion @ turn for t, motion in one.motion.items()}


def _build_world(
    frames: list[np.ndarray], eye: np.ndarray | None, settings: SceneSettings
) -> tuple[World, np.ndarray, np.ndarray, list[int], bool]:
    """Returns the registered frames, seen from the place `eye` (3) if it is known, their poses f64 (T,4,4) in upright axes,
    the turn (4,4) to these, frames apart, and whether a ground was seen.
    """
    turn = np.eye(4)
    up, ground_seen = find_up(max(frames, key=len), eye)
    turn[:3, :3] = level(up)
    upright = [frame @ turn[:3, :3].T for frame in frames]
    heights = [height_above_ground(frame) for frame in upright]
    poses, overlap = register_frames(upright, [height < settings.ground for height in heights])
    run = np.concatenate([[0], np.cumsum(overlap < OVERLAP)])
    world = [
        Frame(
            move(pose, frame),
            height,
            None if eye is None else pose[:3, :3] @ (turn[:3, :3] @ eye) + pose[:3, 3],
            settings.ground,
        )
        for frame, height, pose in zip(upright, heights, poses)
    ]
    apart = [int(t) + 1 for t in np.flatnonzero(overlap < OVERLAP)]
    return World(world, run, settings.window), poses, turn, apart, bool(ground_seen)


def _may_be_sensor(points: np.ndarray, place: np.ndarray) -> bool:
    """Returns whether a frame looks as if taken from a place (3): neighboring beams mostly end at about the same range."""
    return bool(np.linalg.norm(points - place, axis=1).min() < SENSOR_NEAR and range_jumps(points, place) < _JUMPS)
