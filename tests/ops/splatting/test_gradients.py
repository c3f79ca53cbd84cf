"""The rasterizer's gradients by finite differences, its determinism, and that the checker sees what is broken."""

from __future__ import annotations

import numba
import numpy as np
import pytest
import torch

from dpcli.ops.cpu.jit import arithmetic_kernel, parallel_kernel
from dpcli.ops.cpu.simd import higher, lanes, load, lower, power_of_two, ramp, reciprocal, store, total, where_lower
from dpcli.ops.splatting.cpu_simd import constants, power, totals
from dpcli.ops.splatting.cpu_tile_lists import PACKED, TALL, WIDE, tile_lists
from dpcli.ops.splatting.rasterization import rasterization, rasterization_reference
from tests.support.splatting_helpers import assert_renders, cameras, render, scene


@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
def test_reference_by_finite_differences(mode: str) -> None:
    """Of every input, cameras and backgrounds included: what the kernel is compared with is right itself."""
    means, quats, scales, opacities, _ = scene(4, seed=3, scale=0.3)
    (views, lenses), colors = cameras(1, 4, 3), torch.rand(4, 4, 3, dtype=torch.float64)
    background = torch.rand(1, 3, dtype=torch.float64)

    def function(means, quats, scales, opacities, colors, views, background):
        out = rasterization_reference(
            means,
            quats,
            scales,
            opacities,
            colors,
            views,
            lenses,
            4,
            3,
            sh_degree=1,
            backgrounds=background,
            render_mode=mode,
        )
        return out[0], out[1]

    inputs = [t.requires_grad_() for t in (means, quats, scales, opacities, colors, views, background)]
    assert torch.autograd.gradcheck(function, inputs, atol=1e-5, fast_mode=mode == "RGB")


def test_kernel_by_finite_differences() -> None:
    """Directly: along random directions the float32 picture changes by what its gradient says."""
    tensors, views, size = scene(8, seed=1, scale=0.2), cameras(1, 20, 20), (20, 20)
    y, x = torch.meshgrid(torch.linspace(0, 2, 20).double(), torch.linspace(-1, 1, 20).double(), indexing="ij")
    weights = torch.stack([x, y, 1 + x * y], -1)  # smooth: what falls under 1/255 on one side is won on the other

    def loss(moved: list[torch.Tensor]) -> torch.Tensor:
        colors, alphas, _ = rasterization(*(t.float() for t in (*moved, *views)), *size)
        return (colors * weights).sum() + (alphas[..., 0] * y).sum()

    leaves = [t.clone().requires_grad_() for t in tensors]
    gradients = torch.autograd.grad(loss(leaves), leaves)
    generator = torch.Generator().manual_seed(2)
    for place, name in enumerate(("means", "quats", "scales", "opacities", "colors")):
        direction = torch.randn(tensors[place].shape, generator=generator, dtype=torch.float64)
        step = 1e-4 * tensors[place].norm() / direction.norm()
        ends = [[*tensors[:place], tensors[place] + s * direction, *tensors[place + 1 :]] for s in (step, -step)]
        slope = float(loss(ends[0]) - loss(ends[1])) / (2 * float(step))
        assert slope == pytest.approx(float((gradients[place] * direction).sum()), rel=0.01), name


def test_camera_gradients_take_the_reference_projection() -> None:
    tensors, (views, lenses) = scene(40), cameras(1, 16, 16)
    slopes = []
    for dtype, function in ((torch.float32, rasterization), (torch.float64, rasterization_reference)):
        view = views.to(dtype).requires_grad_()
        function(*(t.to(dtype) for t in tensors), view, lenses.to(dtype), 16, 16)[0].square().sum().backward()
        slopes.append(view.grad.double())
    torch.testing.assert_close(slopes[0], slopes[1], rtol=1e-3, atol=1e-3)


def test_means2d_keep_their_gradient_for_densification() -> None:
    tensors = [t.float().requires_grad_() for t in scene(40)]
    views = [v.float() for v in cameras(2, 16, 16)]
    colors, _, notes = rasterization(*tensors, *views, 16, 16)
    notes["means2d"].retain_grad()
    colors.sum().backward()
    assert notes["means2d"].grad.shape == (2, 40, 2)
    assert (notes["means2d"].grad.norm(dim=-1) > 0).any() and not notes["means2d"].grad[
        (notes["radii"] == 0).all(-1)
    ].any()


def test_same_bits_on_any_number_of_threads() -> None:
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one core only")
    tensors, views, threads = scene(500, scale=0.1), cameras(3, 70, 50), torch.get_num_threads()
    results = []
    try:
        for count in (1, 2, 2):
            torch.set_num_threads(count)
            results.append(render(rasterization, tensors, views, (70, 50), torch.float32))
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert torch.equal(other[0], results[0][0]) and torch.equal(other[1], results[0][1])
        for name, gradient in results[0][2].items():
            assert torch.equal(other[2][name], gradient), name


def shifted(*args, **kwargs):
    """Integer pixel centers."""
    lenses = args[6].clone()
    lenses[:, :2, 2] += 0.5
    return rasterization(*args[:6], lenses, *args[7:], **kwargs)


def far_first(*args, **kwargs):
    """Composited from far to near: the same pixels, the depths turned over."""
    from dpcli.ops.splatting.pixels import pixels_numba
    from dpcli.ops.splatting.projection import project_numba

    means, quats, scales, opacities = (t[None] for t in args[:4])
    means2d, conics, depths, radii = project_numba(means, quats, scales, opacities, *args[5:9], 0.01, 1e10, 0.0, 0.3)
    out = pixels_numba(means2d, conics, args[4][None], opacities, radii, 10 - depths, *args[7:9])
    return *out, {"means2d": means2d}


def unblurred(*args, **kwargs):
    return rasterization(*args, eps2d=0.0, **kwargs)


def without_gradient_of(place: int):
    def broken(*args, **kwargs):
        dead = args[place] * 1.0
        dead.register_hook(lambda g: 0.99 * g)
        return rasterization(*args[:place], dead, *args[place + 1 :], **kwargs)

    return broken


@pytest.mark.parametrize("broken", [shifted, far_first, unblurred, *(without_gradient_of(i) for i in range(5))])
def test_checker_rejects_broken_twins(broken) -> None:
    arguments = (scene(60, seed=5), cameras(2, 33, 18), (33, 18))
    assert_renders(rasterization, *arguments)
    with pytest.raises(AssertionError):
        assert_renders(broken, *arguments)


@arithmetic_kernel
def _powers(values, out):
    for i in range(0, values.size, 8):
        store(out, i, power_of_two(load(values, i)))


@parallel_kernel
def _table_powers(table, values, out):
    for block in numba.prange(values.size // 8):
        store(out, 8 * block, power(table, load(values, 8 * block)))


@arithmetic_kernel
def _totals(values, out):
    store(
        out,
        0,
        totals(
            load(values, 0),
            load(values, 8),
            load(values, 16),
            load(values, 24),
            load(values, 32),
            load(values, 40),
            load(values, 48),
            load(values, 56),
        ),
    )


@arithmetic_kernel
def _everything(a, b, out, sums):
    u, v = load(a, 0), load(b, 0)
    store(out, 0, u + v)
    store(out, 8, u - v)
    store(out, 16, u * v)
    store(out, 24, lower(u, v))
    store(out, 32, higher(u, v))
    store(out, 40, where_lower(u, v, ramp(), lanes(np.float32(9))))
    store(out, 48, reciprocal(u))
    sums[0] = total(u)


def _powers_from_table(values, out):
    _table_powers(constants(), values, out)


@pytest.mark.parametrize("powers", [_powers, _powers_from_table])
def test_lanes_power_of_two(powers) -> None:
    """`power` where the compiler may reorder, as in the rasterizer: it could cancel what rounds."""
    values = np.concatenate([np.linspace(-126, 1, 1 << 20), np.linspace(-9, 0, 1 << 20)]).astype(np.float32)
    out = np.empty_like(values)
    powers(values, out)
    assert np.abs(out / np.exp2(values.astype(np.float64)) - 1).max() < 3e-7
    values, out = np.float32([-1e30, -200, -127, -126, 0, 1, 2, 3]), np.empty(8, np.float32)
    powers(values, out)
    assert (out[:4] <= 2.4e-38).all() and (out[:4] > 0).all()
    np.testing.assert_allclose(out[4:], [1, 2, 4, 8], rtol=3e-7)


def test_lanes_do_as_numpy_does() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.integers(1, 5, 8).astype(np.float32), rng.integers(1, 5, 8).astype(np.float32)
    out, sums = np.empty(56, np.float32), np.empty(1, np.float32)
    _everything(a, b, out, sums)
    where = np.where(a < b, np.arange(8), 9)
    wanted = [a + b, a - b, a * b, np.minimum(a, b), np.maximum(a, b), where, 1 / a]
    assert np.array_equal(out.reshape(7, 8), np.float32(wanted)) and sums[0] == a.sum()


def test_eight_totals_at_once() -> None:
    values, out = np.random.default_rng(1).integers(-99, 99, (8, 8)).astype(np.float32), np.empty(8, np.float32)
    _totals(values.reshape(-1), out)
    assert np.array_equal(out, values.sum(1))


@pytest.mark.parametrize("workers", [1, 3])
def test_tile_lists_hold_every_gaussian_by_depth(workers: int) -> None:
    """Against loops over all tiles: ties by index, negative depths, Gaussians without radius, places of pairs."""
    rng, (cameras, count, width, height) = np.random.default_rng(2), (2, 150, 70, 50)
    means = rng.uniform(-10, 80, (cameras, count, 2)).astype(np.float32)
    conics = np.tile(np.float32([0.1, 0.02, 0.05]), (cameras, count, 1))
    opacities = rng.uniform(0, 1, (1, count)).astype(np.float32)
    radii = np.repeat(rng.integers(0, 3, (cameras, count, 1)), 2, axis=2).astype(np.int32)
    depths = (rng.integers(-3, 4, (cameras, count)) / np.float32(3)).astype(np.float32)
    packed, box = np.empty((cameras, count, PACKED), np.float32), np.empty((cameras, count, 4), np.int32)
    pair_start = np.empty((cameras, count), np.int64)
    tasks, start, gaussian = tile_lists(
        means,
        conics,
        opacities,
        radii,
        depths.view(np.int32),
        width,
        height,
        workers,
        np.zeros(1, np.int64),
        packed,
        box,
        pair_start,
    )
    assert not box[radii[..., 0] == 0].any()
    across, down, places = -(-width // WIDE), -(-height // TALL), []
    for c in range(cameras):
        x0, x1, y0, y1 = box[c].T
        held = np.zeros((down, across, count), bool)
        for row, column in np.ndindex(down, across):
            x, y = column * WIDE, row * TALL
            held[row, column] = (x0 < x1) & (x0 < x + WIDE) & (x1 > x) & (y0 < y1) & (y0 < y + TALL) & (y1 > y)
            tile, order = (c * down + row) * across + column, np.argsort(depths[c], kind="stable")
            wanted = order[held[row, column][order]]
            assert np.array_equal(gaussian[start[tile] : start[tile + 1]], wanted)
            assert (tile in tasks) == (wanted.size > 0)
        for n, pairs in enumerate(held.sum((0, 1))):
            places += range(pair_start[c, n], pair_start[c, n] + pairs) if pairs else []
    assert sorted(places) == list(range(len(gaussian))) and len(set(tasks.tolist())) == len(tasks)
