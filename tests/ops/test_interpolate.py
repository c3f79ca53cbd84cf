"""Gathering and three-nearest-neighbor interpolation: values, gradients, every backend."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.ops import gather_points, three_nn_interpolate
from tests.support.ops_helpers import BACKENDS, KINDS, SEEDS, backend, brute_knn, cloud


@pytest.mark.parametrize("name", BACKENDS)
@settings(deadline=None, max_examples=40)
@given(seed=SEEDS, kind=KINDS, count=st.integers(1, 60))
def test_interpolates_by_the_definition(name: str, seed: int, kind: str, count: int) -> None:
    rng = np.random.default_rng(seed)
    points, query = cloud(rng, count, kind=kind), cloud(rng, 6, kind=kind)
    query[0] = points[0]
    features = rng.normal(size=(count, 4)).astype(np.float32)
    with backend(name):
        got = three_nn_interpolate(*(torch.from_numpy(a)[None] for a in (query, points, features)))[0].numpy()
    for m in range(len(query)):
        squared, index = brute_knn(query[m], points, min(3, count))
        weight = 1 / np.maximum(np.array(squared), 1e-10)
        np.testing.assert_allclose(got[m], weight @ features[index] / weight.sum(), rtol=2e-4, atol=1e-5)


@pytest.mark.parametrize("name", BACKENDS)
def test_by_hand(name: str) -> None:
    """Distances 1, 2, 2 and a fourth point too far to count: weights 1, 1/4, 1/4 over 3/2."""
    query = torch.zeros(1, 1, 3)
    points = torch.tensor([[[9.0, 0, 0], [1.0, 0, 0], [0, 2.0, 0], [0, 0, -2.0]]])
    features = torch.tensor([[[100.0], [6.0], [12.0], [24.0]]])
    with backend(name):
        assert three_nn_interpolate(query, points, features).item() == pytest.approx(10.0)


@pytest.mark.parametrize("name", BACKENDS)
def test_interpolation_gradients(name: str) -> None:
    """Finite differences in features and both positions, double precision."""
    generator = torch.Generator().manual_seed(0)
    query, points, features = (
        torch.randn(2, n, c, dtype=torch.float64, generator=generator, requires_grad=True)
        for n, c in ((5, 3), (9, 3), (9, 2))
    )
    with backend(name):
        assert torch.autograd.gradcheck(three_nn_interpolate, (query, points, features))
        query.grad = None
        three_nn_interpolate(query, points, features).square().sum().backward()
    assert all(t.grad.abs().max() > 0 for t in (query, points, features))


def test_interpolation_rejects_features_without_their_points() -> None:
    with pytest.raises(ValueError, match="one row for each"):
        three_nn_interpolate(torch.zeros(1, 2, 3), torch.zeros(1, 5, 3), torch.zeros(1, 4, 7))


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


@pytest.mark.parametrize(
    ("idx", "message"),
    [(torch.tensor([[6], [0]]), "0..5"), (torch.tensor([[-1], [0]]), "0..5"), (torch.tensor([[0]]), "do not fit")],
)
def test_gather_rejects(idx: torch.Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        gather_points(torch.zeros(2, 6, 3), idx)
