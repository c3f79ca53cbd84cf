"""The nine numbers of a joint in a file's `joint`: parent part, type, axis, point on the axis, value."""

from __future__ import annotations

import numpy as np

NONE, REVOLUTE, PRISMATIC, FIXED, FREE = range(5)
TYPES = ("none", "revolute", "prismatic", "fixed", "free")
PARENT, TYPE, AXIS, POINT, VALUE = 0, 1, slice(2, 5), slice(5, 8), 8


def no_joints(frames: int, parts: int) -> np.ndarray:
    """Returns the field of parts without joints, f64 (frames,parts,9): no parent, zero elsewhere.

    >>> no_joints(1, 1).tolist()
    [[[-1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]]]
    """
    joints = np.zeros((frames, parts, 9))
    joints[..., PARENT] = -1
    return joints
