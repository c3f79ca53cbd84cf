"""Motions of one degree of freedom: a body turns about one axis of another body, or slides along it, through all frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dpcli.segment.kinematics.contact_hinge import contact_hinge
from dpcli.segment.kinematics.joint_fit import JointFit, nearest_joints
from dpcli.segment.multibody.explanation import Body, Explanation, body_of
from dpcli.segment.multibody.frames import Frames, Trajectory
from dpcli.segment.multibody.point_fit import NUMBER_PRICE, PointFit
from dpcli.segment.rigid_motions import bring_to_rest, compose, invert
from dpcli.store.joints import REVOLUTE

_PARENTS = 2  # larger bodies tried, those that it touches most
_FEWEST = 6  # points in every frame of a body
_AT_CONTACT = 2  # numbers that a hinge at the contact must save besides
_STEPS, _WIDE = 8, 1.5  # of the fit of a joint, and its first residual in spacings


def simplify_motions(frames: Frames, found: Explanation) -> Explanation:
    """Returns the explanation with hinges and slides where a body's own motion in every frame explains little more.

    Motions are chosen by their description length: costs of the body's points, and a price for each number. A free motion
    has six numbers a frame, a hinge one and the four of its line, a slide one and the two of its direction. Labels and costs
    stay as they are.
    """
    bodies = found.bodies[:1]
    for k, body in enumerate(found.bodies[1:], start=1):
        inside = found.label == k
        touched = np.bincount(found.label[frames.neighbors[inside]].ravel(), minlength=k)[:k]
        parents = [p for p in np.argsort(-touched, kind="stable")[:_PARENTS] if touched[p] or p == 0]
        seen = all(inside[frames.slice(t)].sum() >= _FEWEST for t in range(len(frames)))
        others = [(found.label == p, bodies[p].trajectory) for p in parents]
        bodies.append(_simplest(frames, body, inside, others) if seen else body)
    return replace(found, bodies=bodies)


def _simplest(frames: Frames, body: Body, inside: np.ndarray, parents: list[tuple[np.ndarray, Trajectory]]) -> Body:
    """Returns the body with the motion of the least description length, free or by a joint to one of the parents.

    A hinge at the contact has to save more than others, as turns of round parts are any in it and least in these.
    """
    values = len(frames) - 1
    tried, numbers = [body], [6 * values]
    for mask, parent in parents:
        starts = _first_joints(frames, body.trajectory, inside, parent)
        at_contact = contact_hinge(*(_at_rest(frames, own, parent) for own in (inside, mask)), frames.spacing)
        for start in [*starts, at_contact] if at_contact else starts:
            tried.append(body_of(frames, PointFit(frames, inside, parent, start).run(_STEPS, _WIDE).trajectory))
            price = _AT_CONTACT * (start is at_contact)
            numbers.append(values + price + (4 if start.kind == REVOLUTE else 2))
    length = [one.cost[inside].sum(dtype=np.float64) + NUMBER_PRICE * count for one, count in zip(tried, numbers)]
    return tried[int(np.argmin(length))]


def _at_rest(frames: Frames, inside: np.ndarray, trajectory: Trajectory) -> list[np.ndarray]:
    """Returns the points of a mask, of each frame, in the coordinates of a body."""
    return [bring_to_rest(own, motion) for own, motion in zip(frames.points_of(inside), trajectory)]


def _first_joints(frames: Frames, trajectory: Trajectory, inside: np.ndarray, parent: Trajectory) -> list[JointFit]:
    """Returns the slide and the hinge nearest to a body's motion since frame 0, in the parent's own coordinates."""
    child = compose(invert(parent), trajectory)
    motion = np.tile(np.eye(4), (len(child), 1, 1))
    motion[:, :3] = compose(child, invert(child[0]))
    points = bring_to_rest(frames.points_of(inside)[0], parent[0])
    center, size = points.mean(0), max(float(np.sqrt(points.var(0).sum())), frames.spacing)
    return nearest_joints(motion, center + size * np.concatenate([np.eye(3), -np.eye(3)]))
