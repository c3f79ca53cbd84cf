"""The surface of a Gaussian scene against true surface points, frame by frame: Chamfer distance and F-score."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import Interval, Resampling, means_of_samples
from dpcli.evaluate.proportions import divide
from dpcli.evaluate.video.sources.stored import draw_scene
from dpcli.ops.cameras import orbit_pose, pinhole
from dpcli.runtime.progress import Progress
from dpcli.runtime.seeds import generator
from dpcli.store.gaussians import GaussianScene

SHARES = (0.01, 0.02)  # of the diameter: distances within which a point counts as found
SIDE, CAMERAS, MOST_POINTS = 96, 14, 8192  # pixels; six sides and eight corners of a cube; points of a frame at most
_FOVY, _MARGIN = np.deg2rad(30.0), 1.4  # the cameras' view, and how far beyond the points it reaches


@dataclass(frozen=True)
class SurfaceScore:
    """Holds the surface's errors in each of T frames, f64 (T), NaN where the scene shows nothing.

    chamfer: mean of both directions' mean distance, in the truth's length unit. f_score (T,2): harmonic mean of the
    shares of scene points and of true points that lie within SHARES of the diameter of one another; 0 where the scene
    shows nothing. points: true ones, in each frame. unseen: frames in which the scene shows nothing.
    """

    chamfer: np.ndarray
    f_score: np.ndarray
    diameter: float
    points: int
    unseen: int

    def values(self) -> dict[str, np.ndarray]:
        """Returns the values of each frame, f64 (T), by the name that a report gives them."""
        named = {f"f_score_{100 * share:g}": self.f_score[:, index] for index, share in enumerate(SHARES)}
        return {"chamfer": self.chamfer, "chamfer_of_diameter": divide(self.chamfer, self.diameter), **named}

    def intervals(self, resampling: Resampling) -> dict[str, Interval]:
        """Returns intervals of the means over frames, frames being resampled."""
        return resampling.intervals(means_of_samples(self.values()), len(self.chamfer))


def surface_score(scene: GaussianScene, track: np.ndarray, times: np.ndarray, *, seed: int = 0) -> SurfaceScore:
    """Compares what is visible of a scene with true surface points f (T,M,3) at `times`, seconds (T).

    diameter: diagonal of the points' bounding box in the first frame. seed: of the choice among a frame's visible points.
    Raises DataError without points.
    """
    if track.shape[1] == 0:
        raise DataError("surface: the truth has no surface points")
    truth, rng = track.astype(np.float64), generator(seed)
    diameter = float(np.linalg.norm(np.ptp(truth[0], axis=0)))
    chamfer, scores, unseen = np.full(len(times), np.nan), np.zeros((len(times), len(SHARES))), 0
    with Progress("surface", len(times), "frame") as progress:
        for frame, time in enumerate(times):
            points = visible_points(scene, float(time), truth[frame])
            if len(points):
                points = points[rng.permutation(len(points))[:MOST_POINTS]]
                chamfer[frame], scores[frame] = point_errors(points, truth[frame], diameter)
            unseen += not len(points)
            progress.advance()
    return SurfaceScore(chamfer, scores, diameter, track.shape[1], unseen)


def point_errors(points: np.ndarray, truth: np.ndarray, diameter: float) -> tuple[float, np.ndarray]:
    """Returns the Chamfer distance of two sets of points f (N,3), (M,3), and their F-scores f64 (2) at SHARES of the diameter.

    >>> point_errors(np.zeros((1, 3)), np.array([[0.0, 0, 0], [0, 0, 1.0]]), 10.0)
    (0.25, array([0.66666667, 0.66666667]))
    """
    from scipy.spatial import cKDTree

    there = cKDTree(truth).query(points)[0]
    back = cKDTree(points).query(truth)[0]
    reach = diameter * np.array(SHARES)[:, None]
    precision, recall = (there <= reach).mean(1), (back <= reach).mean(1)
    both = divide(2 * precision * recall, precision + recall)
    return float(there.mean() + back.mean()) / 2, np.nan_to_num(both)


def visible_points(scene: GaussianScene, time: float, around: np.ndarray) -> np.ndarray:  # [N, 3]
    """Returns points f64 where CAMERAS cameras about the points `around` (M,3) see the scene: alpha at least one half.

    The depth of a pixel is the mean of the Gaussians that make it, weighted as their colors are.
    """
    middle = (around.min(0) + around.max(0)) / 2
    poses, lens = _cameras(middle, np.linalg.norm(around - middle, axis=1).max())
    lenses = np.tile(lens, (len(poses), 1, 1))
    depth, alpha = draw_scene(scene, time, poses, lenses, (SIDE, SIDE), "ED")
    return _unproject(depth[..., 0].astype(np.float64), alpha[..., 0] >= 0.5, poses, lens)


def _cameras(middle: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns poses f64 (14,4,4) that look at `middle` from the sides and corners of a cube, and their lens (3,3)."""
    corner = np.arcsin(1 / np.sqrt(3))
    angles = [(a * np.pi / 2, 0.0) for a in range(4)] + [(0.0, np.pi / 2), (0.0, -np.pi / 2)]
    angles += [(a * np.pi / 2 + np.pi / 4, sign * corner) for a in range(4) for sign in (1, -1)]
    distance = _MARGIN * max(radius, 1e-9) / np.sin(_FOVY / 2)
    poses = np.stack([orbit_pose(azimuth, elevation, distance) for azimuth, elevation in angles])
    poses[:, :3, 3] -= poses[:, :3, :3] @ middle
    return poses, pinhole(_FOVY, SIDE, SIDE)


def _unproject(depth: np.ndarray, chosen: np.ndarray, poses: np.ndarray, lens: np.ndarray) -> np.ndarray:
    """Returns the world points f64 (N,3) of the chosen pixels of depth pictures (C,H,W)."""
    camera, row, column = np.nonzero(chosen)
    pixel = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], 1)
    points = pixel @ np.linalg.inv(lens).T * depth[camera, row, column, None]
    return np.einsum("nji,nj->ni", poses[camera, :3, :3], points - poses[camera, :3, 3])
