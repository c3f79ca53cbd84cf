"""The true joints between the parts of an articulated object, as the file's `joint` holds them."""

from __future__ import annotations

import numpy as np

from dpcli.prepare.articulated.articulated_object import ArticulatedObject, groups, parts
from dpcli.store.joints import AXIS, FREE, PARENT, POINT, PRISMATIC, REVOLUTE, TYPE, VALUE, no_joints


def true_joints(
    obj: ArticulatedObject, locked: set[int], values: np.ndarray, poses: np.ndarray, scale: float, padded: int
) -> np.ndarray:
    """Returns the joint above each part, f64 (F,padded,9), in the coordinates of each frame.

    locked: joints that stay still. values f64 (F,joints): radians, or the object's unit for slides, which `scale` turns
    into the file's; poses f64 (F,bodies,4,4): body to the frame's points. Where bodies without surface lie between two
    parts their joints add up: the type is free, without an axis.
    """
    part, top = parts(obj, locked), groups(obj, locked)
    above = {joint.child: index for index, joint in enumerate(obj.joints)}
    found = no_joints(len(values), padded)
    for body in np.unique(top[part >= 0]):
        chain = _joints_up_to_a_part(obj, int(body), part, top, above)
        if not chain:
            continue
        row, joint = found[:, part[body]], obj.joints[chain[0]]
        row[:, PARENT] = part[top[obj.joints[chain[-1]].parent]]
        row[:, TYPE] = FREE
        if len(chain) == 1:
            slides = joint.kind == "prismatic"
            row[:, TYPE] = PRISMATIC if slides else REVOLUTE
            row[:, AXIS] = poses[:, body, :3, :3] @ joint.axis
            row[:, POINT] = poses[:, body, :3, 3]
            row[:, VALUE] = values[:, chain[0]] * (scale if slides else 1.0)
    return found


def _joints_up_to_a_part(
    obj: ArticulatedObject, body: int, part: np.ndarray, top: np.ndarray, above: dict[int, int]
) -> list[int]:
    """Returns the moving joints between a rigid group's topmost body and the next part above it; none below the root."""
    chain: list[int] = []
    while body in above:
        chain.append(above[body])
        body = int(top[obj.joints[chain[-1]].parent])
        if part[body] >= 0:
            return chain
    return []
