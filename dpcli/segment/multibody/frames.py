"""The frames of a sequence prepared for joint search, and how well a body's motion through all of them explains points."""

from __future__ import annotations

import numpy as np

from dpcli.segment.flow.surface_icp import Surface, columns
from dpcli.segment.multibody.label_kernels import alike_kernel

_PARTNERS = 6  # other frames that a point is compared with, so that the cost stays linear in frames
POINT_SHARE = 0.15  # of point-to-point distance in a residual, besides point to plane
_OF_SPACING = 0.6  # residual that counts one half, in spacings of the points
_ONE_PLACE = 0.85  # spacings: how far apart two motions may take a point for it to be at their hinge
_FEWEST = 6  # points of a frame that can hold a motion

Trajectory = np.ndarray  # (F,3,4): takes a body from its own coordinates to every frame


class Frames:
    """Holds the surfaces of F frames, N points in all, and their neighbors inside a frame.

    `partners`: for each frame, the equally many frames that its points are compared with, the nearest in time first.
    """

    def __init__(self, clouds: list[np.ndarray]) -> None:
        self.surfaces = [Surface(cloud) for cloud in clouds]
        sizes = [len(cloud) for cloud in clouds]
        self.starts = np.concatenate([[0], np.cumsum(sizes)])
        self.points = np.concatenate([surface.points for surface in self.surfaces]).astype(np.float64)
        self.neighbors = np.concatenate([s.neighbors + start for s, start in zip(self.surfaces, self.starts)])
        self.partners = [choose_partners(t, len(clouds)) for t in range(len(clouds))]
        self.spacing = max(float(np.median([surface.spacing for surface in self.surfaces])), 1e-4)
        self.scales = [_OF_SPACING * max(surface.spacing, self.spacing) for surface in self.surfaces]

    def __len__(self) -> int:
        return len(self.surfaces)

    def slice(self, t: int) -> slice:
        """Returns where the points of frame t lie among all N."""
        return slice(int(self.starts[t]), int(self.starts[t + 1]))

    def explain(self, trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
        """Returns costs f32 (N), 0..1, of all points under one trajectory, and the nearest points i32 (N,partners).

        A cost is the mean over partner frames of Geman and McClure's d^2 / (d^2 + s^2), where d is the residual.
        """
        cost = np.zeros(len(self.points), np.float32)
        nearest = np.zeros((len(self.points), len(self.partners[0])), np.int32)
        for t, others in enumerate(self.partners):
            own = self.slice(t)
            for column, u in enumerate(others):
                motion = relative_motion(trajectory, t, u)
                squared, at = self.surfaces[u].match(self.surfaces[t].columns, motion, POINT_SHARE)
                scale = max(self.scales[t], self.scales[u])
                cost[own] += squared / (squared + scale**2)
                nearest[own, column] = at + self.starts[u]
            cost[own] /= len(others)
        return cost, nearest

    def displace(self, trajectory: Trajectory, reference: Trajectory) -> np.ndarray:
        """Returns how far (N), on average over partner frames, two trajectories take every point from each other."""
        gap = np.zeros(len(self.points), np.float32)
        for t, others in enumerate(self.partners):
            own = self.slice(t)
            for u in others:
                apart = relative_motion(trajectory, t, u) - relative_motion(reference, t, u)
                gap[own] += np.linalg.norm(move(apart, self.points[own]), axis=1)
            gap[own] /= len(others)
        return gap

    def compare(self, trajectories: list[Trajectory], hinge: float) -> np.ndarray:
        """Returns how nearly two of K trajectories take every point to one place, f32 (N,K,K), see `alike_kernel`."""
        alike = np.empty((len(self.points), len(trajectories), len(trajectories)), np.float32)
        for t, others in enumerate(self.partners):
            motions = np.stack([[relative_motion(one, t, u) for one in trajectories] for u in others])
            alike_kernel(self.points[self.slice(t)], motions, _ONE_PLACE * self.spacing, hinge, alike[self.slice(t)])
        return alike

    def fit(self, trajectory: Trajectory, inside: np.ndarray, own: bool, tight: float) -> Trajectory:
        """Returns a body's trajectory, frame after frame brought by ICP to where its points (mask (N)) of others agree.

        own: onto the body's own points only, not onto the whole frame. tight: last residual of the ICP, in spacings.
        """
        trajectory = trajectory.copy()
        points = [self.points[self.slice(t)][inside[self.slice(t)]] for t in range(len(self))]
        for u in range(len(self)):
            others = [move(relative_motion(trajectory, t, u), points[t]) for t in self.partners[u]]
            source = np.concatenate(others)
            if len(source) < _FEWEST or (own and len(points[u]) < 3 * _FEWEST):
                continue
            target = Surface(points[u]) if own else self.surfaces[u]
            step = target.icp(columns(source), np.eye(3, 4), 6, 2 * tight * self.spacing, tight * self.spacing)
            trajectory[u] = compose(step, trajectory[u])
        return trajectory


def choose_partners(t: int, frames: int) -> list[int]:
    """Returns the frames that frame t is compared with: the nearest, then those twice as far, and so on.

    >>> choose_partners(0, 4), choose_partners(10, 32)
    ([1, 2, 3], [9, 11, 8, 12, 6, 14])
    """
    wanted = min(_PARTNERS, frames - 1)
    others = sorted((u for u in range(frames) if u != t), key=lambda u: abs(u - t))
    sparse = [u for u in others if abs(u - t) & (abs(u - t) - 1) == 0]  # powers of two
    return [*sparse, *(u for u in others if u not in sparse)][:wanted]


def relative_motion(trajectory: Trajectory, t: int, u: int) -> np.ndarray:
    """Returns the motion (3,4) from frame t to frame u."""
    rotation = trajectory[u, :, :3] @ trajectory[t, :, :3].T
    return np.concatenate([rotation, (trajectory[u, :, 3] - rotation @ trajectory[t, :, 3])[:, None]], 1)


def compose(after: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Returns the motion (3,4) that makes `before` and then `after`."""
    shift = after[:, :3] @ before[:, 3] + after[:, 3]
    return np.concatenate([after[:, :3] @ before[:, :3], shift[:, None]], 1)


def move(motion: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Returns points (n,3) moved by a motion (3,4)."""
    return points @ motion[:, :3].T + motion[:, 3]
