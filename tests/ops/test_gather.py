"""Gathering neighbors, and their mean without gathering them."""

from __future__ import annotations

import pytest
import torch

from dpcli.ops import gather_mean, gather_points
from dpcli.ops.backend import chosen_backend, reference_only


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
