"""The axis of a joint by the points of its two parts in all frames: free, or along a direction of the parts' own surfaces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dpcli.segment.frame_pairs import sequence_scale, without_strays
from dpcli.segment.kinematics.joint_fit import JointFit
from dpcli.segment.kinematics.kinematic_tree import KinematicTree
from dpcli.segment.kinematics.part_trajectories import Trajectories
from dpcli.segment.kinematics.surface_directions import directions_and_edges, distinct_directions
from dpcli.segment.multibody.frames import Frames
from dpcli.segment.multibody.point_fit import NUMBER_PRICE, PointFit
from dpcli.segment.thinning import spread_places
from dpcli.store import CloudSequence
from dpcli.store.joints import PRISMATIC, REVOLUTE

_FRAMES = 12  # of a sequence that are looked at
_MOST = 256  # points of a part in a frame
_FEWEST = 9  # points that make a surface
_ALONG_NOTHING = 3 * NUMBER_PRICE  # what a free axis must save: its two numbers, and it is rare
_KNOWN = np.cos(np.radians(4))  # of the directions: no surface tells them better
_STEPS, _STEPS_ALONG, _WIDE = 10, 6, 1.5  # of a fit, of one along a direction, and the first residual in spacings


def with_point_axes(sequence: CloudSequence, tree: KinematicTree) -> KinematicTree:
    """Returns the tree with the axes of hinges and slides that the points of both parts say (`SeenParts.with_axis`).

    Points with an identity have told their motions already, more exactly than the surfaces on which they lie.
    """
    if sequence.track is not None:
        return tree
    seen, joints = SeenParts(sequence, tree.trajectories), []
    directions = [directions_and_edges(cloud) for cloud in tree.points]
    for joint in tree.joints:
        larger = sorted((joint.parent, joint.child), key=lambda k: -len(tree.points[k]))  # it tells directions better
        both = distinct_directions(np.concatenate([directions[k] for k in larger]))
        joints.append(replace(joint, fit=seen.with_axis(joint.parent, joint.child, joint.fit, both)))
    return replace(tree, joints=joints)


class SeenParts:
    """Holds the points of a sequence's parts, in up to 12 of its frames, scaled to diameter 1, and the parts' motions."""

    def __init__(self, sequence: CloudSequence, trajectories: Trajectories) -> None:
        rng = np.random.default_rng(0)
        self._chosen = spread_places(sequence.num_frames, _FRAMES)
        self._ids, self._motion = trajectories.ids, trajectories.motion[self._chosen, :, :3]
        frames = np.split(np.arange(len(sequence.points)), sequence.frame_offsets[1:-1])
        rows = [_thinned(frames[t], sequence.part, rng) for t in self._chosen]
        clouds = [sequence.points[own].astype(np.float64) for own in rows]
        self._part = sequence.part[np.concatenate(rows)]
        self._center = np.concatenate([without_strays(cloud) for cloud in clouds]).mean(0)
        self._scale = float(sequence_scale(clouds))
        enough = min(len(own) for own in rows) >= _FEWEST and len(rows) > 1
        self._frames = Frames([(cloud - self._center) * self._scale for cloud in clouds]) if enough else None

    def with_axis(self, parent: int, child: int, fit: JointFit, directions: np.ndarray) -> JointFit:
        """Returns a hinge or slide between two parts (rows of `Trajectories`) with the axis that all points say.

        The joint is fitted to the points of both parts, whose motions are not exact either, with a free axis and along each
        of the directions f64 (D,3). A free axis is taken where it saves enough. A joint that lies along what is taken, or
        costs little more, stays as it is, as do those of other types.
        """
        if self._frames is None or fit.kind not in (REVOLUTE, PRISMATIC):
            return fit
        masks = [self._part == self._ids[k] for k in (parent, child)]
        best = PointFit(self._frames, masks[1], self._trajectory(parent), self._scaled(fit), parent=masks[0])
        given = self._cost(best, masks)
        best.run(_STEPS, _WIDE)
        first, least = best, self._cost(best, masks) + _ALONG_NOTHING
        for direction in directions:
            axis = direction if direction @ first.joint.axis >= 0 else -direction
            start = replace(first.joint, axis=axis)
            along = PointFit(self._frames, masks[1], first.parent, start, parent=masks[0], keep_axis=True)
            along.run(_STEPS_ALONG, _WIDE)
            if (cost := self._cost(along, masks)) < least:
                best, least = along, cost
        if best is first:
            same = given - self._cost(first, masks) < 4 * NUMBER_PRICE  # those of its line
        else:
            same = abs(best.joint.axis @ fit.axis) > _KNOWN
        return fit if same else self._unscaled(fit, best.joint)

    def _cost(self, fit: PointFit, masks: list[np.ndarray]) -> float:
        """Returns what the points of parent and child cost."""
        return sum(
            float(self._frames.explain(trajectory)[0][own].sum(dtype=np.float64))
            for trajectory, own in zip((fit.parent, fit.trajectory), masks, strict=True)
        )

    def _trajectory(self, part: int) -> np.ndarray:
        """Returns a part's motions (T,3,4) in the scaled coordinates."""
        motion = self._motion[:, part].copy()
        motion[:, :, 3] = self._scale * (motion[:, :, 3] + motion[:, :, :3] @ self._center - self._center)
        return motion

    def _scaled(self, fit: JointFit) -> JointFit:
        unit = self._scale if fit.kind == PRISMATIC else 1.0
        return replace(fit, point=self._scale * (fit.point - self._center), value=unit * fit.value[self._chosen])

    def _unscaled(self, fit: JointFit, found: JointFit) -> JointFit:
        """Returns the joint with the axis found; values of frames that weren't looked at lie between those that were."""
        unit = self._scale if fit.kind == PRISMATIC else 1.0
        turned = 1.0 if found.axis @ fit.axis >= 0 else -1.0
        off = found.value / unit - turned * fit.value[self._chosen]
        value = turned * fit.value + np.interp(np.arange(len(fit.value)), self._chosen, off)
        return replace(fit, axis=found.axis, point=found.point / self._scale + self._center, value=value)


def _thinned(rows: np.ndarray, part: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Returns rows of a frame's points, of each part at most `_MOST`."""
    own = [rows[part[rows] == k] for k in np.unique(part[rows])]
    return np.concatenate([rng.permutation(one)[:_MOST] for one in own] or [rows])
