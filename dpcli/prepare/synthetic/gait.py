"""The gaits of made-up animals: every bone turns over time by a sum of few sines, so that a clip loops."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.ops.rotations import axis_rotation
from dpcli.prepare.synthetic.creature import Creature

X, Y, Z = np.eye(3)


@dataclass(frozen=True)
class Motion:
    """Describes a motion. kind: of the animal. cycles: as a rule in one clip. period: seconds of a cycle."""

    kind: str
    cycles: float
    period: float


MOTIONS = {
    "walk": Motion("quadruped", 1, 1.0),
    "trot": Motion("quadruped", 1, 0.6),
    "wag": Motion("quadruped", 2, 0.5),
    "fly": Motion("bird", 2, 0.5),
    "swim": Motion("fish", 2, 0.8),
}
# when each leg is in its cycle: a walk sets the feet down one after the other, a trot the diagonal ones together
_ORDER = {
    "walk": {"hind_left": 0.0, "front_left": 0.25, "hind_right": 0.5, "front_right": 0.75},
    "trot": {"hind_left": 0.0, "front_right": 0.0, "hind_right": 0.5, "front_left": 0.5},
}

Turns = dict[str, list[tuple[np.ndarray, np.ndarray]]]  # bone name -> (axis, angle (T)), the first turns first


def turn_bones(animal: Creature, motion: str, phase: np.ndarray) -> tuple[Turns, np.ndarray]:
    """Returns how the bones turn and where the root goes f64 (T,3), at phase (T): 1 per cycle."""
    w = 2 * np.pi * phase
    if animal.kind == "bird":
        return _fly(w)
    if animal.kind == "fish":
        return _swim(w)
    return _wag(w) if motion == "wag" else _step(animal, w, motion)


def _step(animal: Creature, w: np.ndarray, gait: str) -> tuple[Turns, np.ndarray]:
    swing, lift = (0.34, 0.75) if gait == "walk" else (0.45, 1.1)
    turns: Turns = {}
    for leg, start in _ORDER[gait].items():
        own = w + 2 * np.pi * start
        thigh, shin = swing * _even(own), lift * np.maximum(0, -np.cos(own)) ** 1.5  # bent while it swings forward
        turns |= {f"{leg}_0": [(X, thigh)], f"{leg}_1": [(X, shin)], f"{leg}_2": [(X, -0.6 * (thigh + shin))]}
    bounce = 0.012 if gait == "walk" else 0.03
    turns["chest"] = [(Y, 0.06 * np.sin(w)), (X, 0.02 * np.sin(2 * w))]
    turns["neck_0"] = [(X, 0.08 * np.sin(2 * w + 0.6)), (Y, -0.05 * np.sin(w))]
    turns["head"] = [(X, -0.06 * np.sin(2 * w + 0.3))]
    for k in range(3):
        turns[f"tail_{k}"] = [(Y, 0.22 * np.sin(w - 0.7 * k))]
    forward = 4 * animal.leg * np.sin(swing) * w / (2 * np.pi)  # the standing feet stay about where they are
    return turns, np.stack([0 * w, bounce * np.cos(2 * w), forward], axis=1)


def _even(w: np.ndarray) -> np.ndarray:
    """Returns a rounded zigzag of height 1: a leg on the ground swings back evenly, as the body passes over it."""
    return np.arcsin(0.96 * np.sin(w)) / np.arcsin(0.96)


def _wag(w: np.ndarray) -> tuple[Turns, np.ndarray]:
    slow = w / 2
    turns: Turns = {f"tail_{k}": [(X, 0.25 + 0 * w), (Y, 0.55 * np.sin(w - 0.6 * k))] for k in range(3)}
    turns["hips"] = [(Y, -0.07 * np.sin(w))]
    turns["chest"] = [(Y, 0.12 * np.sin(w))]
    turns["neck_0"] = [(Y, 0.3 * np.sin(slow)), (X, 0.1 * np.sin(w))]
    turns["head"] = [(Z, 0.3 * np.sin(slow + 0.5)), (Y, 0.15 * np.sin(slow))]
    for side, sign in (("left", 1), ("right", -1)):
        turns[f"ear_{side}"] = [(Z, 0.25 * sign * np.sin(w))]
        for end in ("hind", "front"):  # the feet stay where they are
            turns[f"{end}_{side}_0"] = [(Y, (0.07 if end == "hind" else -0.05) * np.sin(w))]
    return turns, np.zeros((len(w), 3))


def _fly(w: np.ndarray) -> tuple[Turns, np.ndarray]:
    turns: Turns = {}
    for side, sign in (("left", 1), ("right", -1)):
        turns[f"wing_{side}_0"] = [(X, 0.15 * np.cos(w)), (Z, sign * (0.12 + 0.6 * np.sin(w)))]
        turns[f"wing_{side}_1"] = [(Z, sign * (-0.1 + 0.55 * np.sin(w - 0.9)))]
    turns["tail_0"] = [(X, 0.18 * np.sin(w + 0.5))]
    turns["neck_0"] = [(X, 0.1 * np.sin(w))]
    turns["head"] = [(X, -0.1 * np.sin(w))]
    turns["body"] = [(X, 0.06 * np.sin(w + 1))]
    return turns, np.stack([0 * w, -0.07 * np.sin(w), 0.3 * w / (2 * np.pi)], axis=1)


def _swim(w: np.ndarray) -> tuple[Turns, np.ndarray]:
    wave = {"head": (0.1, 0.0), "front": (0.1, 0.6), "middle": (0.2, 1.3), "rear": (0.3, 2.0), "tail": (0.45, 2.8)}
    turns: Turns = {name: [(Y, size * np.sin(w - lag))] for name, (size, lag) in wave.items()}
    for side, sign in (("left", 1), ("right", -1)):
        turns[f"fin_{side}"] = [(Z, 0.4 * sign * np.sin(w + 0.5))]
    turns["back_fin"] = [(Z, 0.12 * np.sin(w - 1))]
    return turns, np.stack([0 * w, 0.02 * np.sin(w / 2), 0.2 * w / (2 * np.pi)], axis=1)


def bone_motion(animal: Creature, turns: Turns, travel: np.ndarray) -> np.ndarray:
    """Returns rest pose to frame f64 (T,B,4,4): each bone turns about its pivot, then moves with its parent."""
    frames = len(travel)
    motion = np.tile(np.eye(4), (frames, len(animal.bones), 1, 1))
    for index, bone in enumerate(animal.bones):
        local = np.tile(np.eye(4), (frames, 1, 1))
        for axis, angle in turns.get(bone.name, []):
            local[:, :3, :3] = axis_rotation(axis, angle) @ local[:, :3, :3]
        local[:, :3, 3] = bone.pivot - local[:, :3, :3] @ bone.pivot
        if bone.parent < 0:
            local[:, :3, 3] += travel
            motion[:, index] = local
        else:
            motion[:, index] = motion[:, bone.parent] @ local
    return motion
