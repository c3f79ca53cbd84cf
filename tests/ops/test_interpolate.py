"""Three-nearest-neighbor interpolation: values, gradients, every backend."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.ops import three_nn_interpolate
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
