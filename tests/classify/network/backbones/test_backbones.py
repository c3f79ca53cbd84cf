"""DGCNN, SpiderCNN and a user's own network under Kinet's dynamic stream."""

from __future__ import annotations

import copy
import itertools
from pathlib import Path

import pytest
import torch
from torch import nn
from torch.nn.functional import cross_entropy

from dpcli.classify.network.backbones.dgcnn import DGCNN, Dense, EdgeConv, edge_statistics, image_statistics
from dpcli.classify.network.backbones.frame_graph import frame_graph, frame_shares, pool_edges
from dpcli.classify.network.backbones.interface import build_backbone, clip_points, resolve_backbone
from dpcli.classify.network.backbones.spidercnn import SpiderCNN, SpiderConv, _RankedProducts, _terms, monomials
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network.model_file import ModelInfo, load_model, save_model
from dpcli.classify.network.sync_norm import synchronize_norms
from dpcli.classify.network_cost import count_parameters, paper_parameters
from dpcli.classify.network_speed import body_like_clip
from dpcli.classify.presets import BACKBONE_CHANGES, PRESETS, backbone_changes
from dpcli.errors import DataError, UsageError
from dpcli.runtime.mixed_precision import reduced_products
from tests.support.tiny_backbone import TinyBackbone

ROOT = Path(__file__).resolve().parents[4]
TINY = {
    "dgcnn": {"widths": ((8, 8, 16), (24,), (8, 8, 16, 8, 8), (16, 12)), "neighbors": 6},
    "spidercnn": {"widths": ((8, 16), (3,), (24, 16)), "neighbors": 6},
    "tests.support.tiny_backbone:TinyBackbone": {"neighbors": 8},
}

pytestmark = pytest.mark.usefixtures("one_thread")


def tiny(backbone: str, **changes) -> KinetConfig:
    common = {"num_classes": 3, "num_frames": 4, "points_per_frame": 12, "head": (16, 24), "solver": "ridge"}
    return KinetConfig(**{**common, "backbone": backbone, **TINY[backbone], **changes})


def trained_norms(network: nn.Module) -> nn.Module:
    """Norms that do something: running statistics and scales as after training, some scales negative."""
    for layer in network.modules():
        if isinstance(layer, (nn.BatchNorm1d, nn.GroupNorm)):
            nn.init.normal_(layer.weight, 0.5, 1.0)
            nn.init.normal_(layer.bias, 0.0, 0.3)
        if isinstance(layer, nn.BatchNorm1d):
            layer.running_mean.normal_(0.0, 0.2)
            layer.running_var.uniform_(0.5, 2.0)
    return network


# ---- sizes


def published(backbone: str) -> KinetConfig:
    return PRESETS["thesis"]["network"].changed(**backbone_changes("thesis", backbone))


def test_dgcnn_has_the_published_parameters_to_the_last_one():
    """Facts: 5,501,015 numbers with Adam's moments and the moving statistics, over 2^20 table A.1's 5.25."""
    network = build_backbone(published("dgcnn"))
    moving = sum(buffer.numel() for name, buffer in network.named_buffers() if "running" in name)
    assert (count_parameters(network), 3 * count_parameters(network) + moving) == (1_830_941, 5_501_015)
    assert round(paper_parameters(network), 2) == 5.25
    assert count_parameters(network.transform) == 803_273
    assert [count_parameters(conv) for conv in network.convs] == [576, 8_384, 8_384, 16_768]
    assert network.tap_widths == ((64,), (64,), (64,), (128,))


def test_dgcnn_at_2048_points_costs_what_table_a1_says():
    """5.30e9 operations by hand, 5.33 in the table: so its clips had 2,048 points in all."""
    network = build_backbone(published("dgcnn"))
    per_point = 20 * (6 * 64 + 64 * 128 + 6 * 64 + 2 * 128 * 64 + 128 * 128) + 128 * 1024 + 320 * 1024
    once = 2 * (1024 * 512 + 512 * 256) + 256 * (9 + 20)
    assert network.macs_as_written() == 2048 * per_point + once
    assert 2 * network.macs_as_written() == pytest.approx(5.33e9, rel=0.01)


def test_spidercnn_has_the_published_parameters():
    """By hand from the published widths: kernels, biases, group norms, Taylor weights; two hidden layers and the last."""
    network = build_backbone(published("spidercnn"))
    kernels = 20 * 5 * (3 * 32 + 32 * 64 + 64 * 128 + 128 * 256)
    hidden = 960 * 1024 + 3 * 1024 + 1024 * 512 + 3 * 512 + 512 * 20 + 20
    assert count_parameters(network) == kernels + 3 * 480 + 4 * 20 * 5 + hidden == 5_834_436
    assert network.tap_widths == ((32,), (64,), (128,), (256,))


# ---- the graph


def graph_by_hand(features, size, k, reach, shared):
    """One cloud (N,C): all distances in float64, then Python's own sorting."""
    features, frames = features.double(), len(features) // size
    rows = []
    for i in range(len(features)):
        own = i // size
        near = [t for t in range(frames) if abs(t - own) <= reach]
        keys = [
            ((features[i] - features[j]).square().sum().item(), abs(j // size - own), j) for j in range(len(features))
        ]
        found = []
        for t in near:
            share = k // len(near) + (k % len(near) if t == own else 0)
            found += sorted(key for key in keys if key[2] // size == t)[:share]
        if not shared:
            found = sorted(key for key in keys if key[2] // size in near)
        found = [j for *_, j in sorted(found)][:k]
        rows.append(found + [found[0]] * (k - len(found)))
    return torch.tensor(rows)


@pytest.mark.parametrize(("channels", "shared"), list(itertools.product((3, 5), (True, False))))
@pytest.mark.parametrize(("k", "reach", "size"), [(8, 1, 7), (7, 2, 5), (4, 0, 6), (9, 1, 2), (11, 9, 4)])
def test_the_graph_is_the_nearest_by_brute_force(channels, shared, k, reach, size):
    generator = torch.Generator().manual_seed(k)
    features = torch.randn(2, 4 * size, channels, generator=generator)
    times = torch.arange(4.0).repeat_interleave(size).expand(2, -1)
    found = frame_graph(features, times, k, reach, shared)
    for cloud, expected in zip(features, found):
        assert torch.equal(graph_by_hand(cloud, size, k, reach, shared), expected)


@pytest.mark.parametrize("backend", ["numba", "torch"])
def test_features_far_from_the_origin_and_in_pieces_give_the_same_graph(backend, monkeypatch):
    monkeypatch.setenv("DPC_BACKEND", backend)
    features = torch.randn(2, 40, 6, generator=torch.Generator().manual_seed(1))
    times = torch.arange(4.0).repeat_interleave(10).expand(2, -1)
    near = frame_graph(features, times, 6, 1, True)
    monkeypatch.setattr("dpcli.classify.network.backbones.frame_graph._DISTANCES", 1)
    monkeypatch.setattr("dpcli.classify.network.backbones.frame_graph._PAIRS", 700)  # two frames, then the rest
    assert torch.equal(frame_graph(features + 300, times, 6, 1, True), near)


@pytest.mark.parametrize("channels", [3, 16])
@pytest.mark.parametrize(("k", "reach", "shared"), [(20, 1, True), (12, 3, False), (20, 0, True)])
def test_the_kernel_s_graph_is_torch_s(channels, k, reach, shared, monkeypatch):
    """Frames of 70 points, more than a row of the kernel's vectors, and, in coordinates, many equal distances."""
    features = torch.randn(2, 5 * 70, channels, generator=torch.Generator().manual_seed(k))
    features = (2 * features).round() if channels == 3 else features
    times = torch.arange(5.0).repeat_interleave(70).expand(2, -1)
    found = frame_graph(features, times, k, reach, shared)
    with monkeypatch.context() as patch:
        patch.setattr("dpcli.classify.network.backbones.frame_graph._ALL_PAIRS", 69)
        searched = frame_graph(features, times, k, reach, shared)
    monkeypatch.setenv("DPC_BACKEND", "torch")
    expected = frame_graph(features, times, k, reach, shared)
    assert torch.equal(found, expected) and torch.equal(searched, expected)


def test_values_that_are_no_numbers_end_in_a_graph_still():
    """A diverging network is told by its loss; until then no index may leave the cloud, nor a good point lose its own."""
    features = torch.randn(1, 12, 5, generator=torch.Generator().manual_seed(0))
    features[0, 4] = float("nan")
    found = frame_graph(features, torch.arange(3.0).repeat_interleave(4)[None], 5, 1, True)
    assert found.min() >= 0 and found.max() < 12
    points = features[..., :3].clone()
    points[0, 4] = 1e30  # its squares are infinite
    found = frame_graph(points, torch.arange(3.0).repeat_interleave(4)[None], 5, 1, True)[0]
    good = torch.arange(12) != 4
    assert torch.equal(found[good, 0], torch.arange(12)[good]) and found.max() < 12


def test_points_that_stand_still_find_themselves_first():
    points = torch.randn(1, 5, 3, generator=torch.Generator().manual_seed(0)).repeat(1, 3, 1)
    found = frame_graph(points, torch.arange(3.0).repeat_interleave(5)[None], 6, 1, True)[0]
    assert torch.equal(found[:, 0], torch.arange(15))


def test_shares_sum_to_k_and_are_the_same_backwards():
    for k, frames, reach in [(20, 16, 1), (20, 3, 2), (5, 1, 1), (7, 2, 3)]:
        rows = frame_shares(k, frames, reach)
        assert all(sum(row.values()) == k for row in rows)
        assert [{-d: n for d, n in row.items()} for row in rows[::-1]] == rows
    assert frame_shares(20, 16, 1)[5] == {-1: 6, 0: 8, 1: 6}


@pytest.mark.parametrize("times", [[0, 0, 1, 1, 1, 2], [0, 1, 0, 1, 0, 1], [0, 0, 0, 2, 2, 2]])
def test_frames_of_unequal_size_or_mixed_are_refused(times):
    with pytest.raises(ValueError, match="equally many points"):
        frame_graph(torch.zeros(1, 6, 3), torch.tensor([times]).float(), 2, 1, True)


# ---- layers


def edge_conv_by_hand(layer: EdgeConv, features, idx):
    """Gather, concatenate, linear layer, torch's batch norm over all edges, ReLU: (B,N,K,width)."""
    batch = torch.arange(len(features))[:, None, None]
    neighbor, own = features[batch, idx], features[:, :, None].expand(*idx.shape, -1)
    edges = layer.linear(torch.cat([own, neighbor - own], -1))
    return torch.relu(layer.norm(edges.flatten(0, 2)).view_as(edges))


@pytest.mark.parametrize("training", [True, False])
def test_edge_conv_is_its_definition(training):
    torch.manual_seed(0)
    layer = trained_norms(EdgeConv(3, 10).double()).train(training)
    assert (layer.norm.weight < 0).any()
    plain = copy.deepcopy(layer)
    features = torch.randn(2, 9, 3, dtype=torch.float64, requires_grad=True)
    idx = torch.stack([torch.randperm(9)[:4] for _ in range(18)]).view(2, 9, 4)
    expected = edge_conv_by_hand(plain, features, idx)
    if not training:
        torch.testing.assert_close(layer.activations(features, idx), expected)
    torch.testing.assert_close(layer(features, idx), expected.amax(2))
    torch.testing.assert_close(layer.norm.running_mean, plain.norm.running_mean)
    torch.testing.assert_close(layer.norm.running_var, plain.norm.running_var)
    weight = torch.randn(2, 9, 10, dtype=torch.float64)
    for pooled, module in ((layer(features, idx), layer), (expected.amax(2), plain)):
        module.zero_grad()
        module.found = torch.autograd.grad((pooled * weight).sum(), [features, *module.parameters()])
    for ours, theirs in zip(layer.found, plain.found):
        torch.testing.assert_close(ours, theirs)


def test_edge_conv_s_gradients_are_finite_differences():
    torch.manual_seed(0)
    layer = trained_norms(EdgeConv(2, 4).double())
    idx = torch.stack([torch.randperm(5)[:3] for _ in range(5)])[None]
    names = list(dict(layer.named_parameters()))

    def run(features, *parameters):
        return torch.func.functional_call(copy.deepcopy(layer), dict(zip(names, parameters)), (features, idx))

    inputs = [torch.randn(1, 5, 2, dtype=torch.float64), *(p.detach().clone() for p in layer.parameters())]
    assert torch.autograd.gradcheck(run, [value.requires_grad_() for value in inputs], atol=1e-6)


def test_statistics_of_edges_far_from_the_origin_keep_their_digits():
    """In float32, with means a thousand times the spread, in value like the edges written out."""
    generator = torch.Generator().manual_seed(0)
    neighbor, own = torch.randn(2, 30, 4, generator=generator) + 1000, torch.randn(2, 30, 4, generator=generator) - 300
    idx = torch.randint(0, 30, (2, 30, 5), generator=generator)
    gathered = torch.stack([cloud[rows] for cloud, rows in zip(neighbor, idx)])
    found = edge_statistics(neighbor, own, idx, gathered.sum(2))
    var, mean = torch.var_mean((gathered + own[:, :, None]).double(), (0, 1, 2), correction=0)
    torch.testing.assert_close(found[0].double(), mean, rtol=1e-6, atol=0)
    torch.testing.assert_close(found[1].double(), var, rtol=1e-3, atol=0)


@pytest.mark.parametrize("backend", ["numba", "torch"])
def test_pooling_in_pieces_is_gather_and_amax_ties_included(backend, monkeypatch):
    monkeypatch.setenv("DPC_BACKEND", backend)
    values = (
        torch.randn(2, 7, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).round().requires_grad_()
    )
    idx = torch.randint(0, 7, (2, 7, 4), generator=torch.Generator().manual_seed(1))
    gathered = torch.stack([cloud[rows] for cloud, rows in zip(values, idx)])
    expected = gathered.amax(2), gathered.sum(2)
    weights = torch.randn(2, 2, 7, 3, dtype=torch.float64)
    for piece in (1 << 18, 30):
        monkeypatch.setattr("dpcli.classify.network.backbones.frame_graph._PIECE", piece)
        found = pool_edges(values, idx)
        for ours, theirs, weight in zip(found, expected, weights):
            torch.testing.assert_close(ours, theirs)
            both = [
                torch.autograd.grad((value * weight).sum(), values, retain_graph=True)[0] for value in (ours, theirs)
            ]
            torch.testing.assert_close(*both)


def test_spider_conv_is_a_loop_over_points_and_neighbors():
    torch.manual_seed(0)
    layer = trained_norms(SpiderConv(2, 8, 3, 4).double())
    nn.init.normal_(layer.bias)
    nn.init.normal_(layer.taylor.bias)
    points, features = torch.randn(1, 6, 3).double(), torch.randn(1, 6, 2).double()
    idx = torch.stack([torch.randperm(6)[:4] for _ in range(6)])[None]
    offsets = points[0, idx[0]] - points[0][:, None]
    summed = torch.zeros(6, 8, dtype=torch.float64)
    for i, k in itertools.product(range(6), range(4)):
        x, y, z = offsets[i, k].tolist()
        terms = torch.tensor(
            [x**a * y**b * z**c for a in range(4) for b in range(4) for c in range(4) if 0 < a + b + c < 4]
        )
        taylor = layer.taylor.weight @ terms.double() + layer.taylor.bias
        for c, t in itertools.product(range(2), range(3)):
            summed[i] += layer.kernel[k, 3 * c + t] * features[0, idx[0, i, k], c] * taylor[t]
    summed = summed + layer.bias
    groups = summed.view(6, 8, 1).permute(1, 2, 0)  # 8 groups of one channel: gcd(16, 8)
    normed = (groups - groups.mean((1, 2), True)) / (groups.var((1, 2), correction=0, keepdim=True) + 1e-6).sqrt()
    expected = torch.relu(normed[:, 0].T * layer.norm.weight + layer.norm.bias)
    powers = monomials(offsets[None])
    torch.testing.assert_close(layer(features, idx, powers)[0], expected, rtol=1e-5, atol=1e-6)
    terms, out = layer.contributions(features, idx, powers)
    torch.testing.assert_close(out[0], expected, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(terms.sum(2)[0] + layer.bias, summed, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("piece", [1 << 18, 7])
@pytest.mark.parametrize("backend", ["numba", "torch"])
def test_ranked_products_have_the_gradients_of_finite_differences(backend, piece, monkeypatch):
    monkeypatch.setenv("DPC_BACKEND", backend)
    monkeypatch.setattr("dpcli.classify.network.backbones.spidercnn._PIECE", piece)
    generator = torch.Generator().manual_seed(0)
    shapes = (1, 3, 4, 2), (1, 3, 4, 3), (4, 6, 5)
    inputs = [torch.randn(*s, dtype=torch.float64, generator=generator).requires_grad_() for s in shapes]
    assert torch.autograd.gradcheck(_RankedProducts.apply, inputs)
    gathered, taylor, kernel = (value.detach() for value in inputs)
    products = (gathered[..., :, None] * taylor[..., None, :]).flatten(-2)
    expected = torch.einsum("bnki,kiw->bnkw", products, kernel)
    torch.testing.assert_close(_terms(gathered, taylor, kernel), expected)
    with torch.no_grad():
        torch.testing.assert_close(_terms(gathered, taylor, kernel), expected)
    torch.testing.assert_close(_RankedProducts.apply(gathered, taylor, kernel), expected.sum(2))


@pytest.mark.parametrize("training", [True, False])
def test_a_pooled_dense_layer_is_its_definition(training):
    """Values, gradients of everything and running statistics, with norms of both signs, far from the origin."""
    torch.manual_seed(0)
    layer = trained_norms(Dense(6, 12).double()).train(training)
    assert (layer.norm.weight < 0).any() and (layer.norm.weight > 0).any()
    plain = copy.deepcopy(layer)
    values = (torch.randn(3, 11, 6, dtype=torch.float64) + 40).requires_grad_()
    weight = torch.randn(3, 12, dtype=torch.float64)
    ours, theirs = layer.pool(values), plain(values).amax(1)
    assert (theirs > 0).any()
    torch.testing.assert_close(ours, theirs)
    grads = [
        torch.autograd.grad((out * weight).sum(), [values, *module.parameters()])
        for out, module in ((ours, layer), (theirs, plain))
    ]
    for one, other in zip(*grads):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-9)
    for one, other in zip(layer.buffers(), plain.buffers()):
        torch.testing.assert_close(one, other)


def test_a_pooled_dense_layer_of_one_row_has_the_running_statistics():
    layer = trained_norms(Dense(4, 5)).train()
    row = torch.randn(1, 1, 4)
    torch.testing.assert_close(layer.pool(row), layer(row)[:, 0])


def test_statistics_of_an_image_far_from_the_origin_keep_their_digits():
    generator = torch.Generator().manual_seed(0)
    rows, weight = torch.randn(500, 6, generator=generator) + 1000, torch.randn(9, 6, generator=generator)
    mean, var = image_statistics(rows, weight)
    image = rows.double() @ weight.double().T
    torch.testing.assert_close(mean.double(), image.mean(0), rtol=1e-5, atol=1e-3)
    torch.testing.assert_close(var.double(), image.var(0, correction=0), rtol=1e-4, atol=0)


# ---- networks


@pytest.mark.parametrize("backbone", TINY)
def test_taps_give_the_logits_of_the_static_stream(backbone):
    torch.manual_seed(0)
    model = trained_norms(Kinet(tiny(backbone))).eval()
    clip = body_like_clip(4, 12, 2)
    stages, logits = model.static.taps(model.group(clip))
    torch.testing.assert_close(logits, model.static_logits(clip), rtol=1e-4, atol=1e-5)
    widths = tuple(tuple(a.shape[-1] for a in stage.activations) for stage in stages)
    assert widths == tuple(model.static.tap_widths)
    for stage in stages:
        assert stage.grouping.idx.shape == stage.activations[0].shape[:3] == (2, 48, model.config.neighbors)


@pytest.mark.parametrize("backbone", ["dgcnn", "spidercnn"])
@pytest.mark.parametrize("grouping", ["balanced", "nearest"])
def test_order_of_points_and_direction_of_time(backbone, grouping):
    """Order within a frame changes nothing; a clip backwards is the same to the static stream, another to the dynamic."""
    torch.manual_seed(0)
    model = trained_norms(Kinet(tiny(backbone, grouping=grouping))).eval()
    clip = body_like_clip(4, 12, 2)
    with torch.no_grad():
        static, dynamic = model(clip)
        shuffled = model(torch.stack([frame[:, torch.randperm(12)] for frame in clip.unbind(1)], 1))
        backwards = model(clip.flip(1))
    torch.testing.assert_close(shuffled, (static, dynamic), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(backwards[0], static, rtol=1e-3, atol=1e-4)
    assert (backwards[1] - dynamic).abs().max() > 1e-3


@pytest.mark.parametrize("backbone", TINY)
def test_each_stage_trains_its_own_parameters(backbone):
    torch.manual_seed(0)
    model = Kinet(tiny(backbone, dropout=0.5))
    clip, labels = body_like_clip(4, 12, 3) + torch.randn(3, 1, 1, 1), torch.arange(3)
    model.static.train()
    cross_entropy(model.static_logits(clip), labels).backward()
    for name, parameter in model.static.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.any() or name.startswith("transform") or "linear.bias" in name or name.endswith("bias"), (
            name
        )
    assert all(p.grad is None for p in model.dynamic.parameters())
    model.zero_grad()
    model.freeze_static()
    model.dynamic.train()
    before = copy.deepcopy(model.static.state_dict())
    cross_entropy(model.dynamic_logits(clip), labels).backward()
    for name, parameter in model.dynamic.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name
    assert all(p.grad is None for p in model.static.parameters())
    assert all(torch.equal(before[key], value) for key, value in model.static.state_dict().items())


@pytest.mark.parametrize("backbone", ["dgcnn", "spidercnn"])
def test_a_training_batch_may_be_a_single_clip(backbone):
    model = Kinet(tiny(backbone))
    model.static.train()
    logits = model.static_logits(body_like_clip(4, 12, 1))
    assert torch.isfinite(logits).all()


@pytest.mark.parametrize("backbone", ["dgcnn", "spidercnn"])
def test_norms_over_processes_give_the_same_network(backbone, monkeypatch):
    """With one process, whose sums over processes are its own."""
    monkeypatch.setattr("dpcli.classify.network.sync_norm._summed", lambda values: values)
    torch.manual_seed(0)
    plain = trained_norms(build_backbone(tiny(backbone))).train()
    shared = synchronize_norms(copy.deepcopy(plain))
    groups = plain.group(*clip_points(body_like_clip(4, 12, 3)))
    logits, same = plain(groups), shared(groups)
    torch.testing.assert_close(same, logits, rtol=1e-3, atol=1e-4)
    logits.square().sum().backward()
    same.square().sum().backward()
    for (name, ours), theirs in zip(plain.named_parameters(), shared.parameters()):
        assert torch.allclose(theirs.grad, ours.grad, rtol=1e-2, atol=1e-3), name
    for ours, theirs in zip(plain.buffers(), shared.buffers()):
        torch.testing.assert_close(theirs, ours, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("backbone", ["dgcnn", "spidercnn"])
def test_products_in_bfloat16_keep_the_graph_and_nearly_the_logits(backbone, monkeypatch):
    monkeypatch.setenv("DPC_BACKEND", "torch")
    torch.manual_seed(0)
    model = Kinet(tiny(backbone)).eval()
    clip = body_like_clip(4, 12, 3) + 5
    exact, graph = model.static_logits(clip), model.group(clip)[0].idx
    with reduced_products(torch.device("cpu"), True):
        assert torch.equal(model.group(clip)[0].idx, graph)
        reduced = model.static_logits(clip).float()
        torch.testing.assert_close(reduced, exact, rtol=0.05, atol=0.02)
        model.static.train()
        loss = cross_entropy(model.static_logits(clip).float(), torch.arange(3))
    loss.backward()
    assert all(torch.isfinite(p.grad).all() for p in model.static.parameters())


def test_the_input_transform_starts_as_the_identity():
    torch.manual_seed(0)
    network = build_backbone(tiny("dgcnn")).eval()
    points, times = clip_points(body_like_clip(4, 12))
    torch.testing.assert_close(network.transform(points, network.group(points, times)[0].idx), points)


@pytest.mark.parametrize("backbone", BACKBONE_CHANGES)
@pytest.mark.parametrize("preset", ["thesis", "release", "quick", "tiny"])
def test_every_preset_has_the_backbone(backbone, preset):
    config = PRESETS[preset]["network"].changed(merge="cross", grouping="first")  # as variant = release has them
    with torch.device("meta"):
        model = Kinet(config.changed(**backbone_changes(preset, backbone)))
    assert isinstance(model.static, {"dgcnn": DGCNN, "spidercnn": SpiderCNN}[backbone])
    few, many = {"tiny": (0, 1e5), "quick": (3e5, 6e5)}.get(preset, (2e6, 1e7))
    assert few < count_parameters(model) < many


def test_a_user_s_backbone_keeps_the_preset():
    config = PRESETS["tiny"]["network"]
    assert config.changed(**backbone_changes("tiny", "mine:Net")) == config.changed(backbone="mine:Net")


# ---- a user's own


def test_the_document_s_backbone_is_the_one_tested():
    text = (ROOT / "docs" / "backbones.md").read_text()
    assert (ROOT / "tests" / "support" / "tiny_backbone.py").read_text() in text


@pytest.mark.parametrize("backbone", TINY)
def test_time_s_direction_is_learned_by_the_dynamic_stream(backbone):
    """Four clips and the same backwards: one graph each, so no static stream can do better than half."""
    torch.manual_seed(0)
    model = Kinet(tiny(backbone, num_classes=2, merge_norm=True, neighbors=9))
    clips = body_like_clip(4, 12, 4) * (1 + torch.arange(4.0) / 4)[:, None, None, None]
    clips += torch.arange(4.0)[None, :, None, None] * torch.tensor([0.3, 0.1, 0.0])
    clips, labels = torch.cat([clips, clips.flip(1)]), torch.arange(8) // 4
    fit(model.static.train(), lambda: cross_entropy(model.static_logits(clips), labels), 1e-2, 10)
    model.freeze_static()
    fit(model.dynamic, lambda: cross_entropy(model.dynamic_logits(clips), labels), 1e-2, 25)
    with torch.no_grad():
        static, dynamic = (logits.argmax(-1).eq(labels).float().mean().item() for logits in model.eval()(clips))
    assert static == 0.5 and dynamic == 1.0


def fit(network, loss, rate, steps):
    optimizer = torch.optim.Adam(network.parameters(), rate)
    for _ in range(steps):
        optimizer.zero_grad()
        loss().backward()
        assert all(torch.isfinite(p.grad).all() for p in network.parameters())
        optimizer.step()


def test_a_model_file_knows_its_backbone(tmp_path):
    """Weights of one never get into another; a user's own is imported only when its name is typed."""
    paths = {}
    for backbone in TINY:
        model = Kinet(tiny(backbone))
        paths[backbone] = tmp_path / f"{backbone.partition(':')[0]}.safetensors"
        save_model(paths[backbone], model, ModelInfo(model.config, ["a", "b", "c"]))
    clip = body_like_clip(4, 12)
    for backbone in ("dgcnn", "spidercnn"):
        model, _ = load_model(str(paths[backbone]))
        assert torch.isfinite(model(clip)[1]).all()
    with pytest.raises(UsageError, match="code of yours.*--backbone tests.support.tiny_backbone:TinyBackbone"):
        load_model(str(paths["tests.support.tiny_backbone:TinyBackbone"]))
    own = load_model(
        str(paths["tests.support.tiny_backbone:TinyBackbone"]), "tests.support.tiny_backbone:TinyBackbone"
    )[0]
    assert isinstance(own.static, TinyBackbone)
    mixed = tmp_path / "mixed.safetensors"
    save_model(mixed, Kinet(tiny("dgcnn")), ModelInfo(tiny("spidercnn"), ["a", "b", "c"]))
    with pytest.raises(DataError, match="mixed.safetensors"):
        load_model(str(mixed))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nonsense", "expected pointnet2, dgcnn, spidercnn, slots or your own as module:Class"),
        ("nonsense:Thing", "No module named 'nonsense'; is its folder on PYTHONPATH"),
        ("tests.support.tiny_backbone:Thing", "no attribute 'Thing'"),
        ("tests.support.tiny_backbone:annotations", "lacks group, taps"),
        ("torch.nn:Linear", "lacks group, taps;"),
        ("dpcli.classify.network.backbones.interface:Backbone", "lacks group, taps, forward;"),
    ],
)
def test_names_that_are_no_backbone(name, message):
    with pytest.raises(UsageError) as error:
        resolve_backbone(name)
    assert message in str(error.value)


@pytest.mark.parametrize("backbone", ["dgcnn", "spidercnn"])
def test_widths_of_another_backbone_are_refused(backbone):
    with pytest.raises(UsageError, match=f"backbone = {backbone}: widths = .*expected numbers like"):
        Kinet(KinetConfig(backbone=backbone))


@pytest.mark.parametrize("backbone", ["pointnet2", "dgcnn", "spidercnn"])
def test_a_clip_is_scored_alike_to_the_bit_whatever_is_beside_it(backbone):
    """Else a video's scores would hang on the batch."""
    torch.manual_seed(0)
    changes = {"num_classes": 7, "num_frames": 4, **backbone_changes("tiny", backbone)}
    network = Kinet(PRESETS["tiny"]["network"].changed(**changes)).eval()
    clips = torch.randn(5, 4, network.config.points_per_frame, 3) * 0.3
    with torch.inference_mode():
        whole = torch.stack(network(clips))
        for size in (1, 2, 3):
            assert torch.equal(whole, torch.cat([torch.stack(network(some)) for some in clips.split(size)], 1)), size
