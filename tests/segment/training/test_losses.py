"""Losses, slot matching and object-aware ICP: definitions written out, the release's numbers, gradients, permutations."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dpcli.ops import weighted_kabsch
from dpcli.segment.flow.object_aware_icp import object_aware_icp
from dpcli.segment.network.slot_matching import (
    carry_mask,
    hungarian_assignment,
    match_slots,
    match_slots_through_frames,
    one_hot,
    permute_slots,
    soft_iou,
)
from dpcli.segment.smoothness import smoothness_loss, smoothness_neighbors
from dpcli.segment.training.losses import consensus_weights, dynamic_loss, invariance_loss, rigid_loss, supervised_loss

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def golden(golden_file) -> dict[str, torch.Tensor]:
    return {key: torch.from_numpy(value) for key, value in golden_file("multibody_ops.npz").items()}


def scene(seed: int = 0, count: int = 40, slots: int = 3, dtype: torch.dtype = torch.float64) -> tuple:
    """points, flow, mask and motions."""
    rng = np.random.default_rng(seed)
    points, flow = (torch.tensor(rng.normal(size=(2, count, 3)) * s, dtype=dtype) for s in (0.3, 0.1))
    mask = torch.tensor(rng.normal(size=(2, count, slots)), dtype=dtype).softmax(-1)
    return points, flow, mask, *weighted_kabsch(points, points + flow, mask)


def two_bodies(seed: int, count: int = 120) -> tuple[torch.Tensor, ...]:
    """Two balls that move apart: points of two frames (of the same points, shuffled), true flow, hard masks."""
    rng = np.random.default_rng(seed)
    body = np.arange(count) % 2
    points = rng.normal(size=(count, 3)) * 0.1 + np.where(body, 0.5, -0.5)[:, None]
    turn = Rotation.from_rotvec([0, 0, 0.15]).as_matrix()
    moved = np.where(body[:, None], points @ turn.T + [0.0, 0.02, 0.05], points + [0.03, 0, 0])
    order = rng.permutation(count)
    hard = torch.nn.functional.one_hot(torch.from_numpy(body), 3).float()
    arrays = (points, moved[order], moved - points)
    first, second, flow = (torch.tensor(array, dtype=torch.float32)[None] for array in arrays)
    return first, second, flow, hard[None], hard[order][None]


def test_dynamic_loss_written_out() -> None:
    points, flow, mask, rotation, translation = scene()
    total = 0.0
    for b in range(2):
        for i in range(40):
            blend = sum(float(mask[b, i, s]) * (rotation[b, s] @ points[b, i] + translation[b, s]) for s in range(3))
            total += float((blend - points[b, i] - flow[b, i]).norm())
    assert float(dynamic_loss(points, flow, mask, rotation, translation)) == pytest.approx(total / 80, abs=1e-12)


def test_rigid_loss_written_out() -> None:
    points, flow, mask, rotation, translation = scene(1)
    beta = torch.rand(2, 40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    total = 0.0
    for b in range(2):
        for i in range(40):
            for s in range(3):
                gap = points[b, i] + flow[b, i] - (rotation[b, s] @ points[b, i] + translation[b, s])
                total += float(beta[b, i, s] * (mask[b, i, s] * gap).norm())
    ours = float(rigid_loss(points, flow, mask, rotation, translation, beta))
    assert ours == pytest.approx(total / (2 * 40 * 3), abs=1e-12)
    assert ours < float(rigid_loss(points, flow, mask, rotation, translation))


@pytest.mark.parametrize("loss", [dynamic_loss, rigid_loss])
def test_gradient_reaches_the_mask_alone(loss) -> None:
    points, flow, mask, rotation, translation = scene(2, 9)
    mask, rotation, flow = (x.clone().requires_grad_() for x in (mask, rotation, flow))
    assert torch.autograd.gradcheck(lambda m: loss(points, flow.detach(), m, rotation.detach(), translation), (mask,))
    loss(points, flow, mask, rotation, translation).backward()
    assert mask.grad.abs().max() > 0 and rotation.grad is None and flow.grad is None


def test_no_residual_no_nan() -> None:
    points = torch.randn(1, 20, 3)
    mask = torch.full((1, 20, 2), 0.5, requires_grad=True)
    motion = torch.eye(3).expand(1, 2, 3, 3), torch.zeros(1, 2, 3)
    for loss in (dynamic_loss, rigid_loss):
        value = loss(points, torch.zeros_like(points), mask, *motion)
        value.backward()
        assert float(value.detach()) < 1e-6 and mask.grad.isfinite().all()
    invariance_loss(mask, mask.detach()).backward()
    assert mask.grad.isfinite().all()


def test_consensus_weights() -> None:
    """Hand-computed: one point, one slot, residual 0.5 (equation 4.7)."""
    points, flow = torch.zeros(1, 1, 3), torch.tensor([[[0.5, 0.0, 0.0]]])
    motion = torch.eye(3)[None, None], torch.zeros(1, 1, 3)
    assert float(consensus_weights(points, flow, *motion, tau=2.0)) == pytest.approx(np.exp(-1.0))
    mask = torch.ones(1, 1, 1)
    release = {"form": "release", "mask": mask}
    assert float(consensus_weights(points, flow, *motion, **release)) == 1.0  # 0.25 is not below the gate
    assert float(consensus_weights(points, flow, *motion, **release, tau=0.5, gate=5.0)) == pytest.approx(
        np.exp(-0.125)
    )
    with pytest.raises(ValueError, match="thesis or release"):
        consensus_weights(points, flow, *motion, form="release")


def test_smoothness_by_brute_force() -> None:
    rng = np.random.default_rng(3)
    points, mask = torch.tensor(rng.random((1, 60, 3)) * 0.5, dtype=torch.float32), torch.rand(1, 60, 4)
    near = ball = 0.0
    for i in range(60):
        distance = (points[0] - points[0, i]).norm(dim=1)
        nearest = sorted(range(60), key=lambda j, d=distance: (float(d[j]), j))[:8]
        nearest = [j if distance[j] <= 0.1 else i for j in nearest]
        within = [j for j in range(60) if distance[j] < 0.2][:16]
        within += [within[0]] * (16 - len(within))
        near += sum(float((mask[0, i] - mask[0, j]).abs().sum()) for j in nearest) / 8
        ball += sum(float((mask[0, i] - mask[0, j]).abs().sum()) for j in within) / 16
    neighbors = smoothness_neighbors(points)
    assert float(smoothness_loss(mask, neighbors)) == pytest.approx((3 * near + ball) / 60, rel=1e-5)
    assert float(smoothness_loss(torch.ones_like(mask), neighbors)) == 0.0


def test_invariance_ignores_the_order_of_slots() -> None:
    _, _, mask, *_ = scene(4, slots=4)
    peaked = (mask.log() * 20).softmax(-1)  # so hard that every slot owns points
    for order in permutations(range(4)):
        assert float(invariance_loss(peaked, peaked[..., list(order)])) == pytest.approx(0, abs=1e-12)
    assert float(invariance_loss(mask, torch.full_like(mask, 0.25))) > 0.1


def test_supervised_loss_written_out() -> None:
    _, _, mask, *_ = scene(5, 30)
    labels = torch.tensor(np.random.default_rng(5).integers(0, 3, (2, 30)))
    labels[0, :4] = -1
    best = 0.0
    for b in range(2):
        costs = []
        for order in permutations(range(3)):
            total = 0.0
            for i in range(30):
                for s in range(3):
                    p = float(mask[b, i, s])
                    if labels[b, i] >= 0:
                        total -= np.log(p if labels[b, i] == order[s] else 1 - p)
            costs.append(total / 90)
        best += min(costs) / 2
    assert float(supervised_loss(mask, labels)) == pytest.approx(2 * best, rel=1e-9)
    assert float(supervised_loss(mask[..., [2, 0, 1]], labels)) == pytest.approx(2 * best, rel=1e-9)


def test_supervised_loss_at_the_ends() -> None:
    """A perfect hard mask costs nothing, a certain mistake costs a finite sum, more parts than slots find no slot."""
    labels = torch.tensor([[0, 0, 1, 1]])
    perfect = torch.tensor([[[0.0, 1], [0, 1], [1, 0], [1, 0]]], requires_grad=True)
    loss = supervised_loss(perfect, labels)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(0, abs=1e-6) and perfect.grad.isfinite().all()
    assert 0 < float(supervised_loss(perfect.detach(), torch.tensor([[0, 1, 0, 1]]))) < 1e3
    assert np.isfinite(float(supervised_loss(perfect.detach(), torch.tensor([[0, 1, 2, 7]]))))
    assert np.isfinite(float(supervised_loss(perfect.detach(), torch.tensor([[-1, -1, -1, -1]]))))


def test_supervised_gradient() -> None:
    _, _, mask, *_ = scene(6, 10)
    labels = torch.tensor(np.random.default_rng(6).integers(-1, 3, (2, 10)))
    mask = mask.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda m: supervised_loss(m, labels), (mask,))


def test_hungarian_assignment_maximizes() -> None:
    score = torch.tensor(np.random.default_rng(7).normal(size=(4, 4, 4)))
    for item, columns in zip(score, hungarian_assignment(score)):
        best = max(sum(float(item[s, order[s]]) for s in range(4)) for order in permutations(range(4)))
        assert sum(float(item[s, columns[s]]) for s in range(4)) == pytest.approx(best)
    assert hungarian_assignment(torch.tensor([[[float("nan")], [1.0]]])).tolist() == [[-1, 0]]


def test_soft_iou_of_hard_masks_counts_points() -> None:
    a = torch.nn.functional.one_hot(torch.tensor([[0, 0, 1, 1, 1]]), 3).float()
    b = torch.nn.functional.one_hot(torch.tensor([[1, 0, 0, 0, 0]]), 3).float()
    expected = torch.tensor([[[1 / 5, 1 / 2, 0], [3 / 4, 0, 0], [0, 0, 0]]])
    torch.testing.assert_close(soft_iou(a, b), expected)


def test_match_slots_undoes_a_permutation() -> None:
    first, second, flow, mask1, mask2 = two_bodies(8)
    for order in permutations(range(3)):
        shuffled = mask2[..., list(order)]
        found = match_slots(first, flow, mask1, second, shuffled)
        assert torch.equal(permute_slots(shuffled, found), mask2)
    assert torch.equal(one_hot(carry_mask(first, flow, mask1, second)), mask2)


def test_match_slots_through_frames_chains_any_number_of_frames() -> None:
    first, second, flow, mask1, mask2 = two_bodies(9)
    back = torch.from_numpy(np.zeros(0))  # frames alternate between the two; the flow back is that of the nearest point
    nearest = torch.cdist(second, first + flow).argmin(-1)
    back = first[:, nearest[0]] - second
    frames, flows = [first[0], second[0]] * 3, [flow[0], back[0]] * 3
    orders = [torch.tensor(o) for o in ([0, 1, 2], [2, 0, 1], [1, 0, 2], [1, 2, 0], [0, 2, 1], [2, 1, 0])]
    masks = [(mask1, mask2)[t % 2][0][:, order] for t, order in enumerate(orders)]
    found = match_slots_through_frames(frames, flows[:5], masks)
    assert found.shape == (6, 3) and found[0].tolist() == [0, 1, 2]
    for t in range(6):
        assert torch.equal(masks[t][:, found[t]], (mask1, mask2)[t % 2][0])
    assert match_slots_through_frames(frames[:1], [], masks[:1]).tolist() == [[0, 1, 2]]


def test_object_aware_icp_finds_the_motion() -> None:
    first, second, flow, mask1, mask2 = two_bodies(10)
    start = flow + 0.03 * torch.randn(flow.shape, generator=torch.Generator().manual_seed(0))
    before = (start - flow).norm(dim=-1).mean()
    refined, rotation, translation = object_aware_icp(first, second, mask1, mask2[..., [1, 2, 0]], start)
    assert (refined - flow).norm(dim=-1).mean() < 0.3 * before
    turn = Rotation.from_matrix(rotation[0, 1].numpy()).as_rotvec()
    np.testing.assert_allclose(turn, [0, 0, 0.15], atol=0.05)
    wrong, *_ = object_aware_icp(first, second, mask1, mask2, start, order=torch.tensor([[1, 2, 0]]))
    assert (wrong - flow).norm(dim=-1).mean() > before  # the slots do matter


def test_object_aware_icp_of_a_vanished_part() -> None:
    """Hard masks, and slot 1 has no point in frame 2: its points keep their flow, nothing becomes NaN."""
    first, second, flow, mask1, _ = two_bodies(11)
    gone = torch.zeros_like(mask1)
    gone[..., 0] = 1
    refined, rotation, translation = object_aware_icp(first, second, mask1, gone, flow, order=torch.tensor([[0, 1, 2]]))
    assert refined.isfinite().all() and rotation.isfinite().all() and translation.isfinite().all()
    torch.testing.assert_close(refined[mask1[..., 1] > 0], flow[mask1[..., 1] > 0], rtol=0, atol=1e-4)


def test_golden_losses(golden: dict[str, torch.Tensor]) -> None:
    points, flow, mask1, mask2 = (golden[key] for key in ("pc1", "flow", "mask1", "mask2"))
    motion = weighted_kabsch(points, points + flow, mask1)
    mask = mask1.clone().requires_grad_()
    loss = dynamic_loss(points, flow, mask, *motion)
    loss.backward()
    torch.testing.assert_close(loss.detach(), golden["dynamic_loss"], rtol=0, atol=1e-6)
    torch.testing.assert_close(mask.grad, golden["dynamic_grad"], rtol=0, atol=1e-6)
    neighbors = smoothness_neighbors(points)
    for weights, name in (((1, 0), "smooth_knn"), ((0, 1), "smooth_ball"), ((3, 1), "smooth_loss")):
        torch.testing.assert_close(smoothness_loss(mask1, neighbors, weights), golden[name], rtol=0, atol=1e-6)
    small = smoothness_neighbors(points, k=4, radius=0.05, ball_k=8, ball_radius=0.1)
    torch.testing.assert_close(smoothness_loss(flow, small), golden["flow_smooth"], rtol=0, atol=1e-6)
    torch.testing.assert_close(invariance_loss(mask1, mask2), golden["invariance"], rtol=0, atol=1e-5)
    labels = torch.where(golden["sup_valid"] > 0, golden["sup_gt"].argmax(-1), -1)
    torch.testing.assert_close(supervised_loss(mask1, labels), golden["sup_loss"], rtol=0, atol=1e-6)


def test_golden_matching_and_icp(golden: dict[str, torch.Tensor]) -> None:
    first, second, flow, mask1, mask2 = (golden[key] for key in ("pc1", "pc2", "flow", "mask1", "mask2"))
    torch.testing.assert_close(carry_mask(first, flow, mask1, second), golden["mask2_interp"], rtol=0, atol=1e-6)
    assert torch.equal(match_slots(first, flow, mask1, second, mask2), golden["match_perm"].argmax(-1))
    for steps, name in ((0, "wkabsch_flow"), (1, "oaicp_flow_1"), (20, "oaicp_flow_20")):
        refined, rotation, translation = object_aware_icp(first, second, mask1, mask2, flow, steps)
        torch.testing.assert_close(refined, golden[name], rtol=0, atol=1e-5)
    torch.testing.assert_close(rotation, golden["oaicp_R"], rtol=0, atol=1e-5)
    torch.testing.assert_close(translation, golden["oaicp_t"], rtol=0, atol=1e-5)
