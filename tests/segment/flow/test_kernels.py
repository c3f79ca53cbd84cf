"""The CPU kernels of segment against the formulas they stand for."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dpcli.segment.flow import icp_kernels, motion_proposals
from dpcli.segment.flow.object_aware_icp import soft_match, soft_match_reference
from dpcli.segment.flow.rigid_bodies import BodySearch, _BodyFinder
from dpcli.segment.flow.surface_icp import Surface, columns
from dpcli.segment.network.se3_conv import _activate, instance_norm
from tests.support.ops_helpers import backend
from tests.support.prepare_helpers import ROOT


def sphere(count: int, seed: int) -> np.ndarray:
    """Points f32 (count,3) on a sphere of diameter 1."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return np.float32(points / np.linalg.norm(points, axis=1, keepdims=True) / 2)


def test_soft_match_is_the_softmax() -> None:
    rng = torch.Generator().manual_seed(0)
    moved, points = (torch.from_numpy(np.stack([sphere(n, s) for s in (a, a + 1)])) for n, a in ((70, 0), (300, 5)))
    bias = torch.rand(2, 70, 300, generator=rng).log()
    bias[:, :, ::3] = -torch.inf
    found = soft_match(moved, points, bias, 0.01)
    exact = soft_match_reference(moved.double(), points.double(), bias.double(), 0.01)
    torch.testing.assert_close(found, exact.float(), atol=2e-6, rtol=0)
    assert (soft_match(moved, points, bias, 0.02) - exact).abs().max() > 1e-3
    assert (soft_match(moved, points, torch.zeros_like(bias), 0.01) - exact).abs().max() > 1e-3


def test_soft_match_far_away_and_in_float64() -> None:
    """A point far from everything still gets the nearest one; float64 goes through torch."""
    points = torch.from_numpy(sphere(64, 1))[None]
    far = torch.tensor([[[1e4, 0.0, 0.0]]])
    found = soft_match(far, points, torch.zeros(1, 1, 64), 1e-3)
    assert found.isfinite().all() and found.abs().max() <= 0.5
    assert soft_match(far.double(), points.double(), torch.zeros(1, 1, 64).double(), 1e-3).dtype == torch.float64


@pytest.mark.parametrize("count", [1, 3, 7, 8, 9, 16, 21])
def test_soft_match_of_any_number_of_points(count: int) -> None:
    """What fills the kernel's last eight counts for nothing, though it lies nearest."""
    points = torch.from_numpy(sphere(count, 6))[None]
    moved = torch.cat([points * 1.1, torch.zeros(1, 1, 3)], 1)
    bias = torch.full((1, count + 1, count), -0.5)
    exact = soft_match_reference(moved.double(), points.double(), bias.double(), 0.3)
    torch.testing.assert_close(soft_match(moved, points, bias, 0.3).double(), exact, atol=1e-6, rtol=0)
    padded = torch.cat([points, torch.zeros(1, 1, 3)], 1)  # the broken twin: one zero point counts
    wrong = soft_match_reference(moved, padded, torch.full((1, count + 1, count + 1), -0.5), 0.3)
    assert (wrong - exact).abs().max() > 1e-3


@pytest.mark.parametrize("shape", [(2, 3, 5, 16), (1, 40, 60, 32), (3, 1, 1, 16), (2, 7, 12, 24)])
def test_norm_and_activation_are_the_formulas(shape: tuple[int, ...]) -> None:
    """Also far from zero, for a constant, and for channels that the kernel doesn't take (24)."""
    features = torch.randn(shape, generator=torch.Generator().manual_seed(0)) * 2 + 50
    features[..., 3] = 7.0
    exact = torch.nn.functional.leaky_relu(instance_norm(features.double()), 0.01)
    with backend("numba"):
        found = _activate(features.clone())
    torch.testing.assert_close(found.double(), exact, atol=3e-5, rtol=1e-5)
    assert not found[..., 3].any()
    leaf = features.clone().requires_grad_()
    assert _activate(leaf).requires_grad and torch.equal(leaf, features)


def test_lloyd_is_k_means_written_out() -> None:
    points, center = sphere(90, 7), sphere(5, 8).astype(np.float64)
    center[4] = 100.0  # owns no point and stays
    ours, patch = center.copy(), np.empty(90, np.int64)
    icp_kernels.lloyd_kernel(points, ours, 4, patch)
    for _ in range(4):
        own = ((points[:, None] - center) ** 2).sum(2).argmin(1)
        for k in np.unique(own):
            center[k] = points[own == k].mean(0)
    assert np.array_equal(patch, own) and np.allclose(ours, center, atol=1e-7, rtol=0) and (ours[4] == 100).all()


@pytest.mark.parametrize("most", [1, 3, 50])
def test_distinct_motions_are_apart_and_the_best(most: int) -> None:
    rng = np.random.default_rng(9)
    motions = motion_proposals.shift_by(rng.integers(0, 3, (40, 3)) * 0.1)
    score, points = rng.permutation(40).astype(float), sphere(30, 1).astype(np.float64)
    chosen: list[int] = []
    for h in np.argsort(score):  # shifts move all points alike
        if all(np.abs(motions[h, :, 3] - motions[c, :, 3]).max() > 0.05 for c in chosen):
            chosen.append(int(h))
    assert 3 < len(chosen) < 40
    assert motion_proposals.choose_distinct(motions, score, points, 0.05, most) == chosen[:most]


@pytest.mark.parametrize("count", [1, 9, 127, 128, 129, 256, 512, 700])
def test_nearest_point_is_the_first_of_the_nearest(count: int) -> None:
    rng = np.random.default_rng(count)
    cloud = np.ascontiguousarray(rng.integers(0, 4, (3, count)).astype(np.float32))  # full of ties
    squared = np.empty(count, np.float32)
    for x, y, z in rng.integers(0, 4, (60, 3)).astype(np.float32):
        distance = ((cloud - np.array([[x], [y], [z]])) ** 2).sum(0)
        at, found = icp_kernels.nearest_point(x, y, z, cloud, squared, squared.view(np.int32))
        assert (at, found) == (distance.argmin(), distance.min())


def test_look_up_takes_the_nearest_of_the_neighbors_tried() -> None:
    """Each point's match, tried alone or among others, is the nearest neighbor of its cell's point."""
    surface = Surface(sphere(200, 2))
    search = surface._search
    points = np.ascontiguousarray(sphere(80, 3).T * np.float32(1.05))
    at, far = np.empty(80, np.int64), np.empty(80, np.float32)
    work = np.empty(16 * 200, np.float32)
    icp_kernels._look_up(points, search, work, work.view(np.int32), at, far)
    grid, origin, rate = search[4:]
    cell = ((points.T - origin) * rate).astype(int)
    center = origin + (cell + 0.5) / rate
    start = ((center[:, None] - surface.points) ** 2).sum(2).argmin(1)
    tried = ((surface.points[search[2][start]] - points.T[:, None]) ** 2).sum(2)
    assert (at == search[2][start, tried.argmin(1)]).mean() > 0.97  # a cell's center may lie half-way
    np.testing.assert_allclose(far, ((surface.points[at] - points.T) ** 2).sum(1), rtol=1e-5, atol=1e-9)


def slow_energy(search: _BodyFinder, label: np.ndarray, motion: np.ndarray, cost: np.ndarray) -> float:
    """The energy of `bodies`, term by term."""
    options, source = search.options, search.source
    place = [motion[k, :, :3] @ p + motion[k, :, 3] for k, p in zip(label, search.points)]
    normals = np.stack([motion[k, :, :3] @ n for k, n in zip(label, source.normals)])
    seen = search.target.covered_by(np.stack(place), normals, options.share)
    torn = away = 0.0
    for i, p in enumerate(search.points):
        away += np.linalg.norm(motion[0, :, :3] @ p + motion[0, :, 3] - place[i])
        for other in label[source.neighbors[i]]:
            if other != label[i]:
                gap = np.linalg.norm(motion[other, :, :3] @ p + motion[other, :, 3] - place[i])
                torn += 1 - options.tear + options.tear * min(gap / 0.15, 1)
    count = len(label)
    own = cost[label, np.arange(count)].mean() + (seen / (seen + search.scale**2)).mean()
    return own + 0.5 * options.border * torn / source.neighbors.size + options.far * away / count


def test_energy_is_the_sum_of_its_terms() -> None:
    rng = np.random.default_rng(4)
    search = _BodyFinder(Surface(sphere(90, 5)), Surface(sphere(130, 6)), BodySearch())
    label = rng.integers(0, 3, 90)
    motion = np.eye(3, 4)[None] + rng.normal(0, 0.1, (3, 3, 4))
    cost = rng.random((3, 90))
    found = search._with_energy(label, motion, cost).energy
    assert found == pytest.approx(slow_energy(search, label, motion, cost), rel=1e-6)
    assert found != pytest.approx(slow_energy(search, label, motion[[1, 0, 2]], cost), rel=1e-3)


def test_a_linearized_step_is_the_step_that_icp_makes():
    points = np.float32(np.random.default_rng(5).random((120, 3)) * [1, 0.6, 0.2])
    surface, start = Surface(points), np.eye(3, 4)
    start[:, 3] = 0.01
    matrix, vector, center = surface.linearize(columns(points[:50]), start, 0.05)
    assert np.array_equal(matrix, matrix.T) and np.allclose(center, points[:50].mean(0) + 0.01, atol=1e-6)
    step = np.linalg.solve(matrix, vector)
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    moved = np.concatenate([turn @ start[:, :3], (turn @ (start[:, 3] - center) + center + step[3:])[:, None]], 1)
    assert np.allclose(surface.icp(columns(points[:50]), start, 1, 0.05, 0.05), moved, atol=1e-5)


TWICE = """
import hashlib
import numpy as np
from dpcli.segment.flow.surface_icp import Surface, columns

rng = np.random.default_rng(0)
for k in range(10):
    cloud = (rng.normal(size=(rng.integers(40, 200), 3)) * 0.2).astype(np.float32)
    surface, source = Surface(cloud), columns(cloud[::2])
    motions = np.eye(4)[:3] + rng.normal(size=(8, 3, 4)) * 0.02
    told = [surface.icp(source, motions[0], 8, 0.05, 0.02), *surface.icp_many(source, motions, 6, 0.05, 0.02, 0.3, 0.02)]
    told += [*surface.linearize(source, motions[0], 0.05), surface.residuals(source, motions[0], 0.3)]
    print(*(hashlib.sha256(one.tobytes()).hexdigest() for one in told))
"""


def test_the_process_that_compiles_computes_the_bits_of_those_that_find_the_code(tmp_path):
    """What a first run after an installation writes is what any later run writes."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(tmp_path)}
    first, second = (
        subprocess.run([sys.executable, "-c", TWICE], env=environment, capture_output=True, text=True) for _ in range(2)
    )
    assert "compiling" in first.stderr and not second.stderr, (first.stderr, second.stderr)
    assert len(first.stdout.split()) == 70 and first.stdout == second.stdout
