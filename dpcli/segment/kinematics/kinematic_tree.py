"""The tree of joints over the parts of a sequence: which part hangs on which, by which joint."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from dpcli.segment.kinematics.joint_fit import JointFit, fit_joint
from dpcli.segment.kinematics.part_trajectories import Trajectories, part_trajectories, points_at_start
from dpcli.segment.kinematics.registration import Registration, register, register_tracks, relative_registration
from dpcli.segment.kinematics.surface_directions import surface_directions
from dpcli.segment.rigid_motions import HOLD
from dpcli.store import CloudSequence, PartsSample
from dpcli.store.joints import AXIS, FIXED, PARENT, POINT, PRISMATIC, REVOLUTE, TYPE, TYPES, VALUE, no_joints

_SURE = 0.05  # of the distance between neighboring points: no motion is known better
_APART = 2.0  # nats for each such distance between two parts: joined parts touch
_NEAREST = 3  # parts to which a part may be joined, besides what connects all
_LARGE = 2.0  # nats by which the largest part is preferred as parent
_UNSEEN = 0.25  # of a part's size: a motion that is told where points don't show it


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

    An edge costs what its joint costs (`fit_joint`), and more the farther the two parts are apart. The root is the
    largest part. Raises DataError as `part_trajectories`.
    """
    trajectories = part_trajectories(sequence, said)
    points = [
        points_at_start(sequence, int(part), trajectories.motion[:, k]) for k, part in enumerate(trajectories.ids)
    ]
    spacing = _spacing(points)
    known = _registrations(sequence, trajectories, spacing) if len(points) > 1 else []
    directions = [surface_directions(cloud) for cloud in points]
    sizes = np.array([len(cloud) for cloud in points])
    fits = _PairFits(known, trajectories.seen, directions, sizes)
    cost, gaps = np.full((len(points), len(points)), np.inf), _gaps(points, spacing)
    for a, b in _neighbors(gaps):
        price = _APART * gaps[a, b] - _LARGE * max(sizes[a], sizes[b]) / sizes.max()
        cost[a, b] = cost[b, a] = fits.joint(a, b).length + price
    root = int(sizes.argmax())
    return KinematicTree(trajectories, points, root, _cheapest_joints(fits, cost, root))


class _PairFits:
    """Fits the joint between two parts when it is asked for, once; the larger of the two is the parent of the fit."""

    def __init__(
        self, known: list[Registration], seen: np.ndarray, directions: list[np.ndarray], sizes: np.ndarray
    ) -> None:
        """Takes the parts' motions with their errors; seen bool (T,K), directions of the surfaces and sizes i (K) are theirs, too."""
        self.sizes = sizes
        self._known, self._seen, self._directions = known, seen, directions
        self._found: dict[tuple[int, int], JointFit] = {}

    def joint(self, parent: int, child: int) -> JointFit:
        """Returns the joint with the parent's part as the parent: turned round where it was fitted the other way.

        In frame 0 both parts' coordinates are the frame's, and a joint's axis is at rest in both, so only the sign of the value
        changes.
        """
        a, b = sorted((parent, child), key=lambda k: (-self.sizes[k], k))
        if (a, b) not in self._found:
            both = np.concatenate([self._directions[a], self._directions[b]])
            seen = self._seen[:, a] & self._seen[:, b]
            self._found[a, b] = _relative_joint(self._known[a], self._known[b], seen, both)
        fit = self._found[a, b]
        return fit if (parent, child) == (a, b) else replace(fit, value=-fit.value)


def _cheapest_joints(fits: _PairFits, cost: np.ndarray, root: int) -> list[PartJoint]:
    """Returns the joints of the cheapest tree, each after its parent's, by the costs (K,K) of the edges.

    A part whose motion is hardly known could be fixed to each of two others that move against each other, so parts that are
    fixed to one another count as one body: what would be fixed to any of them is joined to it as to the largest.
    """
    cost, joints, inside = cost.copy(), [], [root]
    largest = np.arange(len(cost))  # part of the body of each
    instead: dict[tuple[int, int], JointFit] = {}  # joints of edges that would be fixed
    while len(inside) < len(cost):
        parent, child = _cheapest_edge(cost, inside)
        fit = instead.get((parent, child)) or fits.joint(parent, child)
        if fit.kind == FIXED and (of_all := fits.joint(int(largest[parent]), child)).kind != FIXED:
            instead[parent, child] = of_all
            cost[parent, child] += of_all.length - fit.length
            continue
        if fit.kind == FIXED:
            body = np.isin(largest, [largest[parent], child])
            largest[body] = max(int(largest[parent]), child, key=lambda k: fits.sizes[k])
        joints.append(PartJoint(child, parent, fit))
        inside.append(child)
    return joints


def _spacing(points: list[np.ndarray]) -> float:
    """Returns the median distance of a part's points to the nearest other, over the parts; never 0."""
    distances = [cKDTree(cloud).query(cloud, 2)[0][:, 1] for cloud in points if len(cloud) > 1]
    return max(float(np.median(np.concatenate(distances))), 1e-9) if distances else 1e-9


def _registrations(sequence: CloudSequence, trajectories: Trajectories, spacing: float) -> list[Registration]:
    """Returns the parts' motions with what is known of their errors: from points, and from where pairs disagree."""
    rng, known = np.random.default_rng(0), []
    frames = np.split(np.arange(len(sequence.points)), sequence.frame_offsets[1:-1])
    for k, part in enumerate(trajectories.ids):
        own = [rows[sequence.part[rows] == part] for rows in frames]
        clouds, motion = [sequence.points[rows].astype(np.float64) for rows in own], trajectories.motion[:, k]
        tracks = None if sequence.track is None else [sequence.track[rows] for rows in own]
        if tracks is not None and len(np.unique(np.concatenate(tracks))) >= HOLD:
            known.append(register_tracks(clouds, tracks, motion))
            continue
        one = register(clouds, motion, rng)
        off = max(float(trajectories.disagreement[k]), _SURE * spacing)
        noise = np.diag(np.repeat([(off / max(one.size, 1e-9)) ** 2, off**2], 3))
        known.append(replace(one, covariance=one.covariance + noise))
    return known


def _relative_joint(parent: Registration, child: Registration, both: np.ndarray, directions: np.ndarray) -> JointFit:
    """Returns the joint that explains the child's motion as the parent sees it, in the frames (mask) that show both.

    A frame that doesn't costs as much as one of a free joint, or what is never seen would be the cheapest parent.
    """
    both = both.copy()
    both[0] = True
    fit = fit_joint(relative_registration(parent, child).of_frames(both), directions)
    value = np.interp(np.arange(len(both)), np.flatnonzero(both), fit.value)
    unseen = 6 * (~both).sum() * np.log(max(6 * (len(both) - 1), 2))
    return replace(fit, value=value, length=fit.length + float(unseen))


def _gap(first: np.ndarray, second: np.ndarray) -> float:
    """Returns the distance between two clouds where they are nearest: the fifth least, so that no single point decides."""
    distances = np.sort(cKDTree(first).query(second)[0])
    return float(distances[min(len(distances) - 1, 4)])


def _gaps(points: list[np.ndarray], spacing: float) -> np.ndarray:
    """Returns the distances (K,K) between the parts, in spacings beyond the first."""
    gaps = np.zeros((len(points), len(points)))
    for a, cloud in enumerate(points):
        for b in range(a):
            gaps[a, b] = gaps[b, a] = max(_gap(cloud, points[b]) / spacing - 1, 0)
    return gaps


def _neighbors(gaps: np.ndarray) -> set[tuple[int, int]]:
    """Returns the pairs of parts between which a joint is looked for: each with its nearest ones, and what connects all."""
    nearest = np.argsort(gaps + np.diag(np.full(len(gaps), np.inf)), axis=1, kind="stable")[:, :_NEAREST]
    pairs = {(a, int(b)) for a, row in enumerate(nearest) for b in row if a != b}
    return {(min(pair), max(pair)) for pair in [*pairs, *_spanning_tree(gaps, 0)]}


def _spanning_tree(cost: np.ndarray, root: int) -> list[tuple[int, int]]:
    """Returns the edges (parent, child) of the cheapest tree, each after its parent's."""
    inside, edges = [root], []
    while len(inside) < len(cost):
        edges.append(_cheapest_edge(cost, inside))
        inside.append(edges[-1][1])
    return edges


def _cheapest_edge(cost: np.ndarray, inside: list[int]) -> tuple[int, int]:
    """Returns the edge that costs least of those from a part of the tree to one outside of it."""
    outside = [k for k in range(len(cost)) if k not in inside]
    choice = cost[np.ix_(inside, outside)]
    row, column = np.unravel_index(choice.argmin(), choice.shape)
    return inside[row], outside[column]


def unseen_motions(tree: KinematicTree, kinds: tuple[int, ...]) -> list[tuple[int, int]]:
    """Returns the parts (child, parent) whose joint, of one of some kinds, leaves out motion of a quarter of the part's size.

    Their points don't show it: they are few, or lie alike before and after, as those of a round part that spins.
    """
    found = []
    for joint in tree.joints:
        part = min((joint.child, joint.parent), key=lambda k: len(tree.points[k]))  # whose points the residual is of
        size = np.sqrt(tree.points[part].var(0).sum())
        if joint.fit.kind in kinds and joint.fit.residual > _UNSEEN * size:
            found.append((int(tree.trajectories.ids[joint.child]), int(tree.trajectories.ids[joint.parent])))
    return found


def joint_counts(tree: KinematicTree) -> Counter[str]:
    """Returns how many joints of each type, by its name, the tree has."""
    return Counter(TYPES[joint.fit.kind] for joint in tree.joints)
