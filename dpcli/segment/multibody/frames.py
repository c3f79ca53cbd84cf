"""The frames of a sequence prepared for joint search, and how well a body's motion through all of them explains points."""

from __future__ import annotations

from copy import copy

import numpy as np

from dpcli.segment.flow.surface_icp import Surface, columns
from dpcli.segment.multibody.label_kernels import alike_kernel, displacement_kernel, gain_kernel, row_length
from dpcli.segment.multibody.visibility import DepthMap
from dpcli.segment.rigid_motions import bring_to_rest, compose, motion_between, move

_PARTNERS = 6  # other frames that a point is compared with, so that the cost stays linear in frames
POINT_SHARE = 0.15  # of point-to-point distance in a residual, besides point to plane
_OF_SPACING = 0.6  # residual that counts one half, in spacings of the points
_ONE_PLACE = 0.85  # spacings: how far apart two motions may take a point for it to be at their hinge
_LEAST_GAIN = 0.02  # of a point: less than this is chance
_FEWEST = 6  # points of a frame that can hold a motion

Trajectory = np.ndarray  # (F,3,4): takes a body from its own coordinates to every frame


class Frames:
    """Holds the surfaces of F frames, N points in all, and their neighbors inside a frame.

    `partners`: for each frame, the equally many frames that its points are compared with, the nearest in time first.
    `depth_maps`: of every frame, where it is known which camera saw it.
    """

    depth_maps: list[DepthMap] | None = None

    def __init__(self, clouds: list[np.ndarray]) -> None:
        self.surfaces = [Surface(cloud) for cloud in clouds]
        sizes = [len(cloud) for cloud in clouds]
        self.starts = np.concatenate([[0], np.cumsum(sizes)])
        self.points = np.concatenate([surface.points for surface in self.surfaces]).astype(np.float64)
        self.neighbors = np.concatenate([s.neighbors + start for s, start in zip(self.surfaces, self.starts)])
        self.partners = np.array([choose_partners(t, len(clouds)) for t in range(len(clouds))])  # (F,P)
        self._columns = np.ascontiguousarray(self.points.T)
        self.spacing = max(float(np.median([surface.spacing for surface in self.surfaces])), 1e-4)
        self.scales = [_OF_SPACING * max(surface.spacing, self.spacing) for surface in self.surfaces]

    def __len__(self) -> int:
        return len(self.surfaces)

    def seen_by(self, camera: np.ndarray) -> Frames:
        """Returns the same frames, seen by one camera (3,4): points that it can't see need no match."""
        seen = copy(self)
        seen.depth_maps = [DepthMap.of(surface.points, camera, self.spacing) for surface in self.surfaces]
        return seen

    def apart(self, stride: int) -> Frames:
        """Returns the same frames, each compared with those that lie multiples of `stride` apart."""
        others = copy(self)
        others.partners = np.array([choose_partners(t, len(self), stride) for t in range(len(self))])
        return others

    def slice(self, t: int) -> slice:
        """Returns where the points of frame t lie among all N."""
        return slice(int(self.starts[t]), int(self.starts[t + 1]))

    def points_of(self, inside: np.ndarray) -> list[np.ndarray]:
        """Returns the points (n_t,3) of a mask (N) in each frame."""
        return [self.points[own][inside[own]] for own in map(self.slice, range(len(self)))]

    def motions(self, trajectory: Trajectory) -> np.ndarray:
        """Returns the motions (F,P,3,4) of a trajectory from every frame to its partners."""
        return motion_between(trajectory[:, None], trajectory[self.partners])

    def explain(self, trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
        """Returns costs f32 (N), 0..1, of all points under one trajectory, and the nearest points i32 (N,partners).

        A cost is the mean over partner frames of Geman and McClure's d^2 / (d^2 + s^2), where d is the residual. Points that a
        frame's camera could not see are judged as in `DepthMap.hide`.
        """
        cost = np.zeros(len(self.points), np.float32)
        nearest = np.zeros((len(self.points), self.partners.shape[1]), np.int32)
        for t, (others, motions) in enumerate(zip(self.partners, self.motions(trajectory))):
            own = self.slice(t)
            points, total = self.surfaces[t].columns, cost[own]
            for column, (u, motion) in enumerate(zip(others, motions)):
                scale, found = max(self.scales[t], self.scales[u]), nearest[own, column]
                pair = total if self.depth_maps is None else np.zeros_like(total)
                self.surfaces[u].explain(points, motion, POINT_SHARE, scale, self.starts[u], pair, found)
                if self.depth_maps is not None:
                    self.depth_maps[u].hide(points, motion, self.starts[t], pair, found)
                    total += pair
            cost[own] /= len(others)
        return cost, nearest

    def gain(self, current: np.ndarray, cost: np.ndarray, motions: np.ndarray, main: np.ndarray, price: float) -> float:
        """Returns what connected points would save, on average, by a body beside what they cost now.

        cost (N), motions (F,P,3,4): of the body. price: of a point's distance from where the motions `main` would take it.
        """
        away = np.empty(len(self.points), np.float32)
        displacement_kernel(self._columns, self.starts, motions, main, away)
        return gain_kernel(current, cost, away, price, self.neighbors, _LEAST_GAIN)

    def compare(self, motions: np.ndarray, hinge: float) -> tuple[np.ndarray, np.ndarray]:
        """Returns how nearly two of K bodies take every point to one place, f32 (N,K,row), see `alike_kernel`.

        And how far, on average over partner frames, each body and the first take it from each other, f32 (N,K). motions:
        (K,F,P,3,4).
        """
        count, bodies = len(self.points), len(motions)
        alike, away = np.zeros((count, bodies, row_length(bodies)), np.float32), np.empty((count, bodies), np.float32)
        alike_kernel(self._columns, self.starts, motions, _ONE_PLACE * self.spacing, hinge, alike, away)
        return alike, away

    def fit(self, trajectory: Trajectory, inside: np.ndarray, own: bool, tight: float) -> Trajectory:
        """Returns a body's trajectory, frame after frame brought by ICP to where its points (mask (N)) of others agree.

        own: onto the body's own points only, not onto the whole frame. tight: last residual of the ICP, in spacings.
        """
        trajectory = trajectory.copy()
        points = self.points_of(inside)
        at_rest = [bring_to_rest(cloud, motion) for cloud, motion in zip(points, trajectory)]
        for u in range(len(self)):
            source = move(trajectory[u], np.concatenate([at_rest[t] for t in self.partners[u]]))
            if len(source) < _FEWEST or (own and len(points[u]) < 3 * _FEWEST):
                continue
            target = Surface(points[u]) if own else self.surfaces[u]
            step = target.icp(columns(source), np.eye(3, 4), 6, 2 * tight * self.spacing, tight * self.spacing)
            trajectory[u] = compose(step, trajectory[u])
            at_rest[u] = bring_to_rest(points[u], trajectory[u])
        return trajectory


def choose_partners(t: int, frames: int, stride: int = 1) -> list[int]:
    """Returns the frames that frame t is compared with: the nearest, then those twice as far, and so on, in steps of `stride`.

    >>> choose_partners(0, 4), choose_partners(10, 32), choose_partners(10, 32, 4)
    ([1, 2, 3], [9, 11, 8, 12, 6, 14], [6, 14, 2, 18, 26, 22])
    """
    wanted = min(_PARTNERS, (frames - 1) // stride)
    others = sorted((u for u in range(t % stride, frames, stride) if u != t), key=lambda u: abs(u - t))
    steps = {u: abs(u - t) // stride for u in others}
    sparse = [u for u in others if steps[u] & (steps[u] - 1) == 0]  # powers of two
    return [*sparse, *(u for u in others if u not in sparse)][:wanted]


def relative_motion(trajectory: Trajectory, t: int, u: int) -> np.ndarray:
    """Returns the motion (3,4) from frame t to frame u."""
    return motion_between(trajectory[t], trajectory[u])
