"""The motion of canonical points: quaternions, rigid parts, blending, skinning; against loops, scipy and known motions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dpcli.generate4d.scene.control_points import ControlPoints, turn_frames
from dpcli.generate4d.scene.identification import ball_neighbors, spatial_loss, temporal_loss
from dpcli.generate4d.scene.losses import arap_loss
from dpcli.generate4d.scene.motion import Motion, MotionField, encode
from dpcli.ops.rotations import multiply_quaternions, normalize_quaternion, quaternion_to_matrix, rotate_by_quaternion

TIMES = torch.tensor([0.0, 0.4, 1.0])


def _rotations(count: int, seed: int) -> tuple[torch.Tensor, np.ndarray]:
    """Random unit quaternions (w first) and the same as scipy's matrices."""
    turn = Rotation.random(count, random_state=seed)
    return torch.from_numpy(turn.as_quat()[:, [3, 0, 1, 2]]), turn.as_matrix()


def _field(**switches) -> MotionField:
    torch.manual_seed(0)
    field = MotionField(3, 16, 3, **switches)
    for head in (
        field.deformation_shift,
        field.deformation_turn,
        field.movement_turn,
        field.movement_shift,
        field.weighing_head,
    ):
        torch.nn.init.normal_(head.weight, std=0.2)
    return field


def _rigid_motion(points: torch.Tensor, quaternion: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
    return rotate_by_quaternion(quaternion, points) + shift


def test_quaternions_agree_with_scipy():
    a, a_matrix = _rotations(20, 1)
    b, b_matrix = _rotations(20, 2)
    vectors = torch.randn(20, 3, dtype=torch.float64)
    np.testing.assert_allclose(quaternion_to_matrix(a), a_matrix, atol=1e-12)
    np.testing.assert_allclose(quaternion_to_matrix(multiply_quaternions(a, b)), a_matrix @ b_matrix, atol=1e-12)
    np.testing.assert_allclose(rotate_by_quaternion(a, vectors), np.einsum("nij,nj->ni", a_matrix, vectors), atol=1e-12)
    assert not np.allclose(quaternion_to_matrix(multiply_quaternions(b, a)), a_matrix @ b_matrix)  # the order matters


def test_the_encoding_has_sines_and_cosines_of_doubling_frequencies():
    value = torch.tensor([[0.3, -1.2]], dtype=torch.float64)
    expected = [f(v * 2**k) for v in (0.3, -1.2) for f in (np.sin, np.cos) for k in range(4)]
    np.testing.assert_allclose(encode(value, 4)[0], expected, atol=1e-12)


def test_nothing_moves_before_the_first_step():
    motion = MotionField(4, 16, 6)(torch.randn(10, 3), TIMES)
    assert motion.displacement.abs().max() < 1e-6
    assert torch.allclose(motion.quaternion, torch.tensor([1.0, 0, 0, 0]).expand(3, 10, 4))
    torch.testing.assert_close(motion.part.sum(-1), torch.ones(3, 10))


def test_the_blend_is_equation_5_6_with_the_displacement():
    """One point after the other, by hand; and eq. 5.6 as printed (a position in place of a displacement) is not that."""
    field, points = _field(), torch.randn(5, 3)
    motion = field(points, TIMES)
    turn, shift = field.part_motion(TIMES)
    turn = quaternion_to_matrix(turn)
    alone = _field(rigid=False)(points, TIMES).displacement
    for b in range(3):
        for n in range(5):
            moved = sum(motion.part[b, n, s] * (turn[b, s] @ points[n] + shift[b, s]) for s in range(3))
            w = motion.weight[b, n]
            torch.testing.assert_close(motion.displacement[b, n], w * (moved - points[n]) + (1 - w) * alone[b, n])
            assert not torch.allclose(motion.displacement[b, n], w * moved + (1 - w) * alone[b, n], atol=1e-3)


def test_without_fusion_the_two_are_added_and_without_rigid_only_the_rest_is_left():
    points = torch.randn(6, 3)
    field = _field(fusion=False)
    added, alone, (turn, shift) = field(points, TIMES), _field(rigid=False)(points, TIMES), field.part_motion(TIMES)
    moved = torch.einsum("bns,bsij,nj->bni", added.part, quaternion_to_matrix(turn), points) + added.part @ shift
    torch.testing.assert_close(added.displacement, moved - points + alone.displacement)
    assert (alone.weight == 0).all() and (added.weight == 1).all()
    assert (added.quaternion[..., 0] >= 0).all()


def test_parts_start_as_cells_and_turn_about_their_middle():
    points = torch.cat([torch.randn(50, 3) * 0.05 + shift for shift in torch.eye(3)])
    field = _field()
    field.start_parts(points, torch.eye(3))
    part = field.part_of(points, TIMES)[1]
    assert (part.argmax(1) == torch.arange(3).repeat_interleave(50)).all()
    middle = torch.stack([points[i * 50 : i * 50 + 50].mean(0) for i in range(3)])
    torch.testing.assert_close(field.center, middle, atol=0.05, rtol=0)
    torch.nn.init.zeros_(field.movement_shift.weight)
    turn, shift = field.part_motion(TIMES)
    torch.testing.assert_close(
        rotate_by_quaternion(turn, field.center) + shift, field.center.expand(3, 3, 3), atol=1e-5, rtol=0
    )


def test_the_temporal_loss_knows_the_true_partition():
    torch.manual_seed(0)
    points = torch.randn(40, 3)
    true = torch.nn.functional.one_hot(torch.arange(40) % 2, 2).float().expand(2, -1, -1)
    turns = normalize_quaternion(torch.randn(2, 4))
    moved = torch.stack([_rigid_motion(points[i], turns[i % 2], torch.full((3,), float(i % 2))) for i in range(40)])
    displacement = (moved - points).expand(2, -1, -1).clone().requires_grad_()
    wrong = true[:, torch.randperm(40)].clone().requires_grad_()
    assert temporal_loss(points, displacement, true) < 1e-9
    loss = temporal_loss(points, displacement, wrong)
    loss.backward()
    assert loss > 0.05 and displacement.grad is None and wrong.grad.abs().max() > 0


@settings(deadline=None)
@given(st.integers(1, 12), st.integers(1, 5), st.floats(0.2, 3.0))
def test_neighbors_and_spatial_loss_by_brute_force(count, most, radius):
    rng = torch.Generator().manual_seed(count * 7 + most)
    points, part = torch.randn(count, 3, generator=rng), torch.rand(1, count, 2, generator=rng)
    index = ball_neighbors(points, radius, most)
    distance = (points[:, None] - points).norm(dim=-1)
    total = []
    for i in range(count):
        near = sorted((float(distance[i, j]), j) for j in range(count) if j != i and distance[i, j] <= radius)[:most]
        found = [int(j) for j in index[i] if int(j) != i]
        assert found == [j for _, j in near]
        total += [float((part[0, i] - part[0, j]).norm()) for j in index[i]]
    assert float(spatial_loss(part, index)) == pytest.approx(np.mean(total), abs=1e-5)


def _motion(quaternion: torch.Tensor, displacement: torch.Tensor) -> Motion:
    none = torch.zeros(0)
    return Motion(displacement, quaternion, none, none)


def test_skinning_is_equation_5_8_in_loops():
    torch.manual_seed(1)
    control = ControlPoints(torch.randn(12, 3), 4).double()
    apart = torch.cdist(control.position, control.position).sort(1).values[:, 1:4].mean(1)
    torch.testing.assert_close(control.log_radius.exp(), apart, atol=1e-5, rtol=1e-5)
    control.log_radius.data += torch.randn(12, dtype=torch.float64) * 0.3
    points = torch.randn(7, 3, dtype=torch.float64)
    turn = normalize_quaternion(torch.cat([torch.ones(2, 12, 1), torch.randn(2, 12, 3)], -1).double())
    shift = torch.randn(2, 12, 3, dtype=torch.float64)
    nearest = torch.cdist(points, control.position).topk(4, largest=False).indices
    moved, quaternion = control.carry(points, nearest, _motion(turn, shift))
    for b in range(2):
        for i in range(7):
            k = nearest[i]
            weight = torch.exp(-((points[i] - control.position[k]) ** 2).sum(1) / control.log_radius[k].exp() ** 2)
            weight = weight / weight.sum()
            there = [
                rotate_by_quaternion(turn[b, j], points[i] - control.position[j]) + control.position[j] + shift[b, j]
                for j in k
            ]
            torch.testing.assert_close(moved[b, i], (weight[:, None] * torch.stack(there)).sum(0))
            torch.testing.assert_close(quaternion[b, i], normalize_quaternion((weight[:, None] * turn[b, k]).sum(0)))


def test_control_points_in_one_place_share_what_they_carry():
    control = ControlPoints(torch.zeros(3, 3), 3)
    weights = control.weights(torch.tensor([[0.0, 0, 0], [5, 0, 0]]), torch.arange(3).expand(2, 3))
    torch.testing.assert_close(weights, torch.full((2, 3), 1 / 3))


def test_one_rigid_motion_of_all_control_points_carries_everything_rigidly():
    torch.manual_seed(2)
    points = torch.randn(200, 3)
    control = ControlPoints.among(points, 20)
    turn, shift = normalize_quaternion(torch.tensor([1.0, 0.3, -0.2, 0.5])), torch.tensor([0.1, -0.4, 2.0])
    displacement = _rigid_motion(control.position.detach(), turn, shift) - control.position.detach()
    motion = _motion(turn.expand(1, 20, 4), displacement[None])
    moved, quaternion = control.carry(points, control.nearest(points), motion)
    torch.testing.assert_close(moved[0], _rigid_motion(points, turn, shift), atol=1e-5, rtol=0)
    torch.testing.assert_close(quaternion[0], turn.expand(200, 4), atol=1e-6, rtol=0)
    own, frames = _rotations(200, 3)
    turned = quaternion_to_matrix(turn_frames(quaternion.detach(), 2 * own.float())[0])
    np.testing.assert_allclose(turned, quaternion_to_matrix(turn).numpy() @ frames, atol=1e-5)


def test_gradients_through_skinning_are_those_of_finite_differences():
    torch.manual_seed(3)
    control = ControlPoints(torch.randn(6, 3), 3).double()
    points = torch.randn(4, 3, dtype=torch.float64, requires_grad=True)
    nearest = torch.cdist(points, control.position).topk(3, largest=False).indices
    turn = torch.randn(1, 6, 3, dtype=torch.float64, requires_grad=True)
    shift = torch.randn(1, 6, 3, dtype=torch.float64, requires_grad=True)

    def outputs(points, turn, shift, position, radius):
        control.__dict__["_parameters"].update(position=position, log_radius=radius)
        return control.carry(
            points, nearest, _motion(normalize_quaternion(torch.cat([turn[..., :1] * 0 + 1, turn], -1)), shift)
        )

    position, radius = (
        control.position.detach().clone().requires_grad_(),
        control.log_radius.detach().clone().requires_grad_(),
    )
    assert torch.autograd.gradcheck(outputs, (points, turn, shift, position, radius))


def test_arap_is_zero_for_rigid_motions_and_what_scipy_s_rotations_leave_of_others():
    torch.manual_seed(4)
    points = torch.randn(30, 3)
    neighbors = ball_neighbors(points, 2.0, 5)
    turn = normalize_quaternion(torch.randn(2, 4))
    rigid = torch.stack([_rigid_motion(points, q, torch.ones(3)) for q in turn])
    assert arap_loss(points, rigid, neighbors) < 1e-9
    for stretch in ([1.0, 1.5, 1.0], [-1.0, 1.0, 1.0]):  # a mirror is no rotation
        moved = torch.stack([points * torch.tensor(stretch), points + 0.1 * torch.randn(30, 3)])
        left = [
            Rotation.align_vectors((cloud[near] - cloud[i]).numpy(), (points[near] - points[i]).numpy())[1] ** 2
            for cloud in moved
            for i, near in enumerate(neighbors)
        ]
        assert arap_loss(points, moved, neighbors).item() == pytest.approx(np.mean(left) / 5, rel=1e-4)
