"""Gathering neighbors, and their mean without gathering them."""

from __future__ import annotations

import pytest
import torch

from dpcli.ops import gather_mean, gather_points
from dpcli.ops.backend import chosen_backend, reference_only
from tests.support.ops_helpers import BACKENDS, backend


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-6), (torch.float64, 1e-14)])
def test_the_mean_of_neighbors_is_that_of_the_gathered_ones(dtype, tolerance):
    """In value and gradient, with neighbors that repeat and points that nobody has for a neighbor."""
    g = torch.Generator().manual_seed(0)
    features = torch.randn(3, 40, 11, generator=g, dtype=dtype).requires_grad_()
    idx = torch.randint(0, 30, (3, 17, 9), generator=g)
    idx[:, 0] = 7
    along = torch.randn(3, 17, 11, generator=g, dtype=dtype)
    ours, plain = gather_mean(features, idx), gather_points(features, idx).mean(2)
    torch.testing.assert_close(ours, plain, rtol=tolerance, atol=tolerance)
    a, b = (torch.autograd.grad((value * along).sum(), features)[0] for value in (ours, plain))
    torch.testing.assert_close(a, b, rtol=10 * tolerance, atol=10 * tolerance)
    assert (a[:, 30:] == 0).all() and a[:, :30].abs().max() > 0


def test_gradients_of_the_mean_by_differences():
    features = torch.randn(2, 6, 3, dtype=torch.float64, requires_grad=True)
    idx = torch.randint(0, 6, (2, 4, 5))
    assert torch.autograd.gradcheck(lambda value: gather_mean(value, idx), features)


@pytest.mark.parametrize("function", [gather_mean, gather_points])
def test_indices_that_name_no_point_are_refused(function):
    features = torch.zeros(2, 6, 3)
    for wrong in (6, -1):
        with pytest.raises(ValueError, match=r"0\.\.5"):
            function(features, torch.full((2, 4, 5), wrong))
    with pytest.raises(ValueError, match="do not fit"):
        function(features, torch.zeros(3, 4, 5, dtype=torch.long))


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("shape", [(2, 7), (2, 4, 5), (2, 0), (2,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16])
def test_gather_equals_indexing(name: str, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(2, 6, 3, generator=generator).to(dtype).requires_grad_()
    idx = torch.randint(0, 6, shape, generator=generator)
    with backend(name):
        got = gather_points(features, idx)
        want = torch.stack([features[b][idx[b]] for b in range(2)])
        assert torch.equal(got, want)
        if want.numel():
            upstream = torch.randn(want.shape, generator=generator).to(dtype)
            ours, theirs = (torch.autograd.grad(out, features, upstream)[0] for out in (got, want))
            torch.testing.assert_close(ours, theirs, **({"rtol": 0, "atol": 0.02} if dtype == torch.float16 else {}))


@pytest.mark.parametrize("name", BACKENDS)
def test_gather_gradients_repeat_exactly(name: str) -> None:
    """Thousands of rows onto few: threads must not race, and sums keep their order."""
    features = torch.randn(3, 4, 8, requires_grad=True)
    idx = torch.randint(0, 4, (3, 5000))
    with backend(name):
        grads = [
            torch.autograd.grad(gather_points(features, idx), features, torch.ones(3, 5000, 8))[0] for _ in range(2)
        ]
    assert torch.equal(*grads)
    counts = torch.stack([torch.bincount(row, minlength=4) for row in idx]).float()
    assert torch.equal(grads[0], counts[..., None].expand(-1, -1, 8))


@pytest.mark.parametrize("name", BACKENDS)
def test_gather_gradcheck(name: str) -> None:
    features = torch.randn(2, 4, 3, dtype=torch.float64, requires_grad=True)
    idx = torch.tensor([[0, 0, 3], [1, 2, 1]])
    with backend(name):
        assert torch.autograd.gradcheck(lambda f: gather_points(f, idx), (features,))


def test_no_neighbors_and_other_shapes_take_the_plain_way():
    features = torch.randn(2, 6, 3)
    assert gather_mean(features, torch.zeros(2, 0, 5, dtype=torch.long)).shape == (2, 0, 3)
    many = torch.randint(0, 6, (2, 4, 5, 2))
    torch.testing.assert_close(gather_mean(features, many), gather_points(features, many).mean(2))


def test_a_block_without_kernels_ends(monkeypatch):
    for before in (None, "numba"):
        monkeypatch.delenv("DPC_BACKEND", raising=False)
        if before:
            monkeypatch.setenv("DPC_BACKEND", before)
        usual = chosen_backend()
        with pytest.raises(RuntimeError), reference_only():
            assert chosen_backend() == "torch"
            raise RuntimeError
        assert chosen_backend() == usual
