"""The explanation of a sequence: bodies with one label per point and one trajectory each, and the energy they cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.segment.multibody.frames import Frames, Trajectory
from dpcli.segment.multibody.label_kernels import mean_field_kernel, support_kernel
from dpcli.segment.multibody.settings import MultibodySettings

_TEMPERATURES = np.geomspace(0.2, 0.03, 10)


@dataclass
class Body:
    """Holds a trajectory with the costs (N) and nearest points (N,P) of all points under it (`Frames.explain`).

    motions (F,P,3,4): from every frame to its partners.
    """

    trajectory: Trajectory
    motions: np.ndarray
    cost: np.ndarray
    nearest: np.ndarray


@dataclass
class Explanation:
    """Holds bodies, the largest first, labels i64 (N) and the energy, a cost per point.

    cost, field: f32 (N,K), of the points under every body with the price of displacement, and less what others support.
    """

    bodies: list[Body]
    label: np.ndarray
    energy: float
    cost: np.ndarray
    field: np.ndarray


def body_of(frames: Frames, trajectory: Trajectory) -> Body:
    """Returns the body that moves along a trajectory."""
    return Body(trajectory, frames.motions(trajectory), *frames.explain(trajectory))


def label_points(
    frames: Frames, bodies: list[Body], settings: MultibodySettings, start: np.ndarray | None = None
) -> Explanation:
    """Returns the explanation by these bodies; start: labels (N) to begin at, none: the least cost of each point.

    Labels come from mean field, from hot to cold.
    """
    alike, away = frames.compare(np.stack([body.motions for body in bodies]), settings.hinge)
    cost = np.stack([body.cost for body in bodies], 1) + np.float32(settings.displacement) * away
    nearest = np.stack([body.nearest for body in bodies])
    if start is None:
        start = (0.5 * cost + 0.5 * cost[frames.neighbors].mean(1)).argmin(1)
    share = np.full((len(cost), alike.shape[2]), np.float32(0.2 / len(bodies)))
    share[np.arange(len(cost)), start] += np.float32(0.8)
    weights = (settings.border, settings.agreement)
    mean_field_kernel(cost, frames.neighbors, nearest, alike, *weights, _TEMPERATURES, share)
    label = share[:, : len(bodies)].argmax(1)
    hard, support = np.zeros_like(share), np.empty((2, *cost.shape), np.float32)
    hard[np.arange(len(label)), label] = 1
    support_kernel(hard, frames.neighbors, nearest, alike, support)
    field = cost - settings.border * support[0] - settings.agreement * support[1]
    own = field[np.arange(len(label)), label].mean(dtype=np.float64) + sum(weights)
    return Explanation(bodies, label, float(own) + settings.body_price * len(bodies), cost, field)


def without_empty(frames: Frames, found: Explanation, settings: MultibodySettings) -> Explanation:
    """Returns the explanation with its bodies in order of size and without those that own no point."""
    sizes = np.bincount(found.label, minlength=len(found.bodies))
    order = [k for k in np.argsort(-sizes, kind="stable") if sizes[k]]
    if order == list(range(len(found.bodies))):
        return found
    place = np.full(len(sizes), -1)
    place[order] = np.arange(len(order))
    return label_points(frames, [found.bodies[k] for k in order], settings, place[found.label])


def refit(frames: Frames, found: Explanation, settings: MultibodySettings, own: bool, tight: float) -> Explanation:
    """Returns the explanation with every body's motions fitted to its points of all frames.

    own: onto the body's own points only, not onto whole frames. tight: last residual of the ICP, in spacings.
    """
    bodies = [
        body_of(frames, frames.fit(body.trajectory, found.label == k, own, tight))
        for k, body in enumerate(found.bodies)
    ]
    return label_points(frames, bodies, settings, found.label)
