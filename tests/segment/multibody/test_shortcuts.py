"""What makes the search quick gives what the plain formulas give: kernels, points at rest, and clouds prepared once."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.segment.flow.motion_proposals import ANGLES, SHIFTS, SPINS, propose_motions, turn_about
from dpcli.segment.flow.rigid_bodies import BodySearch, find_bodies, find_surface_bodies
from dpcli.segment.flow.surface_icp import Surface, columns
from dpcli.segment.multibody.explanation import body_of, label_points
from dpcli.segment.multibody.frames import POINT_SHARE, Frames, relative_motion
from dpcli.segment.multibody.label_kernels import alike_kernel, mean_field_kernel, row_length, support_kernel
from dpcli.segment.multibody.settings import MultibodySettings
from dpcli.segment.rigid_motions import compose, move


def some_frames(frames: int = 3, points: int = 60, seed: int = 0) -> Frames:
    """Frames of points on a wavy sheet; one has fewer."""
    rng, clouds = np.random.default_rng(seed), []
    for t in range(frames):
        x, y = rng.random((2, points - 7 * (t == 1)))
        clouds.append(np.float32(np.stack([x, y, 0.2 * np.sin(5 * x)], 1)))
    return Frames(clouds)


def some_trajectory(frames: int, seed: int) -> np.ndarray:
    """A trajectory that turns and shifts by a little in every frame."""
    rng = np.random.default_rng(seed)
    turns = turn_about(np.tile([[0.6, 0.0, 0.8]], (frames, 1)), rng.normal(0, 0.2, frames), rng.random((frames, 3)))
    turns[:, :, 3] += rng.normal(0, 0.05, (frames, 3))
    return turns


def distance(frames: Frames, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """How far two trajectories take every point from each other, point by point."""
    gap = []
    for t, partners in enumerate(frames.partners):
        places = [
            [move(relative_motion(m, t, u), frames.points[frames.slice(t)]) for m in (one, other)] for u in partners
        ]
        gap.append(np.mean([np.linalg.norm(a - b, axis=1) for a, b in places], 0))
    return np.concatenate(gap)


@pytest.mark.parametrize("bodies", [1, 3, 8, 11])
def test_kernels_of_labels_are_their_formulas(bodies: int) -> None:
    frames, rng = some_frames(), np.random.default_rng(bodies)
    trajectories, count = [some_trajectory(3, k) for k in range(bodies)], len(frames.points)
    motions = np.stack([frames.motions(one) for one in trajectories])
    alike, away = frames.compare(motions, 0.7)
    gap = np.stack([[distance(frames, a, b) for a in trajectories] for b in trajectories]).transpose(2, 0, 1)
    wanted = np.where(np.eye(bodies), 1, 0.7 * np.exp(-((gap / (0.85 * frames.spacing)) ** 2)))
    assert np.allclose(alike[:, :, :bodies], wanted, atol=1e-6) and not alike[:, :, bodies:].any()
    assert np.allclose(away, gap[:, :, 0], atol=1e-6)
    assert bodies == 1 or np.ptp(wanted[:, 0, 1:]) > 0.01  # neither all nor nothing

    share = np.zeros((count, row_length(bodies)), np.float32)
    share[:, :bodies] = rng.dirichlet(np.ones(bodies), count)
    nearest, out = np.int32(rng.integers(0, count, (bodies, count, 2))), np.empty((2, count, bodies), np.float32)
    support_kernel(share, frames.neighbors, nearest, alike, out)
    counted = np.einsum("nl,nkl->nk", share[:, :bodies], wanted)
    across = np.stack([counted[nearest[k], k].mean(1) for k in range(bodies)], 1)
    assert np.allclose(out, [counted[frames.neighbors].mean(1), across], atol=1e-6)
    cost = np.float32(rng.random((count, bodies)))
    likely = np.exp(-(cost - 0.3 * out[0] - 0.2 * out[1]) / 0.1)
    after = 0.5 * share[:, :bodies] + 0.5 * likely / likely.sum(1, keepdims=True)
    mean_field_kernel(cost, frames.neighbors, nearest, alike, 0.3, 0.2, np.array([0.1]), share)
    assert np.allclose(share[:, :bodies], after, atol=1e-5) and not share[:, bodies:].any()


def test_two_bodies_far_apart_are_not_alike_at_all() -> None:
    motions, alike, away = np.tile(np.eye(3, 4), (2, 1, 1, 1, 1)), np.zeros((5, 2, 8), np.float32), np.empty((5, 2))
    motions[1, ..., 3] += 1.0
    alike_kernel(np.zeros((3, 5)), np.array([0, 5]), motions, 0.1, 0.7, alike, np.float32(away))
    assert (alike[:, :, :2] == np.eye(2)).all()


def test_motions_costs_and_gains_are_those_of_every_pair_of_frames() -> None:
    frames, one, main = some_frames(), some_trajectory(3, 1), some_trajectory(3, 2)
    motions = frames.motions(one)
    cost, nearest = frames.explain(one)
    for t, partners in enumerate(frames.partners):
        own, total = frames.slice(t), 0.0
        for p, u in enumerate(partners):
            assert np.allclose(motions[t, p], relative_motion(one, t, u), atol=1e-12)
            target, source = frames.surfaces[u], frames.surfaces[t].columns
            squared = target.residuals(source, motions[t, p], POINT_SHARE)
            total += squared / (squared + max(frames.scales[t], frames.scales[u]) ** 2) / len(partners)
            tried = target.points[nearest[own, p] - frames.starts[u]] - move(motions[t, p], frames.points[own])
            assert (np.linalg.norm(tried, axis=1) ** 2 * POINT_SHARE <= squared + 1e-6).all()
        assert np.allclose(cost[own], total, atol=1e-6)
    current = np.random.default_rng(3).random(len(cost)).astype(np.float32)
    less = current - cost - 0.05 * distance(frames, one, main)
    wanted = np.maximum(0.5 * less + 0.5 * less[frames.neighbors].mean(1) - 0.02, 0).mean()
    assert (
        frames.gain(current, cost, motions, frames.motions(main), 0.05) == pytest.approx(wanted, rel=1e-5)
        and wanted > 0
    )


@pytest.mark.parametrize("own", [False, True])
def test_a_fit_brings_each_frame_to_where_its_points_in_the_others_are_taken(own: bool) -> None:
    frames, inside = some_frames(), np.random.default_rng(4).random(173) < 0.6
    wanted = some_trajectory(3, 5)
    found = frames.fit(wanted, inside, own, 0.7)
    points = [frames.points[frames.slice(t)][inside[frames.slice(t)]] for t in range(3)]
    before = wanted.copy()
    for u in range(3):
        source = np.concatenate([move(relative_motion(wanted, t, u), points[t]) for t in frames.partners[u]])
        target = Surface(points[u]) if own else frames.surfaces[u]
        step = target.icp(columns(source), np.eye(3, 4), 6, 1.4 * frames.spacing, 0.7 * frames.spacing)
        wanted[u] = compose(step, wanted[u])
    assert np.allclose(found, wanted, atol=1e-6) and np.abs(found - before).max() > 0.01


def test_labels_start_where_they_are_told_to() -> None:
    frames = some_frames()
    bodies = [body_of(frames, some_trajectory(3, seed)) for seed in (6, 7)]
    free = label_points(frames, bodies, MultibodySettings())
    around = 0.5 * free.cost + 0.5 * free.cost[frames.neighbors].mean(1)
    told = label_points(frames, bodies, MultibodySettings(), around.argmin(1))
    assert (told.label == free.label).all() and told.energy == free.energy


def test_prepared_clouds_serve_many_searches() -> None:
    clouds = [frames.points for frames in some_frames(3, 120).surfaces]
    surfaces, search = [Surface(cloud) for cloud in clouds], BodySearch(second_looks=0)
    for t, u in ((0, 1), (1, 0), (0, 2), (0, 1)):
        one, other = find_bodies(clouds[t], clouds[u], search), find_surface_bodies(surfaces[t], surfaces[u], search)
        assert (one.label == other.label).all() and (one.motion == other.motion).all() and one.energy == other.energy


def test_proposed_motions_are_turns_about_edges_spins_and_shifts() -> None:
    points = np.random.default_rng(8).random((50, 3)) * [0.6, 0.3, 0.05]
    lonely, center = np.array([[1.0, 2.0, 3.0]]), points.mean(0)
    axes = np.linalg.eigh(np.cov(points.T))[1].T[::-1]
    extent = np.abs((points - center) @ axes.T).max(0)
    wanted = [
        turn_about(axes[[hinge]], np.array([angle]), center + side * extent[across] * axes[across])[0]
        for side in (-1, 1)
        for hinge, across in ((0, 1), (1, 0), (0, 2), (1, 2))
        for angle in ANGLES
    ]
    wanted += [turn_about(axes[[2]], np.array([angle]), center)[0] for angle in SPINS]
    shifts = [np.zeros(3), *(axis * by for by in SHIFTS for axis in axes), lonely[0] - center]
    wanted += [np.concatenate([np.eye(3), shift[:, None]], 1) for shift in shifts]
    assert np.allclose(propose_motions(points, lonely), wanted, atol=1e-12)
