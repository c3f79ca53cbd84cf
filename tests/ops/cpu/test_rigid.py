"""The CPU kernels of `rigid` against their torch twins in float64, and where they must not be used."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dpcli.ops.cpu.rigid import flow_kernel, kabsch_kernel
from dpcli.ops.rigid import rigid_flow, rigid_flow_reference, weighted_kabsch, weighted_kabsch_reference
from tests.support.ops_helpers import KINDS, SEEDS, backend, cloud

pytestmark = pytest.mark.usefixtures("one_thread")


def moving(seed: int, count: int, slots: int, noise: float = 0.05) -> tuple[torch.Tensor, ...]:
    """Two clouds (2,count,3) turned, shifted and blurred, and weights (2,count,slots); float32."""
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(2, count, 3))
    turns = Rotation.random(2, rng=rng).as_matrix()
    target = source @ turns + rng.normal(size=(2, 1, 3)) + noise * rng.normal(size=source.shape)
    return tuple(torch.from_numpy(np.float32(x)) for x in (source, target, rng.random((2, count, slots))))


def assert_rotations(rotation: torch.Tensor) -> None:
    rotation = rotation.double()
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).double().expand_as(rotation), rtol=0, atol=1e-6)
    assert (torch.linalg.det(rotation) > 0.999).all()


@settings(deadline=None, max_examples=40)
@given(seed=SEEDS, count=st.integers(12, 60), slots=st.integers(1, 5))
def test_the_kernel_is_the_reference_in_float64(seed: int, count: int, slots: int) -> None:
    given_ = moving(seed, count, slots)
    with backend("numba"):
        found = weighted_kabsch(*given_)
    exact = weighted_kabsch_reference(*(x.double() for x in given_))  # whose pull to no turn is that of float64
    assert_rotations(found[0])
    for ours, theirs in zip(found, exact):
        assert ours.dtype == torch.float32
        torch.testing.assert_close(ours.double(), theirs, rtol=0, atol=2e-5)


@settings(deadline=None, max_examples=60)
@given(seed=SEEDS, count=st.integers(1, 30), kinds=st.tuples(KINDS, KINDS))
def test_any_cloud_gets_a_rotation_that_costs_no_more_than_the_references(seed, count, kinds) -> None:
    """Where points leave turns open, the two may differ; what they cost may not."""
    rng = np.random.default_rng(seed)
    source, target = (torch.from_numpy(cloud(rng, 1, count, kind=kind)) for kind in kinds)
    weights = torch.from_numpy(rng.integers(0, 3, (1, count, 3)).astype(np.float32))  # many zeros, empty slots
    with backend("numba"):
        rotation, shift = weighted_kabsch(source, target, weights)
    assert_rotations(rotation)
    empty = weights.sum(1) == 0
    assert torch.equal(rotation[empty], torch.eye(3).expand_as(rotation[empty])) and not shift[empty].any()

    def gap(rotation: torch.Tensor) -> torch.Tensor:
        """Cost (1,S) of a rotation with the best shift there is."""
        share = weights.double() / weights.double().sum(1, keepdim=True).clamp(min=1e-9)
        x, y = (
            p.double()[:, :, None] - (share[..., None] * p.double()[:, :, None]).sum(1, keepdim=True)
            for p in (source, target)
        )
        return (share * (torch.einsum("bsij,bnsj->bnsi", rotation.double(), x) - y).square().sum(-1)).sum(1)

    theirs, _ = weighted_kabsch_reference(source, target, weights)
    size = source.double().var(1, correction=0).sum() + target.double().var(1, correction=0).sum()
    assert (gap(rotation) <= gap(theirs) + 1e-4 * size + 1e-6).all()


@pytest.mark.parametrize(
    "case", ["mirror", "line", "one point", "all equal", "all equal and far", "nan", "infinite", "tiny"]
)
def test_odd_clouds_as_the_reference(case: str) -> None:
    source, target, weights = moving(3, 20, 3, noise=0.0)
    if case == "mirror":
        target = source * torch.tensor([1.0, 1.0, -1.0]) * torch.tensor([1.0, 0.7, 0.3])
    elif case == "line":
        source = source[:, :1] * torch.linspace(-1, 1, 20)[None, :, None]
        target = source + 0.5
    elif case == "one point":
        source, target, weights = source[:, :1], target[:, :1], weights[:, :1]
    elif case.startswith("all equal"):
        far = 1000 if "far" in case else 0
        source, target = source[:, :1].expand(-1, 20, -1) + far, target - far
    elif case == "tiny":
        weights = weights * 1e-14
    else:
        target[0, 0, 0] = float(case.replace("infinite", "inf"))
    with backend("numba"):
        found = weighted_kabsch(source, target, weights)
    for ours, theirs in zip(found, weighted_kabsch_reference(source, target, weights)):
        assert ours.isfinite().all()
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=2e-3 if case in ("line", "one point") else 2e-5)
    assert_rotations(found[0])


def test_a_mirror_image_is_told_from_a_rotation() -> None:
    """The check of `assert_rotations` fails for the nearest orthogonal matrix, which here has determinant -1."""
    source, _, _ = moving(4, 30, 1)
    left, _, right = torch.linalg.svd((source * torch.tensor([1.0, 1.0, -1.0])).mT @ source)
    with pytest.raises(AssertionError):
        assert_rotations(left @ right)


def test_the_blend_is_the_references() -> None:
    source, target, weights = moving(5, 70, 4)
    motions = weighted_kabsch(source, target, weights)
    with backend("numba"):
        found = rigid_flow(source, weights, *motions)
    exact = rigid_flow_reference(*(x.double() for x in (source, weights, *motions)))
    torch.testing.assert_close(found.double(), exact, rtol=0, atol=5e-6)


def test_windows_of_any_size_give_the_same() -> None:
    """What one thread does is not touched by another's."""
    source, target, weights = (x.numpy() for x in moving(6, 25, 4))
    rotation, shift, flow = (np.full(s, np.nan, np.float32) for s in ((2, 4, 3, 3), (2, 4, 3), (2, 25, 3)))
    kabsch_kernel(source, target, weights, rotation, shift, 3, 6)
    assert np.isfinite(rotation.reshape(8, 9)).all(1).tolist() == [3 <= row < 6 for row in range(8)]
    kabsch_kernel(source, target, weights, rotation, shift, 0, 3)
    kabsch_kernel(source, target, weights, rotation, shift, 6, 8)
    whole = weighted_kabsch(*(torch.from_numpy(x) for x in (source, target, weights)))
    assert np.array_equal(rotation, whole[0]) and np.array_equal(shift, whole[1])
    flow_kernel(source, weights, rotation, shift, flow, 11, 39)
    assert np.isfinite(flow.reshape(50, 3)).all(1).tolist() == [11 <= row < 39 for row in range(50)]


def test_a_gradient_goes_through_torch(monkeypatch) -> None:
    inputs = tuple(x.requires_grad_() for x in moving(7, 12, 2))
    rotation, shift = weighted_kabsch(*inputs)
    assert rotation.requires_grad and shift.requires_grad
    assert rigid_flow(inputs[0], inputs[2], rotation, shift).requires_grad
    with torch.no_grad():
        assert not weighted_kabsch(*inputs)[0].requires_grad
    with backend("torch"):
        monkeypatch.setattr("dpcli.ops.cpu.rigid.kabsch_kernel", None)
        weighted_kabsch(*(x.detach() for x in inputs))


def test_rejects_shapes_that_do_not_fit() -> None:
    source, target, weights = moving(8, 9, 2)
    rotation, shift = weighted_kabsch(source, target, weights)
    for wrong in (
        (source, weights[:, 1:], rotation, shift),
        (source, weights, rotation[:, 1:], shift[:, 1:]),
        (source, weights, rotation[:1], shift[:1]),
        (source, weights, rotation, shift[:, :1]),
    ):
        with pytest.raises(ValueError, match="do not fit"):
            rigid_flow(*wrong)
