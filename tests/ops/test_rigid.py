"""Rigid motions: the least squares they promise, the release's numbers, gradients, and inputs that leave turns open."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dpcli.ops import apply_motions, motion_matrix, rigid_flow, weighted_kabsch

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def golden(golden_file) -> dict[str, torch.Tensor]:
    return {key: torch.from_numpy(value) for key, value in golden_file("multibody_ops.npz").items()}


def scene(seed: int, count: int = 12, slots: int = 3, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, ...]:
    rng = np.random.default_rng(seed)
    shapes = ((2, count, 3), (2, count, 3))
    source, target = (torch.tensor(rng.normal(size=shape), dtype=dtype) for shape in shapes)
    return source, target, torch.tensor(rng.random((2, count, slots)), dtype=dtype)


def cost(source, target, weights, rotation, translation) -> torch.Tensor:
    gap = apply_motions(source, rotation, translation) - target[:, None]
    return (weights.mT * gap.square().sum(-1)).sum(-1)


def assert_proper(rotation: torch.Tensor, atol: float = 1e-5) -> None:
    eye = torch.eye(3, dtype=rotation.dtype).expand_as(rotation)
    torch.testing.assert_close(rotation @ rotation.mT, eye, rtol=0, atol=atol)
    torch.testing.assert_close(torch.det(rotation), torch.ones_like(rotation[..., 0, 0]), rtol=0, atol=atol)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(3, 40))
def test_agrees_with_scipy(seed: int, count: int) -> None:
    source, target, weights = scene(seed, count)
    rotation, translation = weighted_kabsch(source, target, weights)
    assert_proper(rotation)
    for b in range(2):
        for s in range(3):
            w = weights[b, :, s].numpy()
            x, y = (p[b].numpy() - np.average(p[b].numpy(), 0, w) for p in (source, target))
            theirs, _ = Rotation.align_vectors(y, x, w)
            best = (w * np.square(theirs.apply(x) - y).sum(1)).sum()
            ours = float(cost(source, target, weights, rotation, translation)[b, s])
            assert ours <= best * (1 + 1e-4) + 1e-12  # float32 points, and the pull to no turn: 2e-6 seen


def test_no_small_change_does_better() -> None:
    """A checker that needs no other library, and that a reflection or a missing sign would not pass."""
    source, target, weights = scene(1)
    target = target * torch.tensor([1.0, 1.0, -1.0]) * 0.1 + source * torch.tensor([1.0, 1.0, -1.0])  # nearly a mirror
    rotation, translation = weighted_kabsch(source, target, weights)
    assert_proper(rotation)
    best = cost(source, target, weights, rotation, translation)
    rng = np.random.default_rng(0)
    for _ in range(50):
        turn = torch.from_numpy(Rotation.from_rotvec(rng.normal(scale=1e-3, size=3)).as_matrix())
        offset = torch.from_numpy(rng.normal(scale=1e-3, size=3))
        assert (cost(source, target, weights, turn @ rotation, translation + offset) >= best - 1e-9).all()
    mean = ((weights.mT @ target) / weights.sum(1)[..., None])[..., None]
    broken = rotation.mT  # the transposed rotation, with the translation that suits it best
    shifted = (mean - broken @ ((weights.mT @ source) / weights.sum(1)[..., None])[..., None]).squeeze(-1)
    assert (cost(source, target, weights, broken, shifted) > best).any()


def test_recovers_each_slots_motion() -> None:
    """Hard weights, exact motions: what comes back is what was put in; the blended flow is exact, too."""
    rng = np.random.default_rng(2)
    points = torch.tensor(rng.normal(size=(1, 60, 3)))
    truth = torch.from_numpy(Rotation.random(3, random_state=3).as_matrix())[None]
    offset = torch.tensor(rng.normal(size=(1, 3, 3)))
    mask = torch.nn.functional.one_hot(torch.arange(60) % 3, 3).double()[None]
    flow = rigid_flow(points, mask, truth, offset)
    rotation, translation = weighted_kabsch(points, points + flow, mask)
    torch.testing.assert_close(rotation, truth, rtol=0, atol=1e-5)
    torch.testing.assert_close(translation, offset, rtol=0, atol=1e-5)
    matrices = motion_matrix(rotation, translation)[0, torch.arange(60) % 3]
    ones = torch.cat([points[0], torch.ones(60, 1)], 1)
    torch.testing.assert_close((matrices @ ones[..., None])[:, :3, 0] - points[0], flow[0], rtol=0, atol=1e-5)
    assert torch.equal(matrices[:, 3], torch.tensor([0.0, 0.0, 0.0, 1.0]).double().expand(60, 4))


def test_group_action() -> None:
    """Turning and shifting both clouds conjugates the motion: R' = G R G^T."""
    source, target, weights = scene(4)
    turn = torch.from_numpy(Rotation.random(random_state=5).as_matrix())
    offset = torch.tensor([0.3, -1.0, 2.0]).double()
    rotation, translation = weighted_kabsch(source, target, weights)
    turned, _ = weighted_kabsch(source @ turn.T + offset, target @ turn.T + offset, weights * 7)
    torch.testing.assert_close(turned, turn @ rotation @ turn.T, rtol=0, atol=1e-5)


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_gradient(mirror: float) -> None:
    source, target, weights = scene(6, 7, 2)
    if mirror < 0:  # the fix of the determinant is active
        target = source * torch.tensor([1.0, 1.0, -1.0]) + 0.1 * target
    inputs = tuple(x.clone().requires_grad_() for x in (source, target, weights))
    assert torch.autograd.gradcheck(weighted_kabsch, inputs)


def test_gradient_where_singular_values_coincide() -> None:
    """A cube's covariance has three equal singular values: a gradient through the SVD is infinite there."""
    corners = torch.tensor([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]).double()[None]
    inputs = (corners.clone().requires_grad_(), corners.clone().requires_grad_(), torch.ones(1, 8, 1).double())
    rotation, translation = weighted_kabsch(*inputs)
    (rotation[..., 0, 1].sum() + translation.sum()).backward()
    assert inputs[0].grad.isfinite().all() and inputs[0].grad.abs().max() > 0.01
    assert torch.autograd.gradcheck(weighted_kabsch, inputs)


@pytest.mark.parametrize("case", ["empty slot", "one point", "all equal", "line", "nan", "infinite"])
def test_answers_are_finite(case: str) -> None:
    source, target, weights = scene(7, dtype=torch.float32)
    if case == "empty slot":
        weights[0, :, 1] = 0
    elif case == "one point":
        source, target, weights = source[:, :1], target[:, :1], weights[:, :1]
    elif case == "all equal":
        source = source[:, :1].expand(-1, 12, -1)
    elif case == "line":
        source = source[:, :1] * torch.linspace(-1, 1, 12)[None, :, None]
        target = source + 0.5
    else:
        target[0, 0, 0] = float(case.replace("infinite", "inf"))
    source = source.clone().requires_grad_()
    rotation, translation = weighted_kabsch(source, target, weights)
    assert rotation.isfinite().all() and translation.isfinite().all()
    assert_proper(rotation)
    if case == "empty slot":
        assert torch.equal(rotation[0, 1], torch.eye(3)) and not translation[0, 1].any()
    if case in ("one point", "all equal", "line"):  # nothing says that they turned
        torch.testing.assert_close(rotation, torch.eye(3).expand_as(rotation), rtol=0, atol=0.02)
    if case not in ("nan", "infinite"):
        (rotation.sum() + translation.sum()).backward()
        assert source.grad.isfinite().all()


def test_golden(golden: dict[str, torch.Tensor]) -> None:
    points, flow, mask = golden["pc1"], golden["flow"], golden["mask1"]
    for weights, name in ((golden["kabsch_w"][..., None], "kabsch"), (torch.ones(2, 96, 1), "kabsch_nomask")):
        rotation, translation = weighted_kabsch(points, points + flow, weights)
        torch.testing.assert_close(rotation[:, 0], golden[f"{name}_R"], rtol=0, atol=1e-5)
        torch.testing.assert_close(translation[:, 0], golden[f"{name}_t"], rtol=0, atol=1e-5)
    blended = rigid_flow(points, mask, *weighted_kabsch(points, points + flow, mask))
    torch.testing.assert_close(blended, golden["wkabsch_flow"], rtol=0, atol=1e-5)


def test_rejects_shapes_that_do_not_fit() -> None:
    source, target, weights = scene(8)
    with pytest.raises(ValueError, match="source and target"):
        weighted_kabsch(source, target[:, 1:], weights)
    with pytest.raises(ValueError, match="weights must"):
        weighted_kabsch(source, target, weights[..., 0])
