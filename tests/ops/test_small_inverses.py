"""Small inverses: against numpy, gradients by finite differences, and what the guard does to singular matrices."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.ops import small_inverse
from tests.support.ops_helpers import SEEDS


def spd(seed: int, *shape: int, n: int) -> torch.Tensor:
    """Well-conditioned symmetric positive definite matrices (*shape,n,n), float64."""
    factor = torch.from_numpy(np.random.default_rng(seed).normal(size=(*shape, 2 * n, n)))
    return factor.mT @ factor / n + 0.1 * torch.eye(n, dtype=torch.float64)


@settings(deadline=None, max_examples=60)
@given(seed=SEEDS, n=st.integers(1, 20), shape=st.sampled_from([(), (3,), (2, 70), (0,)]))
def test_matches_numpy(seed: int, n: int, shape: tuple[int, ...]) -> None:
    matrices = spd(seed, *shape, n=n)
    np.testing.assert_allclose(small_inverse(matrices).numpy(), np.linalg.inv(matrices.numpy()), rtol=1e-7, atol=1e-9)
    single = small_inverse(matrices.float())
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single.numpy(), np.linalg.inv(matrices.numpy()), rtol=5e-3, atol=2e-3)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_closed_form_needs_no_symmetry(n: int) -> None:
    matrices = np.random.default_rng(n).normal(size=(200, n, n))
    got = small_inverse(torch.from_numpy(matrices), guard="none").numpy()
    np.testing.assert_allclose(got @ matrices, np.broadcast_to(np.eye(n), got.shape), atol=1e-8)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 6, 7, 8, 9, 16])
def test_gradients(n: int) -> None:
    assert torch.autograd.gradcheck(small_inverse, (spd(n, 2, n=n).requires_grad_(),), fast_mode=n > 5)


def test_cholesky_gradient_on_symmetric_input() -> None:
    def of_factor(factor: torch.Tensor) -> torch.Tensor:
        return small_inverse(factor @ factor.mT + torch.eye(18, dtype=torch.float64))

    factor = torch.randn(18, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(of_factor, (factor,), fast_mode=True)


@pytest.mark.parametrize(
    ("guard", "expected"),
    [("signed", [1e6, -1e6, 1e6, 2.0]), ("release", [1e6, 1e6, 1e6, 2.0]), ("none", [1e8, -1e8, float("inf"), 2.0])],
)
def test_guard_on_one_by_one(guard: str, expected: list[float]) -> None:
    matrices = torch.tensor([1e-8, -1e-8, 0.0, 0.5], dtype=torch.float64).view(4, 1, 1)
    np.testing.assert_allclose(small_inverse(matrices, guard=guard).flatten().numpy(), expected, rtol=1e-12)


@pytest.mark.parametrize("guard", ["signed", "release"])
@pytest.mark.parametrize("n", [2, 3, 4])
def test_singular_matrices_give_the_adjugate_over_the_floor(guard: str, n: int) -> None:
    """Rank n-1: the adjugate is finite and nonzero; it is what the guard divides by min_det."""
    rng = np.random.default_rng(n)
    vectors = np.linalg.qr(rng.normal(size=(n, n)))[0]
    singular = torch.from_numpy(vectors[:, 1:] @ vectors[:, 1:].T)
    adjugate = vectors[:, :1] @ vectors[:, :1].T  # all other eigenvalues are 1
    got = small_inverse(singular, min_det=1e-3, guard="release").numpy()
    signed = small_inverse(singular, min_det=1e-3, guard=guard).numpy()
    np.testing.assert_allclose(got, adjugate / 1e-3, atol=1e-9)
    np.testing.assert_allclose(abs(signed), abs(got), atol=1e-9)


def test_rank_two_grams_of_dead_groups_invert_to_zero() -> None:
    """Facts of the release: with rank <= n-2 every cofactor vanishes, so the fit becomes zero instead of nan."""
    assert torch.equal(small_inverse(torch.diag(torch.tensor([0.0, 0.0, 3.0, 5.0]))), torch.zeros(4, 4))


def test_a_moved_determinant_carries_no_gradient() -> None:
    """1x1: the inverse of a guarded number is the constant 1/min_det."""
    leaf = torch.tensor([[[1e-9]], [[2.0]]], requires_grad=True)
    small_inverse(leaf).sum().backward()
    assert leaf.grad.flatten().tolist() == [0.0, -0.25]


@pytest.mark.parametrize(
    ("matrices", "guard", "message"),
    [
        (torch.zeros(3, 2), "signed", "shape"),
        (torch.zeros(3), "signed", "shape"),
        (torch.zeros(2, 2, dtype=torch.int64), "signed", "float32"),
        (torch.eye(2), "soft", "guard"),
    ],
)
def test_rejects(matrices: torch.Tensor, guard: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        small_inverse(matrices, guard=guard)


def test_cholesky_refuses_an_indefinite_matrix() -> None:
    with pytest.raises(torch.linalg.LinAlgError):
        small_inverse(-torch.eye(17))
    with pytest.raises(torch.linalg.LinAlgError):
        small_inverse(torch.zeros(17, 17), guard="none")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("guard", ["signed", "release"])
def test_cholesky_lifts_singular_matrices_alone(guard: str, dtype: torch.dtype) -> None:
    """Dead features and doubled neighbors: a regular matrix beside them keeps its inverse to the bit, theirs is that of
    the lifted matrix, and all gradients are finite."""
    regular = spd(0, n=20)
    dead = regular.clone()
    dead[:7], dead[:, :7] = 0, 0
    one = torch.full((20, 20), 3.0, dtype=torch.float64)  # rank one
    leaf = torch.stack([regular, dead, one, torch.zeros_like(one)]).to(dtype).requires_grad_()
    got = small_inverse(leaf, guard=guard)
    assert torch.equal(got[0], small_inverse(regular.to(dtype), guard="none"))
    for number, lift in ((1, 1e-6 * dead.trace()), (2, 1e-6 * 60), (3, 1e-6)):
        exact = (leaf[number].detach().double() + lift * torch.eye(20, dtype=torch.float64)).inverse()
        torch.testing.assert_close(got[number].double(), exact, rtol=0.05, atol=1e-3 * float(exact.abs().max()))
    got.sum().backward()
    assert torch.isfinite(leaf.grad).all()


def test_cholesky_keeps_nan_where_it_is() -> None:
    matrices = torch.stack([torch.eye(17), torch.full((17, 17), torch.nan)])
    found = small_inverse(matrices)
    assert torch.equal(found[0], torch.eye(17)) and found[1].isnan().all()
