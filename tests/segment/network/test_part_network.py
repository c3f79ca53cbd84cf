"""The part network: its group, its convolution against the published operator, and what must not change under rotation."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from dpcli.ops.kernel_convolution import kernel_convolution, kernel_convolution_reference
from dpcli.ops.rotations import mean_rotation, normalize_quaternion, quaternion_to_matrix
from dpcli.segment.network.config import NETWORK_PRESETS, Layer, PartConfig, compact, release
from dpcli.segment.network.cost import convolution_macs, count_macs, count_parameters, paper_parameters
from dpcli.segment.network.icosahedron import find_rotation, icosahedral_group, trivial_group
from dpcli.segment.network.kernel_points import kernel_points
from dpcli.segment.network.motion_head import MotionHead, relative_labels
from dpcli.segment.network.neighborhood import first_neighborhood, nearest_neighborhood
from dpcli.segment.network.part_network import PartNetwork
from dpcli.segment.network.se3_conv import GroupConv, SpatialConv


@pytest.fixture(scope="module")
def golden(golden_file) -> dict[str, np.ndarray]:
    return golden_file("multibody_ops.npz")


@pytest.fixture(scope="module")
def cloud() -> torch.Tensor:
    """A flat box with a lid, 300 points: no symmetry."""
    rng = np.random.default_rng(3)
    box = rng.uniform(-0.5, 0.5, (200, 3)) * [0.9, 0.6, 0.3]
    lid = rng.uniform(-0.5, 0.5, (100, 3)) * [0.9, 0.5, 0.05] + [0, 0.3, 0.4]
    return torch.tensor(np.concatenate([box, lid]), dtype=torch.float32)[None]


def small(**changes) -> PartConfig:
    layer = lambda c, s, r: Layer(c, s, r, (0.6 * r) ** 2, 16, 0.65 * r)  # noqa: E731
    config = PartConfig(
        ((layer(4, 2, 0.25),), (layer(8, 2, 0.4), layer(8, 1, 0.4))),
        decoder=((16, 16), (16, 16)),
        slots=4,
        slot_width=16,
        slot_layers=1,
        embedding=16,
        motion_width=8,
        motion_layers=(8, 8),
    )
    return dataclasses.replace(config, **changes)


def test_the_group_is_the_icosahedrons():
    group = icosahedral_group()
    angles = np.degrees(np.arccos(np.clip((np.trace(group.rotations, axis1=1, axis2=2) - 1) / 2, -1, 1))).round(6)
    assert dict(zip(*np.unique(angles, return_counts=True))) == {0: 1, 72: 12, 120: 20, 144: 12, 180: 15}
    assert np.allclose(np.linalg.det(group.rotations), 1) and np.allclose(group.rotations[0], np.eye(3))
    products = group.rotations[:, None] @ group.rotations
    assert np.abs(products - group.rotations[group.product]).max() < 1e-12
    assert (group.product[np.arange(60), group.inverse] == 0).all()
    assert len(group.nearby) == 12 and set(group.inverse[group.nearby]) == set(group.nearby)


def test_a_rotation_outside_the_group_is_no_element():
    with pytest.raises(ValueError, match="not an element"):
        find_rotation(icosahedral_group().rotations, np.diag([-1.0, -1.0, 1.0])[[1, 0, 2]] * 1.0)


def test_kernel_vertices_only_permute_and_uniform_ones_keep_apart():
    closed, spread = kernel_points("vertices", "icosahedral"), kernel_points("uniform", "icosahedral")
    assert closed.closed and not spread.closed and len(spread.orbit) == 1 + 23 * 60
    rotated = np.einsum("gij,kj->gki", icosahedral_group().rotations, closed.points)
    assert np.abs(closed.orbit[closed.slot] - rotated).max() < 1e-12
    apart = np.linalg.norm(spread.points[:, None] - spread.points, axis=-1) + 9 * np.eye(24)
    assert apart.min() > 0.68 and np.abs(spread.points.mean(0)).max() < 0.05


def test_spatial_convolution_equals_the_published_one(golden):
    """Neighbors, kernel correlations and weights of EPN's inter convolution (golden/multibody_ops.npz)."""
    radius, sigma, count, _ = golden["epn_hyper"]
    points = torch.tensor(golden["epn_xyz"]).mT
    centers = points[:, golden["epn_sample_idx"][0]]
    near = first_neighborhood(points, centers, float(radius), int(count))
    assert (near.index.numpy() == golden["epn_nbr_idx"]).all()
    rotations = golden["epn_anchors"].astype(np.float64)
    layer = Layer(5, 2, float(radius), float(sigma), int(count), 1.0)
    conv = SpatialConv(3, layer, PartConfig(((layer,), (layer,)), kernel="uniform"))
    conv.orbit = torch.tensor(np.concatenate([golden["epn_kernels"] @ r.T for r in rotations]).astype(np.float32))
    conv.slot = torch.arange(60 * 24).view(60, 24)
    weight = torch.tensor(golden["epn_W"]).view(5, 3, 24)  # [out, in, kernel]
    conv.weight.data = weight.permute(2, 1, 0).reshape(72, 5).contiguous()
    features = torch.tensor(golden["epn_feats"]).permute(0, 2, 3, 1).contiguous()
    out = conv(features, near).permute(0, 3, 1, 2).detach().numpy()
    assert np.abs(out - golden["epn_out"]).max() < 2e-5


def test_group_convolution_equals_the_published_one(golden):
    layer = compact().layers[0][0]
    conv = GroupConv(5, 2, PartConfig(((layer,), (layer,))))
    conv.table = torch.tensor(golden["epn_intra_idx"])
    conv.weight.data = torch.tensor(golden["epn_intra_W"]).view(2, 5, 12).permute(2, 1, 0).contiguous()
    features = torch.tensor(golden["epn_out"]).permute(0, 2, 3, 1).contiguous()
    out = conv(features).permute(0, 3, 1, 2).detach().numpy()
    assert np.abs(out - golden["epn_intra_out"]).max() < 2e-5


def test_label_of_a_relative_rotation(golden):
    from dpcli.segment.network.icosahedron import RotationGroup

    anchors = RotationGroup(golden["epn_anchors"].astype(np.float64), None, None, None)
    label, residual = relative_labels(torch.tensor(golden["rel_T"]), anchors)
    assert (label.numpy() == golden["rel_label"]).all()
    assert np.abs(residual.numpy() - golden["rel_target"]).max() < 1e-6


def test_mean_of_rotations(golden):
    mean = mean_rotation(torch.tensor(golden["so3mean_in"]), torch.tensor(golden["so3mean_w"]))
    assert np.abs(mean.numpy() - golden["so3mean_out"]).max() < 1e-5


def test_kernel_convolution_equals_its_reference_and_its_gradients_do():
    rng = torch.Generator().manual_seed(0)
    slot = torch.tensor(kernel_points("vertices", "icosahedral").slot)
    features = torch.randn(2, 30, 60, 3, generator=rng, requires_grad=True)
    index = torch.randint(0, 30, (2, 70, 5), generator=rng)
    weight = (torch.randn(2, 70, 5, 13, generator=rng) - 0.5).clamp(min=0)
    matrix = torch.randn(39, 4, generator=rng, requires_grad=True)
    ours, theirs = (
        f(features, index, weight, slot, matrix) for f in (kernel_convolution, kernel_convolution_reference)
    )
    assert (ours - theirs).abs().max() < 1e-4
    gradient = torch.randn(ours.shape, generator=rng)
    for a, b in zip(*(torch.autograd.grad(out, (features, matrix), gradient) for out in (ours, theirs))):
        assert (a - b).abs().max() < 2e-3 * b.abs().max()
    with pytest.raises(ValueError, match="slot"):
        kernel_convolution(features, index, weight, slot[:, :5], matrix)
    with pytest.raises(ValueError, match=r"0\.\.29"):
        kernel_convolution(features, index + 1, weight, slot, matrix)


def test_group_convolution_gradients_against_plain_indexing():
    conv = GroupConv(3, 2, small()).double()
    features = torch.randn(1, 40, 60, 3, dtype=torch.float64, requires_grad=True)
    plain = torch.einsum("bpgqc,qcd->bpgd", features[:, :, conv.table], conv.weight)
    assert (conv(features) - plain).abs().max() < 1e-12
    gradient = torch.randn_like(plain)
    for a, b in zip(*(torch.autograd.grad(out, (features, conv.weight), gradient) for out in (conv(features), plain))):
        assert (a - b).abs().max() < 1e-10


def assert_equivariant(network: PartNetwork, points: torch.Tensor, rotations, tolerance: float) -> None:
    """Features move to other points and other group elements under R_g and a shift, and masks don't change at all."""
    group = network.encoder.pools[0].config.group
    table = {"icosahedral": icosahedral_group, "trivial": trivial_group}[group]()
    with torch.inference_mode():
        before = network(points)
        for g in rotations:
            turn = torch.tensor(icosahedral_group().rotations[g], dtype=points.dtype)
            after = network(points @ turn.T + torch.tensor([0.7, -2.0, 5.0]))
            if len(table) == 60:
                moved = after.level.equivariant[:, :, torch.tensor(table.product[g])]  # f'(g x, g a)
                gap = float((moved - before.level.equivariant).abs().max())
                assert gap < tolerance, f"features change by {gap} under rotation {g}"
            gap = float((after.mask - before.mask).abs().max())
            assert gap < tolerance, f"masks change by {gap} under rotation {g}"


@pytest.mark.parametrize("pooling", ["point", "global"])
def test_features_and_masks_under_all_rotations_and_shifts(cloud, pooling):
    torch.manual_seed(1)
    network = PartNetwork(dataclasses.replace(compact(), pooling=pooling)).eval()
    assert_equivariant(network, cloud, range(60) if pooling == "point" else [7, 31], 1e-4)


def test_the_check_rejects_broken_twins(cloud):
    torch.manual_seed(1)
    network = PartNetwork(small()).eval()
    assert_equivariant(network, cloud, [13, 40], 1e-4)
    network.encoder.blocks[0][0].across.table = network.encoder.blocks[0][0].across.table.roll(1, 0)
    with pytest.raises(AssertionError, match="features change"):
        assert_equivariant(network, cloud, [13, 40], 1e-4)
    with pytest.raises(AssertionError, match="masks change"):
        assert_equivariant(PartNetwork(small(canonical_heads=0)).eval(), cloud, [13], 1e-4)  # raw xyz, as released
    with pytest.raises(AssertionError, match="masks change"):
        assert_equivariant(PartNetwork(small(group="trivial")).eval(), cloud, [13], 1e-4)


def test_a_cloud_s_masks_do_not_depend_on_what_it_is_computed_with(cloud):
    torch.manual_seed(1)
    network = PartNetwork(compact()).eval()
    with torch.inference_mode():
        alone = network(cloud).mask
        together = network(torch.cat([cloud, 20 * cloud, cloud.flip(1)])).mask
    np.testing.assert_allclose(together[:1], alone, atol=1e-5)


def test_neighborhoods_do_not_jump(cloud):
    """A point that leaves the ball, or the count, counts nothing there: weights move as little as the point does."""
    near = nearest_neighborhood(cloud, cloud[:, :50], 0.3, 16)
    moved = nearest_neighborhood(cloud * 1.0001, cloud[:, :50] * 1.0001, 0.3, 16)
    assert (near.window.sort(-1).values - moved.window.sort(-1).values).abs().max() < 2e-2
    assert (near.window >= 0).all() and near.window.max() <= 1
    few = nearest_neighborhood(cloud[:, :5], cloud[:, :5], 0.3, 16)
    assert few.index.shape == (1, 5, 5)


def test_counts_of_the_released_and_the_compact_network(cloud):
    network = PartNetwork(release())
    assert count_parameters(network) == 1_432_365  # facts 2
    assert count_parameters(network) - count_parameters(network.motion) == 1_372_072
    assert paper_parameters(network) == 329_133  # the thesis's 0.31 M
    published = convolution_macs(release(), 512)
    assert [round(published[key] / 1e6) for key in ("neighbor_sums", "spatial", "group", "shortcut")] == [
        3431,
        4164,
        3397,
        173,
    ]
    ours = PartNetwork(compact())
    assert count_parameters(ours) <= 250_000
    assert count_macs(ours, torch.randn(1, 512, 3) * 0.3)["total"] <= 0.92e9


@pytest.mark.parametrize("config", [compact(), release()], ids=["compact", "release"])
def test_no_more_neighbors_are_counted_than_a_layer_of_few_points_has(config):
    """By a forward pass, in which every layer but the first sums over the neighbors that it was given."""
    network, wanted = PartNetwork(config).encoder, []
    for block in network.blocks:
        for conv in block:
            conv.spatial.register_forward_pre_hook(
                lambda layer, given: wanted.append(0 if given[0] is None else given[1].index.numel() * layer.channels)
            )
    with torch.inference_mode():
        network(torch.rand(1, 32, 3) - 0.5)
    kernel = kernel_points(config.kernel, config.group)
    first = config.layers[0][0]
    constant = 16 * len(kernel.orbit) * (32 if config.rule == "nearest" else first.neighbors)
    assert convolution_macs(config, 32)["neighbor_sums"] == constant + 60 * len(kernel.points) * sum(wanted)


def test_motion_head_finds_a_rotation_of_the_group_in_matching_features():
    """With the right direction, features of the labeled pairs are equal: f2(T R_a) = f1(R_a) (facts 1.7)."""
    group = icosahedral_group()
    torch.manual_seed(0)
    first = torch.randn(1, 2, 60, 8)  # [B, S, G, D]
    g = 17
    second = torch.empty_like(first)
    second[:, :, torch.tensor(group.product[g])] = first  # f2(g a) = f1(a)
    rotation = torch.tensor(group.rotations[g], dtype=torch.float32)
    label, residual = relative_labels(rotation.mT, group)
    assert torch.equal(second[:, :, label], first)
    assert (residual - torch.eye(3)).abs().max() < 1e-6
    wrong, _ = relative_labels(rotation, group)  # the release's direction
    assert not torch.equal(second[:, :, wrong], first)


def test_candidates_contain_the_rotation_of_perfect_answers():
    head = MotionHead(small())
    rotation = quaternion_to_matrix(normalize_quaternion(torch.tensor([0.9, 0.2, -0.3, 0.25])))
    label, wanted = relative_labels(rotation.mT, head.group)
    confidence = torch.full((1, 1, 60, 60), 1e-6)
    confidence[0, 0, torch.arange(60), label] = 1.0
    residual = torch.zeros(1, 1, 60, 60, 4)
    residual[0, 0, torch.arange(60), label] = matrix_to_quaternion(wanted)
    found = head.candidates(confidence, residual)
    assert (found[0, 0, 0] - rotation).abs().max() < 1e-5


def matrix_to_quaternion(matrix: torch.Tensor) -> torch.Tensor:
    from scipy.spatial.transform import Rotation

    return torch.tensor(Rotation.from_matrix(matrix.numpy()).as_quat()[:, [3, 0, 1, 2]], dtype=torch.float32)


@pytest.mark.parametrize(
    "points", [torch.zeros(1, 40, 3), torch.ones(1, 16, 3) * 4, torch.rand(1, 17, 3), torch.rand(1, 2, 3)]
)
def test_poor_clouds_give_finite_masks(points):
    with torch.inference_mode():
        mask = PartNetwork(compact()).eval()(points).mask
    assert torch.isfinite(mask).all() and torch.allclose(mask.sum(-1), torch.ones(1))


def test_configurations_survive_their_text():
    for name in ("compact", "release"):
        assert PartConfig.from_json(NETWORK_PRESETS[name].config().to_json()) == NETWORK_PRESETS[name].config()
