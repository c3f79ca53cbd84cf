"""Finds where the one camera stood that saw all frames of a sequence, if one did."""

from __future__ import annotations

import numpy as np

from dpcli.segment.flow.surface_icp import columns
from dpcli.segment.multibody.explanation import Explanation
from dpcli.segment.multibody.frames import POINT_SHARE, Frames
from dpcli.segment.multibody.visibility import DepthMap
from dpcli.segment.rigid_motions import move
from dpcli.segment.thinning import spread_places

_DIRECTIONS = 100  # tried, some 20 degrees apart
_DISTANCES = (2.0, 1.5, 3.0, 6.0)  # diameters from the middle of all points
_FINER = (0.18, 0.09, 0.05)  # radians around the best direction
_RECORDED = (0.6, 100.0)  # diameters from the middle, between which the file's origin may be the camera
_FRAMES = 4  # whose depth maps are drawn
_POINTS = 1000  # badly explained points that are looked up in each of them
_BAD = 0.5  # cost from which on a point is badly explained
_ONE_SURFACE = 3.0  # spacings that depths in one place differ at most, unless one surface lies behind another
_OPEN, _BEHIND = 0.5, 8.0  # weights of what is badly explained in plain sight, and of points behind others
_MOST_BEHIND = 0.15  # share of points behind others: at outlines only. A cloud of all sides has 0.2 and more
_LEAST_HIDDEN = 0.15  # share of what is badly explained that is to be hidden


def find_camera(frames: Frames, found: Explanation, origin: np.ndarray) -> np.ndarray | None:
    """Returns the camera (3,4) that saw all frames, from the frames' coordinates to right, down and ahead; None: none did.

    A camera sees no surface behind another, and what `found`, made without knowing it, explains badly has turned out of its
    sight. origin (3): of the file's coordinates, the place of the camera in clouds of a depth camera.
    """
    sight = _Sight(frames, found)
    recorded = origin - sight.middle
    if _RECORDED[0] < np.linalg.norm(recorded) < _RECORDED[1] and sight.accepts(recorded):
        return sight.camera(recorded)
    best = max(_DISTANCES[0] * _sphere(_DIRECTIONS), key=sight.score)
    if sight.shares(best)[1] < _LEAST_HIDDEN / 2:
        return None
    for angle in _FINER:
        best = max([best, *_around(best, angle)], key=sight.score)
    best = max([best * (distance / _DISTANCES[0]) for distance in _DISTANCES], key=sight.score)
    return sight.camera(best) if sight.accepts(best) else None


class _Sight:
    """Tells what a camera would see that stood at a place (3), given from the middle of all points and looking there."""

    def __init__(self, frames: Frames, found: Explanation) -> None:
        self.middle, self.spacing = frames.points.mean(0), frames.spacing
        shown = spread_places(len(frames), _FRAMES)
        self.clouds = [frames.points[frames.slice(u)] for u in shown]
        self.bad = [_badly_explained(frames, found, u) for u in shown]
        self.weight = max(sum(float(weight.sum()) for _, weight in self.bad), 1e-9)

    def camera(self, place: np.ndarray) -> np.ndarray:
        ahead = -place / max(float(np.linalg.norm(place)), 1e-9)
        right = np.cross(np.eye(3)[np.abs(ahead).argmin()], ahead)
        right /= max(float(np.linalg.norm(right)), 1e-9)
        axes = np.stack([right, np.cross(ahead, right), ahead])
        return np.concatenate([axes, -axes @ (self.middle + place)[:, None]], 1)

    def accepts(self, place: np.ndarray) -> bool:
        """Returns whether a camera there sees few points behind others, and hides enough of what is badly explained."""
        behind, hidden, _ = self.shares(place)
        return behind <= _MOST_BEHIND and hidden >= _LEAST_HIDDEN

    def score(self, place: np.ndarray) -> float:
        behind, hidden, open_ = self.shares(place)
        return hidden - _OPEN * open_ - _BEHIND * behind

    def shares(self, place: np.ndarray) -> tuple[float, float, float]:
        """Returns the share of points behind others, and of what is badly explained the shares hidden and in plain sight."""
        camera, behind, hidden, open_ = self.camera(place), [], 0.0, 0.0
        for cloud, (points, weight) in zip(self.clouds, self.bad):
            seen = DepthMap.of(cloud, camera, self.spacing)
            depth, _, near = seen.look(cloud)
            behind.append((depth > near + _ONE_SURFACE * self.spacing).mean())
            depth, far, near = seen.look(points)
            hidden += float(weight[np.isfinite(far) & (depth > far + seen.margin)].sum())
            open_ += float(weight[np.isinf(far) | (np.isfinite(near) & (depth < near - seen.margin))].sum())
        return float(np.mean(behind)), hidden / self.weight, open_ / self.weight


def _badly_explained(frames: Frames, found: Explanation, u: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns where other frames' points (n,3) would be in frame u that match nothing there, and by how much (n)."""
    moved, cost = [np.zeros((0, 3))], [np.zeros(0)]
    for t, column in np.argwhere(frames.partners == u):
        own = frames.slice(t)
        for k, body in enumerate(found.bodies):
            points = frames.points[own][found.label[own] == k]
            if len(points):
                motion, scale = body.motions[t, column], max(frames.scales[t], frames.scales[u])
                squared = frames.surfaces[u].residuals(columns(points), motion, POINT_SHARE)
                badly = squared / (squared + scale**2) - _BAD
                moved.append(move(motion, points[badly > 0]))
                cost.append(badly[badly > 0])
    moved, cost = np.concatenate(moved), np.concatenate(cost)
    some = spread_places(len(moved), _POINTS)
    return moved[some], cost[some]


def _sphere(count: int) -> np.ndarray:
    """Returns directions (count,3), evenly spread along a spiral."""
    height = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    flat = np.sqrt(1 - height**2)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), height], 1)


def _around(place: np.ndarray, angle: float) -> list[np.ndarray]:
    """Returns eight places as far away in directions that differ by an angle."""
    one = np.cross(place, np.eye(3)[np.abs(place).argmin()])
    other = np.cross(place, one) / np.linalg.norm(place)
    size = np.linalg.norm(place) / np.linalg.norm(one) * np.tan(angle)
    turns = np.arange(8) * np.pi / 4
    moved = [place + size * (np.cos(turn) * one + np.sin(turn) * other) for turn in turns]
    return [new * (np.linalg.norm(place) / np.linalg.norm(new)) for new in moved]
