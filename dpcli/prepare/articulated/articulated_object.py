"""Bodies joined by hinges and slides: forward kinematics, and which bodies count as parts."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from dpcli.errors import DataError
from dpcli.ops.rotations import axis_rotation
from dpcli.prepare.meshes.surface_points import choose_on_surface, points_on

_NEGLIGIBLE = 1e-3  # of the object's diameter: what moves by less doesn't move
_LONG, _ENDLESS = 10, 1000  # diameters of the object: slides that are odd, and those that have no limits at all
_CHECKED_STATES = 6  # values of a joint at which the place of the surface is compared


@dataclass(frozen=True)
class Joint:
    """Holds a hinge (``revolute``, radians) or slide (``prismatic``, the object's unit) from a parent to a child body.

    origin f64 (4,4): the child's frame in the parent's at value 0; axis f64 (3): unit vector in the child's frame.
    A joint that ``follows`` another has the value multiplier * value + offset of that joint; -1: a joint of its own.
    """

    parent: int
    child: int
    kind: str
    origin: np.ndarray
    axis: np.ndarray
    lower: float
    upper: float
    follows: int = -1
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass
class ArticulatedObject:
    """Holds rigid bodies in a tree of joints. Body 0 is the root; a joint's parent is reached before its child.

    triangles f64 (T,3,3): corners, each in the frame of its body; body_of_triangle i64 (T). Triangles have an area.
    notes: counts of what was odd in the source, for the log.
    """

    name: str
    joints: list[Joint]
    triangles: np.ndarray
    body_of_triangle: np.ndarray
    notes: Counter = field(default_factory=Counter)

    @property
    def num_bodies(self) -> int:
        """Returns the number of bodies."""
        return len(self.joints) + 1

    @cached_property
    def areas(self) -> np.ndarray:
        """Returns the area of every triangle, f64 (T)."""
        return triangle_areas(self.triangles)

    @cached_property
    def body_areas(self) -> np.ndarray:
        """Returns surface area of every body, f64 (bodies)."""
        return np.bincount(self.body_of_triangle, self.areas, minlength=self.num_bodies)

    @cached_property
    def vertices(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the distinct corners f64 (V,3), each in the frame of its body, and their bodies i64 (V)."""
        corners = np.concatenate([self.triangles.reshape(-1, 3), np.repeat(self.body_of_triangle, 3)[:, None]], axis=1)
        corners = np.unique(corners, axis=0)
        return corners[:, :3], corners[:, 3].astype(np.int64)

    def poses(self, values: np.ndarray) -> np.ndarray:
        """Returns body-to-root f64 (F,bodies,4,4) for joint values f64 (F,joints): forward kinematics, after
        ``follow``.
        """
        poses = np.tile(np.eye(4), (len(values), self.num_bodies, 1, 1))
        for joint, value in zip(self.joints, values.T, strict=True):
            poses[:, joint.child] = poses[:, joint.parent] @ joint.origin @ joint_motion(joint, value)
        return poses

    def follow(self, values: np.ndarray) -> np.ndarray:
        """Returns joint values f64 (F,joints) in which every follower has the value its leader gives it."""
        values = values.copy()
        for index, joint in enumerate(self.joints):
            if joint.follows >= 0:
                values[:, index] = joint.multiplier * values[:, joint.follows] + joint.offset
        return values

    def extent(self, poses: np.ndarray) -> tuple[np.ndarray, float]:
        """Returns the center (3) of the bounding box and the radius of the sphere about it. poses f64 (bodies,4,4)."""
        points, body = self.vertices
        placed = transform(poses[body], points)
        center = (placed.min(0) + placed.max(0)) / 2
        return center, float(np.linalg.norm(placed - center, axis=1).max())


def joint_motion(joint: Joint, values: np.ndarray) -> np.ndarray:
    """Returns the motions f64 (F,4,4) of a joint at its values f64 (F); hinges turn by Rodrigues' formula."""
    motion = np.tile(np.eye(4), (len(values), 1, 1))
    if joint.kind == "prismatic":
        motion[:, :3, 3] = values[:, None] * joint.axis
    else:
        motion[:, :3, :3] = axis_rotation(joint.axis, values)
    return motion


def transform(motions: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Applies motions (...,4,4) to points (...,3), row by row."""
    return (motions[..., :3, :3] @ points[..., None])[..., 0] + motions[..., :3, 3]


def triangle_areas(triangles: np.ndarray) -> np.ndarray:
    """Returns areas f64 (T) of triangles (T,3,3)."""
    return np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1) / 2


def drop_degenerate(
    triangles: np.ndarray, body_of_triangle: np.ndarray, notes: Counter
) -> tuple[np.ndarray, np.ndarray]:
    """Removes the triangles that have no area or a corner that is not finite, and counts them in ``notes``."""
    with np.errstate(invalid="ignore", over="ignore"):
        area = triangle_areas(triangles)
        size = np.abs(triangles).max(axis=(1, 2), initial=0.0)
    good = np.isfinite(area) & np.isfinite(size) & (area > 1e-14 * size**2)
    if not good.all():
        notes["triangles without area dropped"] += int((~good).sum())
    return triangles[good], body_of_triangle[good]


def sample_values(obj: ArticulatedObject, frames: int, step: float, rng: np.random.Generator) -> np.ndarray:
    """Draws joint values f64 (F,joints): a random walk of each joint within its limits.

    ``step``: the largest change between consecutive frames as a fraction of the joint's range; with 1 they are
    independent. A walk must span at least half a step, or it is drawn again.
    """
    values = np.zeros((frames, len(obj.joints)))
    for index, joint in enumerate(obj.joints):
        values[:, index] = _walk(joint.lower, joint.upper, frames, step, rng)
    return obj.follow(values)


def _walk(lower: float, upper: float, frames: int, step: float, rng: np.random.Generator) -> np.ndarray:
    reach = step * (upper - lower)
    best = np.full(frames, lower)
    for _ in range(50):
        walk = [rng.uniform(lower, upper)]
        for _ in range(frames - 1):
            walk.append(rng.uniform(max(lower, walk[-1] - reach), min(upper, walk[-1] + reach)))
        if np.ptp(walk) >= np.ptp(best):
            best = np.array(walk)
        if np.ptp(walk) >= reach / 2:
            break
    return best


def idle_joints(obj: ArticulatedObject, least: float, visible_only: bool, rng: np.random.Generator) -> set[int]:
    """Returns the joints that hardly move anything over their whole range, but never the one that moves most.

    ``least``: a fraction of the object's diameter that some point of the surface must move by. With ``visible_only``
    a tenth of the moved surface must come to lie that far from where surface was: a wheel that spins about its own axis
    moves its points but not its shape, which can't be seen in points that are sampled anew in every frame.
    """
    middle = np.array([[(joint.lower + joint.upper) / 2 for joint in obj.joints]])
    poses = obj.poses(obj.follow(middle))[0]
    diameter, below = 2 * obj.extent(poses)[1], _subtrees(obj)
    changes = np.array([_largest_change(obj, j, below[j.child], poses, visible_only, rng) for j in obj.joints])
    changes /= diameter
    if changes.max() < least and changes.max() > _NEGLIGIBLE and not visible_only:
        obj.notes[f"objects that move by less than {least} of their size"] += 1
        least = changes.max()
    return set(np.flatnonzero(changes < max(least, _NEGLIGIBLE)).tolist())


def _largest_change(
    obj: ArticulatedObject, joint: Joint, below: np.ndarray, poses: np.ndarray, of_shape: bool, rng: np.random.Generator
) -> float:
    """Returns how far the surface of the bodies ``below`` the joint, bool (bodies), goes from its place at the lower
    limit.
    """
    if not obj.body_areas[below].sum():
        return 0.0
    only = np.where(below[obj.body_of_triangle], obj.areas, 0.0)
    chosen = choose_on_surface(only, 3000 if of_shape else 400, rng)
    body = obj.body_of_triangle[chosen.triangle]
    points = transform(np.linalg.inv(poses[joint.child]) @ poses[body], points_on(obj.triangles, chosen))
    motions = joint_motion(joint, np.linspace(*_range(obj, joint), _CHECKED_STATES))
    moved = [transform(motion, points[:400]) for motion in np.linalg.inv(motions[0]) @ motions[1:]]
    if not of_shape:
        return float(max(np.linalg.norm(place - points[:400], axis=1).max() for place in moved))
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    return float(max(np.percentile(tree.query(place)[0], 90) for place in moved))


def _range(obj: ArticulatedObject, joint: Joint) -> tuple[float, float]:
    if joint.follows < 0:
        return joint.lower, joint.upper
    leader = obj.joints[joint.follows]
    return joint.multiplier * leader.lower + joint.offset, joint.multiplier * leader.upper + joint.offset


def _subtrees(obj: ArticulatedObject) -> np.ndarray:
    """Returns bool (bodies,bodies): row b marks b and everything that hangs on it."""
    below = np.eye(obj.num_bodies, dtype=bool)
    for joint in reversed(obj.joints):
        below[joint.parent] |= below[joint.child]
    return below


def groups(obj: ArticulatedObject, locked: set[int]) -> np.ndarray:
    """Returns for every body the topmost body it is rigidly joined to when the ``locked`` joints stay still, i64
    (bodies).
    """
    top = np.arange(obj.num_bodies)
    for index, joint in enumerate(obj.joints):
        if index in locked:
            top[joint.child] = top[joint.parent]
    return top


def lock_small(obj: ArticulatedObject, locked: set[int], least: float) -> set[int]:
    """Returns ``locked`` and the joints above groups of bodies whose share of the surface is below ``least``, smallest
    first.

    Stops when two parts are left.
    """
    locked = set(locked)
    above = {joint.child: index for index, joint in enumerate(obj.joints)}
    while parts(obj, locked).max() > 1:
        top = groups(obj, locked)
        share = np.bincount(top, obj.body_areas, minlength=obj.num_bodies) / obj.body_areas.sum()
        small = [body for body in np.unique(top) if body and 0 < share[body] < least]
        if not small:
            break
        locked.add(above[min(small, key=lambda body: share[body])])
    return locked


def lock_some(obj: ArticulatedObject, locked: set[int], most: int, rng: np.random.Generator) -> set[int]:
    """Returns ``locked`` and as many joints drawn at random as leave at most ``most`` parts."""
    locked = set(locked)
    free = [index for index in range(len(obj.joints)) if index not in locked]
    for index in rng.permutation(free):
        if parts(obj, locked).max() < most:
            break
        locked.add(int(index))
    return locked


def parts(obj: ArticulatedObject, locked: set[int]) -> np.ndarray:
    """Returns the part of every body, i64 (bodies); -1 where a rigid group has no surface.

    Part 0 is the group of the root (the first group with a surface when the root's has none); the others follow in
    the order of their topmost bodies.
    """
    top = groups(obj, locked)
    area = np.bincount(top, obj.body_areas, minlength=obj.num_bodies)
    solid = [body for body in np.unique(top) if area[body] > 0]
    number = {body: part for part, body in enumerate(solid)}
    return np.array([number.get(body, -1) for body in top])


def sampling_weights(obj: ArticulatedObject, part: np.ndarray, least: float) -> np.ndarray:
    """Returns the areas f64 (T), raised on small parts so that each gets the share ``least`` of the points. part i64
    (bodies).
    """
    part = part[obj.body_of_triangle]
    share = np.bincount(part, obj.areas) / obj.areas.sum()
    least = min(least, 0.5 / len(share))
    wanted = share
    while (wanted < least * (1 - 1e-9)).any():
        small = wanted <= least
        wanted = np.where(small, least, share * (1 - least * small.sum()) / share[~small].sum())
    return obj.areas * (wanted / share)[part]


def finite_limits(obj: ArticulatedObject) -> ArticulatedObject:
    """Gives slides without limits 0 to a quarter of the object's diameter, the other joints at their middles.

    A slide of a thousand diameters has none either; those of more than ten are noted. One that follows another joint has
    the range that this gives it.
    """
    _limit_slides(obj)
    for index, joint in enumerate(obj.joints):
        if joint.follows >= 0 and not np.isfinite([joint.lower, joint.upper]).all():
            lower, upper = sorted(_range(obj, joint))
            obj.joints[index] = replace(joint, lower=lower, upper=upper)
    return obj


def _limit_slides(obj: ArticulatedObject) -> None:
    """Gives limits to the slides without any that follow no other joint."""
    slides = [i for i, joint in enumerate(obj.joints) if joint.kind == "prismatic" and joint.follows < 0]
    if not slides or not len(obj.triangles):
        return
    diameter = 2 * _radius(obj, set(slides))
    lengths = {i: obj.joints[i].upper - obj.joints[i].lower for i in slides}
    endless = {i for i, length in lengths.items() if not length <= _ENDLESS * diameter}
    long = [i for i in slides if i not in endless and lengths[i] > _LONG * diameter]
    if long:
        obj.notes["slides ten times as long as their object (are the limits in millimeters?)"] += len(long)
    reach = _radius(obj, endless) / 2 if endless else 0.0
    for index in endless:
        obj.joints[index] = replace(obj.joints[index], lower=0.0, upper=reach)
        obj.notes["slides without limits (a quarter of the object's size taken)"] += 1


def _radius(obj: ArticulatedObject, closed: set[int]) -> float:
    """Returns the radius of the object's sphere with the joints ``closed`` at 0, the others at their middles."""
    middle = [0.0 if i in closed else (joint.lower + joint.upper) / 2 for i, joint in enumerate(obj.joints)]
    return obj.extent(obj.poses(obj.follow(np.array([middle])))[0])[1]


def require_surface(obj: ArticulatedObject) -> ArticulatedObject:
    """Returns the object when it has joints and a surface. Raises DataError otherwise."""
    if not obj.joints:
        raise DataError(nothing_moves(obj.name, obj.notes))
    if not len(obj.triangles):
        raise DataError(f"{obj.name}: none of its meshes has an area; expected a surface to sample")
    return obj


def nothing_moves(name: object, notes: Counter) -> str:
    """Returns what is said of an object without a joint that moves, with what is odd in it, such as joints taken as fixed."""
    odd = "".join(f"; {what}: {count}" for what, count in notes.items())
    return f"{name}: no movable joint (revolute, continuous or prismatic); nothing in it can move{odd}"
