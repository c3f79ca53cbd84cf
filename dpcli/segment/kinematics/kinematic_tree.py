"""The tree of joints over the parts of a sequence: which part hangs on which, by which joint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from dpcli.segment.kinematics.joint_fit import JointFit, fit_joint
from dpcli.segment.kinematics.part_trajectories import Trajectories, part_trajectories, points_at_start
from dpcli.store import CloudSequence, PartsSample
from dpcli.store.joints import AXIS, FIXED, FREE, PARENT, POINT, PRISMATIC, REVOLUTE, TYPE, VALUE, no_joints

_POINTS = 64  # of a part that a joint is fitted to
_NOISE = 0.3  # of the distance between neighboring points: how far estimated motions are off at the least
_APART = 2.0  # nats for each such distance between two parts: joined parts touch
_LARGE = 2.0  # nats by which the largest part is preferred as parent


@dataclass(frozen=True)
class PartJoint:
    """Holds one edge of the tree: rows of child and parent among the parts of `Trajectories`, and the joint."""

    child: int
    parent: int
    fit: JointFit


@dataclass(frozen=True)
class KinematicTree:
    """Holds the parts' trajectories, their points where they were in frame 0, the root's row and the other parts' joints.

    Every part but the root has one joint, after its parent's; points: K arrays f64 (M_k,3).
    """

    trajectories: Trajectories
    points: list[np.ndarray]
    root: int
    joints: list[PartJoint]

    def as_field(self, frames: int, parts: int) -> np.ndarray:
        """Returns the joints as a file's `joint` has them, f64 (frames,parts,9), in each frame's coordinates."""
        ids, field = self.trajectories.ids, no_joints(frames, parts)
        for joint in self.joints:
            rows, fit = field[:, ids[joint.child]], joint.fit
            rows[:, PARENT], rows[:, TYPE], rows[:, VALUE] = ids[joint.parent], fit.kind, fit.value
            if fit.kind in (REVOLUTE, PRISMATIC):
                base = self.trajectories.motion[:, joint.parent]
                rows[:, AXIS] = base[:, :3, :3] @ fit.axis
                rows[:, POINT] = base[:, :3, :3] @ fit.point + base[:, :3, 3]
        return field


def kinematic_tree(sequence: CloudSequence, said: PartsSample) -> KinematicTree:
    """Returns the tree of joints whose description length is least: a minimum spanning tree over the parts (Prim 1957).

    An edge costs what its joint costs (`fit_joint`), and more the farther the two parts are apart; the larger part of two
    is the parent of the fit. The root is the largest part. Raises DataError as `part_trajectories`.
    """
    trajectories = part_trajectories(sequence, said)
    points = [
        points_at_start(sequence, int(part), trajectories.motion[:, k]) for k, part in enumerate(trajectories.ids)
    ]
    spacing = _spacing(points)
    noise = np.maximum(trajectories.disagreement, _NOISE * spacing)
    sizes = np.array([len(cloud) for cloud in points])
    count = len(points)
    fits, cost = {}, np.full((count, count), np.inf)
    for a in range(count):
        for b in range(count):
            if a != b and (sizes[a], -a) >= (sizes[b], -b):
                fits[a, b] = _relative_joint(trajectories, a, b, points[b], float(np.hypot(noise[a], noise[b])))
                gap = max(_gap(points[a], points[b]) / spacing - 1, 0)
                cost[a, b] = cost[b, a] = fits[a, b].length + _APART * gap - _LARGE * sizes[a] / sizes.max()
    root = int(sizes.argmax())
    joints = [PartJoint(child, parent, _oriented(fits, parent, child)) for parent, child in _spanning_tree(cost, root)]
    return KinematicTree(trajectories, points, root, joints)


def _spacing(points: list[np.ndarray]) -> float:
    """Returns the median distance of a part's points to the nearest other, over the parts; never 0."""
    distances = [cKDTree(cloud).query(cloud, 2)[0][:, 1] for cloud in points if len(cloud) > 1]
    return max(float(np.median(np.concatenate(distances))), 1e-9) if distances else 1e-9


def _relative_joint(trajectories: Trajectories, parent: int, child: int, points: np.ndarray, noise: float) -> JointFit:
    """Returns the joint that explains the child's motion as the parent sees it, in the frames that show both."""
    both = trajectories.seen[:, parent] & trajectories.seen[:, child]
    both[0] = True
    motion = trajectories.motion
    relative = np.linalg.inv(motion[:, parent]) @ motion[:, child]
    thinned = points[np.linspace(0, len(points) - 1, min(len(points), _POINTS)).astype(int)]
    fit = fit_joint(relative[both], thinned, noise)
    value = np.interp(np.arange(len(both)), np.flatnonzero(both), fit.value)
    return JointFit(fit.kind, fit.axis, fit.point, value, fit.residual, fit.length)


def _gap(first: np.ndarray, second: np.ndarray) -> float:
    """Returns the distance between two clouds where they are nearest; a tenth of the points decides, so that one can't."""
    distances = np.sort(cKDTree(first).query(second)[0])
    return float(distances[min(len(distances) - 1, 4)])


def _spanning_tree(cost: np.ndarray, root: int) -> list[tuple[int, int]]:
    """Returns the edges (parent, child) of the cheapest tree, each after its parent's."""
    inside, edges = [root], []
    while len(inside) < len(cost):
        outside = [k for k in range(len(cost)) if k not in inside]
        choice = cost[np.ix_(inside, outside)]
        row, column = np.unravel_index(choice.argmin(), choice.shape)
        edges.append((inside[row], outside[column]))
        inside.append(outside[column])
    return edges


def _oriented(fits: dict[tuple[int, int], JointFit], parent: int, child: int) -> JointFit:
    """Returns the joint with the parent's part as the parent: turned round where it was fitted the other way.

    In frame 0 both parts' coordinates are the frame's, and a joint's axis is at rest in both, so only the sign of the value
    changes.
    """
    if (parent, child) in fits:
        return fits[parent, child]
    fit = fits[child, parent]
    return JointFit(fit.kind, fit.axis, fit.point, -fit.value, fit.residual, fit.length)


def joint_counts(tree: KinematicTree) -> dict[str, int]:
    """Returns how many joints of each type the tree has.

    The names are those of a file's `joint`.
    """
    names = {REVOLUTE: "revolute", PRISMATIC: "prismatic", FIXED: "fixed", FREE: "free"}
    return {name: n for kind, name in names.items() if (n := sum(j.fit.kind == kind for j in tree.joints))}
