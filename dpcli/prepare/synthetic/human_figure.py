"""A human figure of capsules: its proportions, and its limbs' positions from where the hands are.

Body axes: x toward the figure's right hand, y up, z forward; the origin lies on the floor between the feet. Meters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

PARTS = (
    "torso",
    "hips",
    "neck and head",
    "right upper arm",
    "right forearm",
    "right hand",
    "left upper arm",
    "left forearm",
    "left hand",
    "right thigh",
    "right shin",
    "left thigh",
    "left shin",
)


@dataclass(frozen=True)
class Figure:
    """Holds lengths in meters; ``girth`` scales all radii."""

    height: float = 1.75
    girth: float = 1.0
    arm: float = 0.33  # of the height, shoulder to wrist
    shoulder: float = 0.105  # of the height, spine to shoulder

    @property
    def reach(self) -> float:
        """Returns the distance from shoulder to wrist, meters."""
        return self.arm * self.height

    def shoulders(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns right and left shoulder (3), meters."""
        x, y = self.shoulder * self.height, 0.81 * self.height
        return np.array([x, y, 0.0]), np.array([-x, y, 0.0])

    @property
    def radii(self) -> np.ndarray:
        """Returns the capsule radius of every part, f64 (parts), meters."""
        relative = [0.075, 0.07, 0.055, 0.028, 0.024, 0.026, 0.028, 0.024, 0.026, 0.045, 0.034, 0.045, 0.034]
        return self.girth * self.height * np.array(relative)


def bend_elbow(
    shoulder: np.ndarray, wrist: np.ndarray, upper: float, fore: float, pole: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Solves two-bone inverse kinematics: shoulder (3), wanted wrist (T,3), bone lengths, pole (3) -> elbow, wrist
    (T,3).

    The elbow bends toward ``pole``. A wrist out of reach is moved onto the nearest reachable sphere.
    """
    offset = wrist - shoulder
    distance = np.linalg.norm(offset, axis=1, keepdims=True)
    axis = offset / np.maximum(distance, 1e-9)
    distance = np.clip(distance, abs(upper - fore) + 1e-6, (upper + fore) * 0.999)
    along = (distance**2 + upper**2 - fore**2) / (2 * distance)
    side = pole - (axis @ pole)[:, None] * axis
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    elbow = shoulder + along * axis + np.sqrt(np.maximum(upper**2 - along**2, 0)) * side
    return elbow, shoulder + distance * axis


def capsules(figure: Figure, right_wrist: np.ndarray, left_wrist: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns both ends of every part's axis, in body axes: wrists (T,3) -> starts, ends f64 (T,parts,3)."""
    h, still = figure.height, np.zeros_like(right_wrist)
    fixed = {name: still + np.array(at) * h for name, at in _TRUNK.items()}
    starts, ends = np.zeros((2, len(right_wrist), len(PARTS), 3))
    for part, (a, b) in {0: ("chest", "waist"), 1: ("hip right", "hip left"), 2: ("neck", "crown")}.items():
        starts[:, part], ends[:, part] = fixed[a], fixed[b]
    half = figure.reach / 2
    for first, shoulder, wrist, sign in zip(
        (3, 6), figure.shoulders(), (right_wrist, left_wrist), (1, -1), strict=True
    ):
        elbow, wrist = bend_elbow(shoulder, wrist, half, half, np.array([0.5 * sign, -1.0, -0.3]))
        hand = wrist + (wrist - elbow) / half * 0.05 * h
        for part, (a, b) in enumerate(((shoulder, elbow), (elbow, wrist), (wrist, hand)), start=first):
            starts[:, part], ends[:, part] = a, b
    for first, side in ((9, "right"), (11, "left")):
        for part, (a, b) in enumerate((("hip", "knee"), ("knee", "ankle")), start=first):
            starts[:, part], ends[:, part] = fixed[f"{a} {side}"], fixed[f"{b} {side}"]
    return starts, ends


_TRUNK = {  # in body heights
    "chest": (0, 0.75, 0),
    "waist": (0, 0.60, 0),
    "neck": (0, 0.87, 0.01),
    "crown": (0, 0.94, 0.01),
    "hip right": (0.05, 0.53, 0),
    "hip left": (-0.05, 0.53, 0),
    "knee right": (0.055, 0.285, 0.02),
    "knee left": (-0.055, 0.285, 0.02),
    "ankle right": (0.06, 0.04, 0),
    "ankle left": (-0.06, 0.04, 0),
}
