"""The fused set-abstraction layer gives the reference's values and gradients."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from dpcli.ops import grouped_mlp as module
from dpcli.ops.cpu.cache_blocks import ranges
from dpcli.ops.cpu.parallel import parallel_kernels
from dpcli.ops.grouped_mlp import Norm, frozen_activations, grouped_activations, grouped_mlp


def layer(features: int, dtype=torch.float32, seed: int = 0, repeat: bool = False, widths: tuple[int, int] = (8, 12)):
    """Inputs and weights of a layer with channels `widths`; norms with scales of both signs."""
    g = torch.Generator().manual_seed(seed)
    rand = lambda *shape: torch.randn(*shape, generator=g, dtype=torch.float64).to(dtype)  # noqa: E731
    points, idx = rand(2, 50, 3), torch.randint(0, 50, (2, 20, 9), generator=g)
    if repeat:
        idx[:] = idx[..., :1]  # a centroid with one neighbor, nine times: every maximum is a tie
    c1, c2 = widths
    inputs = {
        "features": rand(2, 50, features) if features else None,
        "w1": rand(c1, 3 + features) * 0.3,
        "b1": rand(c1),
        "g1": rand(c1),
        "s1": rand(c1),
        "w2": rand(c2, c1) * 0.3,
        "b2": rand(c2),
        "g2": rand(c2),
        "s2": rand(c2),
    }
    learned = {key: value.requires_grad_() for key, value in inputs.items() if value is not None}
    return points, points[:, :20].clone(), idx, inputs, learned


def run(case, fast: bool, grad):
    points, centers, idx, v, learned = case
    arguments = (
        points,
        centers,
        idx,
        v["features"],
        (v["w1"], v["b1"]),
        Norm(v["g1"], v["s1"], None, None),
        (v["w2"], v["b2"]),
        Norm(v["g2"], v["s2"], None, None),
    )
    if fast:
        pooled, statistics = grouped_mlp(*arguments)
    else:
        taps, statistics = grouped_activations(*arguments)
        pooled = taps[1].amax(2)
    return pooled, statistics, dict(zip(learned, torch.autograd.grad(pooled, list(learned.values()), grad)))


def compare(features: int, repeat: bool = False, widths: tuple[int, int] = (8, 12)) -> None:
    grad = torch.randn(2, 20, widths[1], generator=torch.Generator().manual_seed(1))
    pooled, statistics, grads = run(layer(features, repeat=repeat, widths=widths), True, grad)
    expected, expected_statistics, expected_grads = run(
        layer(features, torch.float64, repeat=repeat, widths=widths), False, grad.double()
    )
    assert (pooled - expected).abs().max() < 1e-5 * expected.abs().max()  # measured 3e-6, over seeds to 4.5e-6
    for ours, theirs in zip(statistics, expected_statistics):
        torch.testing.assert_close(ours.double(), theirs, rtol=1e-5, atol=1e-6)
    for key, value in expected_grads.items():
        if key in ("b1", "b2"):  # a bias before batch norm has no effect: float64 leaves 1e-13 here
            assert value.abs().max() < 1e-10 and grads[key].abs().max() < 1e-3
            continue
        assert value.abs().max() > 1e-3, f"{key}: a zero gradient would pass any tolerance"
        error = (grads[key].double() - value).abs().max() / value.abs().max()
        assert error < 5e-5, f"{key}: {error}"  # measured 6e-6


@pytest.mark.parametrize("features", [0, 7])
def test_values_statistics_and_gradients_match_float64_autograd(features):
    compare(features)


@pytest.mark.parametrize("features", [0, 7])
@pytest.mark.parametrize("widths", [(24, 40), (32, 9)])
def test_blocks_of_channels_that_do_not_fill_up(features, widths, monkeypatch):
    """24 first channels end in half a block of 16; 40, 9 and 12 pooled ones in vectors that overlap; pieces end early."""
    monkeypatch.setattr(module, "_PIECE", 1 << 14)
    compare(features, widths=widths)


@pytest.mark.parametrize("features", [0, 7])
def test_kernels_give_the_same_on_any_number_of_threads(features, one_thread, monkeypatch):
    grad = torch.randn(2, 20, 40, generator=torch.Generator().manual_seed(1))
    results = []
    monkeypatch.setattr(module, "_PIECE", 1 << 14)  # several tasks
    really = torch.set_num_threads
    monkeypatch.setattr(torch, "set_num_threads", lambda count: really(1))  # products of whole layers stay as they are
    for count in (1, 2, 3):
        monkeypatch.setattr(torch, "get_num_threads", lambda count=count: count)  # of those that share the pieces
        pooled, statistics, grads = run(layer(features, widths=(48, 40)), True, grad)
        results.append([pooled, *statistics, *grads.values()])
    for one, two, three in zip(*results):
        assert torch.equal(one, two) and torch.equal(one, three)


def test_numba_s_threads_leave_torch_the_number_it_was_given():
    """numba starts its threads once a process, as many as there are CPUs; a job that asked for one keeps to one."""
    code = (
        "import numba, torch; from dpcli.ops.cpu.parallel import parallel_kernels; parallel_kernels('dpcli.ops.cpu.grouped_mlp');"
        "print(torch.get_num_threads(), numba.get_num_threads())"
    )
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_NUM_THREADS"}
    asked = {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env={**environment, **asked})
    assert done.stdout.split() == ["1", "1"], done.stderr


def test_threads_that_shared_pieces_leave_torch_as_it_was(monkeypatch):
    """Also when one of them fails; and no piece is lost or done twice."""
    monkeypatch.setattr(module, "_PIECE", 1 << 12)
    before, done = torch.get_num_threads(), []
    points, centers, idx, _, _ = layer(0)
    pieces = module._Pieces(module._FromPositions(points, centers, idx, torch.ones(16, 3), torch.zeros(16)), 16)
    tasks = [pieces.of(low, high) for low, high in ranges(pieces.count, 5)]
    pieces.share(tasks, lambda task, low, room: done.append((task, low, len(room.hidden) // pieces.neighbors)))
    assert sorted(done) == [(t, low, high - low) for t, part in enumerate(tasks) for low, high in part]
    assert sum(size for _, _, size in done) == pieces.count == idx.shape[0] * idx.shape[1]

    def fail(task, low, room):
        raise RuntimeError("no")

    with pytest.raises(RuntimeError, match="no"):
        pieces.share(tasks, fail)
    assert torch.get_num_threads() == before


@pytest.mark.parametrize("widths", [(12, 16), (16, 4)])
def test_widths_that_fill_no_vector_take_the_reference(widths, monkeypatch):
    monkeypatch.setattr(module, "_fast", lambda *a: pytest.fail("the numba path ran"))
    run(layer(0, widths=widths), True, torch.ones(2, 20, widths[1]))


@pytest.mark.parametrize("threshold", [-10.0, 0.0, 10.0])
def test_pooled_gradient_is_sorted_by_rows(threshold):
    """Against a loop: no channel is lost or doubled, whether all, some or none of the outputs are above zero."""
    rng = np.random.default_rng(0)
    grad, best = rng.normal(size=(2, 7, 13)).astype(np.float32)
    out, where = np.maximum(best - np.float32(threshold), 0), rng.integers(0, 5, (7, 13), np.int32)
    mean = rng.normal(size=13).astype(np.float32)
    order, values, starts = np.empty((7, 13), np.int32), np.empty((7, 13), np.float32), np.empty((7, 6), np.int32)
    sums = np.zeros((2, 3, 13))
    parallel_kernels("dpcli.ops.cpu.grouped_mlp").sort_pooled(grad, out, best, where, mean, order, values, starts, sums)
    for i in range(7):
        for k in range(5):
            expected = [c for c in range(13) if out[i, c] > 0 and where[i, c] == k]
            slots = slice(starts[i, k], starts[i, k + 1])
            assert order[i, slots].tolist() == expected and values[i, slots].tolist() == grad[i, expected].tolist()
    g = np.where(out > 0, grad, 0).astype(np.float64)
    np.testing.assert_allclose(sums.sum(1), [g.sum(0), (g * (best - mean)).sum(0)], rtol=1e-5, atol=1e-6)


def test_largest_takes_the_first_of_equals():
    rows = np.random.default_rng(0).integers(0, 4, (6, 9, 45)).astype(np.float32) - 2
    best, where = np.empty((6, 45), np.float32), np.empty((6, 45), np.int32)
    kernels = parallel_kernels("dpcli.ops.cpu.grouped_mlp")
    for first in (0, 2):  # two pieces
        piece = rows[first : first + 4 if first else 2]
        kernels.largest(piece.reshape(-1), 9, first, best, where)
    assert (best == rows.max(1)).all() and (where == rows.argmax(1)).all()


def test_checker_rejects_a_kernel_that_drops_the_batch_statistics(monkeypatch):
    """The affine part of the batch-norm gradient is easy to forget; the comparison must notice."""
    original = module._GroupedMLP.backward

    def broken(ctx, grad, *rest):
        out = list(original(ctx, grad, *rest))
        out[11] = out[11] + 0.01 * out[11].abs().max()
        return tuple(out)

    monkeypatch.setattr(module._GroupedMLP, "backward", staticmethod(broken))
    with pytest.raises(AssertionError, match="w2"):
        compare(0)


def test_given_statistics_are_folded_exactly():
    points, centers, idx, v, _ = layer(7, torch.float64)
    norms = [
        Norm(v[g], v[s], torch.rand(len(v[g])).double(), torch.rand(len(v[g])).double() + 0.5)
        for g, s in (("g1", "s1"), ("g2", "s2"))
    ]
    taps, _ = grouped_activations(
        points, centers, idx, v["features"], (v["w1"], v["b1"]), norms[0], (v["w2"], v["b2"]), norms[1]
    )
    x = torch.stack(
        [torch.cat([points[b][idx[b]] - centers[b][:, None], v["features"][b][idx[b]]], -1) for b in range(2)]
    )
    for (w, bias), norm, tap in zip(((v["w1"], v["b1"]), (v["w2"], v["b2"])), norms, taps):
        y = x @ w.T + bias
        x = torch.relu((y - norm.mean) / (norm.var + norm.eps).sqrt() * norm.weight + norm.bias)
        torch.testing.assert_close(tap, x)


def frozen(features, dtype, widths=(8, 16)):
    """Arguments of `frozen_activations`: a layer with statistics of its own."""
    points, centers, idx, v, _ = layer(features, dtype, widths=widths)
    g = torch.Generator().manual_seed(5)
    mean, var = (torch.rand(sum(widths), generator=g).to(dtype).split(widths) for _ in range(2))
    norms = [
        Norm(v[w].detach(), v[b].detach(), m, s + 0.5) for w, b, m, s in zip(("g1", "g2"), ("s1", "s2"), mean, var)
    ]
    given = None if v["features"] is None else v["features"].detach()
    linear = [(v[w].detach(), v[b].detach()) for w, b in (("w1", "b1"), ("w2", "b2"))]
    return points, centers, idx, given, linear[0], norms[0], linear[1], norms[1]


@pytest.mark.parametrize("features", [0, 7])
@pytest.mark.parametrize("widths", [(8, 16), (12, 24), (16, 12)])
def test_frozen_activations_in_pieces_match_float64(features, widths, monkeypatch):
    """The last widths fill no vector, and take the reference."""
    monkeypatch.setattr(module, "_PIECE", 1 << 11)
    (hidden, wide), pooled = frozen_activations(*frozen(features, torch.float32, widths))
    expected, _ = grouped_activations(*frozen(features, torch.float64, widths))
    for ours, exact in zip((hidden, wide, pooled), (*expected, expected[1].amax(2))):
        assert ours.shape == exact.shape and (exact > 0).any() and (exact == 0).any()
        assert (ours - exact).abs().max() < 3e-6 * exact.abs().max()  # measured 4e-7
    assert torch.equal(pooled, wide.amax(2))


@pytest.mark.parametrize("threads", [1, 2])
def test_frozen_activations_can_be_had_in_inference_mode(threads, monkeypatch):
    """Threads are in the caller's mode: outside it they may not write to its tensors."""
    monkeypatch.setattr(module, "_PIECE", 1 << 11)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        expected = frozen_activations(*frozen(7, torch.float32))
        with torch.inference_mode():
            found = frozen_activations(*frozen(7, torch.float32))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(found[1], expected[1]) and found[1].is_inference() and not expected[1].is_inference()


def test_torch_backend_is_used_when_asked_for(monkeypatch):
    monkeypatch.setenv("DPC_BACKEND", "torch")
    monkeypatch.setattr(module, "_fast", lambda *a: pytest.fail("the numba path ran"))
    run(layer(0), True, torch.ones(2, 20, 12))


@pytest.mark.parametrize("features", [0, 5])
def test_an_index_out_of_range_is_refused(features):
    """The kernels would read, and in the gradient write, what isn't theirs."""
    points, centers, idx, *rest = layer(features)
    for wrong in (idx + 1, idx - 1):
        with pytest.raises(ValueError, match=r"0\.\.49"):
            run((points, centers, wrong, *rest), True, None)
