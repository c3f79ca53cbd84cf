"""`dpc classify explain`: activations against loops, finite differences and planted regions; videos in the plane."""

from __future__ import annotations

import copy
import dataclasses
import io
import json
import sys
import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch import nn

from dpcli.classify.commands.explain_pac import chosen_samples
from dpcli.classify.data.clips import ClipSource, normalize
from dpcli.classify.data.likeness import NOTE, file_like
from dpcli.classify.explain.features import ClipVectors, Layer, stage_layer
from dpcli.classify.explain.point_activation_cloud import (
    Question,
    _in_network_coordinates,
    activation_cloud,
    carry,
    centroid_activation,
    channel_weights,
    frame_length,
    raw_points,
    rescaled,
)
from dpcli.classify.explain.tsne import chosen_perplexity, neighbor_accuracy, plane, silhouette, video_features
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network.model_file import ModelInfo, save_model
from dpcli.classify.network_speed import body_like_clip
from dpcli.errors import DataError, UsageError
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter
from dpcli.store.embedding import EmbeddingReader
from dpcli.store.joints import no_joints

pytestmark = pytest.mark.usefixtures("one_thread")
CPU = torch.device("cpu")
TINY = {
    "num_classes": 3,
    "num_frames": 4,
    "points_per_frame": 32,
    "centroids": (24, 12),
    "neighbors": 6,
    "widths": ((8, 16), (16, 24), (24, 32)),
}
NAMES = ["wave", "kick", "bend"]


def network(**changes) -> Kinet:
    """Untrained, with statistics, biases and logits that are no special case."""
    torch.manual_seed(0)
    model = Kinet(KinetConfig(**{**TINY, "solver": "ridge", **changes})).eval()
    with torch.no_grad():
        for module in model.modules():
            if isinstance(module, nn.BatchNorm1d):
                module.running_mean.uniform_(-0.2, 0.2)
                module.running_var.uniform_(0.5, 1.5)
        for head in (model.static.head, model.dynamic.head):
            head.classify.weight.normal_()
    return model


@pytest.fixture(scope="module")
def model() -> Kinet:
    return network()


FIELDS = ("part", "joint", "field_speed")


def blobs(path: Path, videos: int = 6, labeled: bool = True) -> Path:
    rng = np.random.default_rng(0)
    with CloudsWriter(path, class_names=NAMES if labeled else (), fields=FIELDS) as writer:
        for i in range(videos):
            frames = [rng.normal(size=(40, 3)) * 0.3 + [0.1 * t * (i % 3), 0, 2] for t in range(5)]
            parts = [np.arange(40) % 3 for _ in frames]
            label = i % 3 if labeled else -1
            sequence = CloudSequence.from_frames(f"v{i}", frames, label=label, part=parts, joint=no_joints(5, 3))
            sequence.extra["field_speed"] = np.arange(200, dtype=np.float32) + i
            writer.write(sequence)
    return path


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return blobs(tmp_path_factory.mktemp("explain") / "clouds.h5")


@pytest.fixture(scope="module")
def weights(data, model) -> Path:
    path = data.with_name("model.safetensors")
    save_model(path, model, ModelInfo(model.config, NAMES, "clips", {}))
    return path


# --- eq. A.2 and Grad-CAM on the network


@pytest.mark.parametrize("within_frames", [False, True])
def test_equation_a2_in_loops(model, within_frames):
    """max over channels and neighbors of relu(bn2(W2 relu(bn1(W1 (x_j - x_i))))), centroid by centroid in float64; also of a
    static stream whose neighborhoods are its own."""
    if within_frames:
        plain, model = model, Kinet(model.config.changed(static_temporal_radius=0)).eval()
        model.load_state_dict(plain.state_dict())
        assert not torch.equal(model.group(body_like_clip(4, 32))[0].idx, plain.group(body_like_clip(4, 32))[0].idx)
    points = body_like_clip(4, 32)
    layer = stage_layer(model, points, "static", 0, None)
    group, stage = model.group(points)[0], copy.deepcopy(model.static.stage1).double()
    by_hand = []
    stage.requires_grad_(False)
    for center, neighbors in zip(group.centers[0], group.idx[0]):
        values = []
        for j in neighbors:
            hidden = torch.relu(stage.norm1(stage.linear1((group.points[0, j] - center).double()[None])))
            values.append(float(torch.relu(stage.norm2(stage.linear2(hidden))).max()))
        by_hand.append(max(values))
    np.testing.assert_allclose(centroid_activation(layer).numpy(), by_hand, rtol=1e-5)
    assert len(set(by_hand)) > 10 and torch.equal(layer.times, group.center_times[0])


def double(stage):
    given = {key: value for key, value in vars(stage).items() if value is not None}
    values = {key: value.double() if value.is_floating_point() else value for key, value in given.items()}
    return dataclasses.replace(stage, **values)


def rest_of_network(model: Kinet, points: torch.Tensor, stream: str, stage: int):
    """features (M,C) -> logits in float64, by the layers that follow them."""
    groups = [double(group) for group in model.group(points)]
    twin = copy.deepcopy(model).double()
    head = getattr(twin, stream).head
    if stage == 1:
        return lambda features: head(groups[1].centers, features[None])
    if stream == "static":
        return lambda features: head(groups[1].centers, twin.static.stage2(groups[1], features[None]))
    normals: list[torch.Tensor] = []
    hook = model.dynamic.merge.register_forward_pre_hook(lambda _, inputs: normals.extend(inputs[1]))
    model(points)
    hook.remove()
    merge = twin.dynamic.merge

    def follow(features: torch.Tensor) -> torch.Tensor:
        state = features[None][:, groups[1].idx[0]].mean(2)
        for level in (2, 3):
            mixed = merge.abstract[level](normals[level].double()) + merge.align[level - 1](state)
            state = torch.relu(merge.norms[level](mixed.flatten(0, 1)).view_as(mixed))
        return head(groups[1].centers, state)

    return follow


@pytest.mark.parametrize(("stream", "stage"), [("static", 0), ("static", 1), ("dynamic", 0), ("dynamic", 1)])
def test_gradient_weights_are_autograd_s_and_finite_differences_in_float64(stream, stage):
    """Shifting channel k at all M centroids by e changes the logit by e * M * weight_k."""
    model, points = network(merge_norm=True), body_like_clip(4, 32)
    layers = [stage_layer(model, points, stream, stage, target) for target in range(3)]
    target = next(target for target, layer in enumerate(layers) if centroid_activation(layer).max() > 0)
    layer = layers[target]
    follow = rest_of_network(model, points, stream, stage)
    values = layer.values.double().requires_grad_()
    reference = torch.autograd.grad(follow(values)[0, target], values)[0]
    np.testing.assert_allclose(layer.gradient.numpy(), reference.numpy(), rtol=1e-3, atol=1e-5)
    step, shift = 1e-7, torch.eye(values.shape[1], dtype=torch.float64)
    with torch.no_grad():
        differences = [(follow(values + step * k) - follow(values - step * k))[0, target] / (2 * step) for k in shift]
    expected = torch.stack(differences).numpy() / len(values)
    found = channel_weights(layer).numpy()
    agree = dict(rtol=2e-3, atol=1e-5 * max(1, np.abs(expected).max()))
    np.testing.assert_allclose(found, expected, **agree)
    assert not np.allclose(np.roll(found, 1), expected, **agree)  # a twin with permuted channels is told
    by_hand = np.maximum(layer.values.numpy() @ expected, 0)
    np.testing.assert_allclose(centroid_activation(layer).numpy(), by_hand, rtol=1e-2, atol=1e-4)
    logits = model(points)[stream == "dynamic"]
    np.testing.assert_allclose(follow(values.detach())[0].detach(), logits[0].detach(), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("rule", ["activation", "gradient"])
def test_the_published_merge_is_explained_at_its_last_stage_and_its_first_activations(rule):
    model, points = Kinet(KinetConfig.release(**TINY)).eval(), body_like_clip(4, 32)
    target = 1 if rule == "gradient" else None
    assert stage_layer(model, points, "dynamic", None, target).values.shape == (12, model.dynamic.merge.channels)
    if rule == "gradient":
        with pytest.raises(UsageError, match="last stage"):
            stage_layer(model, points, "dynamic", 0, target)
    else:
        assert stage_layer(model, points, "dynamic", 0, None).values.shape[0] == 24
    with pytest.raises(UsageError, match="expected 1..2"):
        stage_layer(model, points, "static", 4, target)


# --- planted regions


def pass_through(layers, channels: dict[int, tuple[int, float]]) -> None:
    """linear1's channel c reads input `channels[c][0]` plus a bias, linear2 copies; norms are the identity."""
    with torch.no_grad():
        for parameter in layers.parameters():
            parameter.zero_()
        for norm in (layers.norm1, layers.norm2):
            norm.weight.fill_(1)
            norm.running_mean.zero_()
            norm.running_var.fill_(1)
        for channel, (source, bias) in channels.items():
            layers.linear1.weight[channel, source] = 1
            layers.linear1.bias[channel] = bias
            layers.linear2.weight[channel, channel] = 1


def rods(path: Path) -> Path:
    """Part 0: a rod along x; part 1: a rod along y, five units away."""
    line = np.linspace(-0.4, 0.4, 16)
    still = np.concatenate([np.stack([line, 0 * line, 0 * line], 1), np.stack([0 * line + 5, line, 0 * line], 1)])
    with CloudsWriter(path, class_names=NAMES, fields=["part"]) as writer:
        parts = np.repeat([0, 1], 16)
        writer.write(CloudSequence.from_frames("rods", [still] * 4, label=0, part=[parts] * 4))
    return path


def test_each_class_lights_up_the_region_its_logit_looks_at(tmp_path):
    """Channel 0 measures extent along x, channel 1 along y; class 0 reads the first, class 1 the second."""
    model = network()
    for layers, first in ((model.static.stage1, 0), (model.static.stage2, 3), (model.static.head, 3)):
        pass_through(layers, {0: (first, 0.0), 1: (first + 1, 0.0)})
    with torch.no_grad():
        model.static.head.classify.weight[0, 0] = model.static.head.classify.weight[1, 1] = 1
    source = ClipSource(CloudsReader(rods(tmp_path / "rods.h5")), [0], model.config)
    clip = source.clips(1)[0]
    for target in (0, 1):
        cloud = activation_cloud(model, source, clip, ("static",), Question("gradient", None, target), CPU)
        values, inside = cloud.activation["static"], cloud.sequence.part == target
        assert values[inside].mean() > 0.7 and values[~inside].mean() < 0.02
        assert values.min() == 0 and values.max() == 1 and cloud.target == target
    with torch.no_grad():
        model.static.stage1.linear1.weight[1] = 0  # what has no class: only extent along x is left to act
    cloud = activation_cloud(model, source, clip, ("static",), Question(), CPU)
    values, inside = cloud.activation["static"], cloud.sequence.part == 0
    assert values[inside].mean() > 0.4 and values[~inside].mean() < 0.02 and cloud.target == -1


def test_the_dynamic_stream_lights_up_what_moves_and_time_gone_it_does_not(tmp_path):
    """Two equal blobs, one moving along x: the surface tau(x) is steep for it and flat for the other (eq. 3.5)."""
    rng = np.random.default_rng(0)
    shape = rng.uniform(-0.05, 0.05, (8, 3))
    sizes = {"points_per_frame": 16, "neighbors": 24, "weighting": "none", "grouping": "balanced"}
    model = network(**sizes)
    # relu(x + 1) is linear within the radius
    pass_through(model.static.stage1, {axis: (axis, 1.0) for axis in range(3)})
    with torch.no_grad():
        for level in (0, 1):
            unit = model.dynamic.units[level]
            unit.reduce.weight.zero_()
            unit.reduce.bias.zero_()
            for group in range(unit.groups):
                unit.reduce.weight[4 * group : 4 * group + 3, :3] = torch.eye(3)
            model.dynamic.merge.abstract[level].weight.zero_()
            model.dynamic.merge.abstract[level].bias.zero_()
        model.dynamic.merge.align[0].weight.zero_()
        model.dynamic.merge.align[0].bias.zero_()
        model.dynamic.merge.abstract[1].weight[0, 0] = 1  # the x component of the first group's normal
    found = {}
    for speed in (0.15, 0.0):
        path = tmp_path / f"{speed}.h5"
        with CloudsWriter(path, fields=["part"]) as writer:
            frames = [np.concatenate([shape + [speed * t, 0, 0], shape + [5, 0, 0]]) for t in range(4)]
            writer.write(CloudSequence.from_frames("two", frames, part=[np.repeat([0, 1], 8)] * 4))
        source = ClipSource(CloudsReader(path), [0], model.config)
        points = torch.from_numpy(raw_points(source, source.clips(1)[0]))[None]
        layer = stage_layer(model, points, "dynamic", 0, None)
        moving = layer.centers[:, 0] < 2.5
        value = centroid_activation(layer)
        exact = stage_layer(copy.deepcopy(model).double(), points.double(), "dynamic", 0, None)
        torch.testing.assert_close(value, centroid_activation(exact).float(), rtol=1e-3, atol=1e-4)
        found[speed] = float(value[moving].mean()), float(value[~moving].mean())
        if speed:
            cloud = activation_cloud(model, source, source.clips(1)[0], ("dynamic",), Question(), CPU)
            own = cloud.sequence.part == 0
            assert cloud.activation["dynamic"][own].mean() > 10 * cloud.activation["dynamic"][~own].mean()
    # n_x of an exact fit: 1 / sqrt(1 + speed^2). The ridge spreads the mean time of one-sided neighborhoods, at the clip's ends,
    # over a blob's nearly constant features: 0.08 is what float64 has for a still one.
    assert found[0.15][0] > 0.7 and found[0.15][1] < 0.1
    assert found[0.0][0] < 0.1  # the same blob, standing still


# --- from centroids to points


def test_values_are_carried_from_the_three_nearest_centroids_in_space_and_time():
    rng = np.random.default_rng(1)
    centers, times = rng.normal(size=(12, 3)).astype(np.float32), np.repeat([0, 1, 3], 4).astype(np.float32)
    values = rng.uniform(size=12).astype(np.float32)
    queries = [rng.normal(size=(n, 3)).astype(np.float32) for n in (5, 0, 7, 1)]
    layer = Layer(torch.from_numpy(centers), torch.from_numpy(times), torch.zeros(12, 1))
    for length in (0.4, 100.0):
        found = carry(layer, torch.from_numpy(values), queries, length)
        for t, (query, got) in enumerate(zip(queries, found)):
            assert got.shape == (len(query),) and got.dtype == np.float32
            for point, value in zip(query.astype(np.float64), got):
                squared = ((centers - point) ** 2).sum(1) + (length * (times - t)) ** 2
                near = np.argsort(squared)[:3]
                assert value == pytest.approx(np.average(values[near], weights=1 / squared[near]), rel=1e-5)
                if length == 100 and t != 2:
                    assert (times[near] == t).all()  # long frames: only the point's own counts, where it has centroids
    there = carry(layer, torch.from_numpy(values), [centers[:4]], 0.4)[0]  # on a centroid: its own value
    np.testing.assert_allclose(there, values[:4], rtol=1e-4)
    assert frame_length(KinetConfig(radii=(0.6, 1.2), temporal_radius=2)) == pytest.approx(0.2)


@pytest.mark.parametrize("rule", ["none", "center", "height", "unit", "image"])
def test_all_points_go_where_normalization_took_the_drawn_ones(data, rule):
    config = KinetConfig(**{**TINY, "points_per_frame": 40}, normalize=rule)  # all points are drawn
    source = ClipSource(CloudsReader(data), [0], config)
    clip = source.clips(1)[0]
    drawn = raw_points(source, clip)
    moved = normalize(drawn, rule)
    np.testing.assert_array_equal(moved, source.load_shown(clip))  # prediction's own points
    queries = _in_network_coordinates(source.reader.read(0, clip.frames), drawn, moved)
    for query, frame in zip(queries, moved):
        distance = np.linalg.norm(query[:, None] - frame[None], axis=-1)
        assert distance.min(1).max() < 1e-5 * (1 + np.abs(frame).max()) and sorted(distance.argmin(1)) == list(
            range(40)
        )


def test_rescaling_and_wrong_questions(data):
    np.testing.assert_allclose(rescaled(np.array([3, 5, 4], np.float32)), [0, 1, 0.5])
    assert not rescaled(np.full(4, 7, np.float32)).any()
    reader = CloudsReader(data)  # labels 0 1 2 0 1 2
    picked = [chosen_samples(reader, wanted, range(6)) for wanted in ("2", "3", "4", "v5,v0,v5")]
    assert picked == [[0, 2], [0, 1, 2], [0, 3, 1, 2], [5, 0]]
    with pytest.raises(UsageError, match="1 or more"):
        chosen_samples(reader, "0", range(6))


def test_a_sample_s_name_may_hold_a_comma(tmp_path):
    with CloudsWriter(tmp_path / "a.h5") as writer:
        for name in ("late, tired", "late"):
            writer.write(CloudSequence.from_frames(name, [np.ones((4, 3))]))
    reader = CloudsReader(tmp_path / "a.h5")
    assert [chosen_samples(reader, wanted, range(2)) for wanted in ("late, tired", "late", "1")] == [[0], [1], [0]]


def test_fused_is_the_mean_and_the_target_may_be_predicted_or_the_label(model, data):
    source = ClipSource(CloudsReader(data), [1], model.config)
    clip = source.clips(1)[0]
    cloud = activation_cloud(model, source, clip, ("fused", "static", "dynamic"), Question("gradient"), CPU)
    mean = (cloud.activation["static"] + cloud.activation["dynamic"]) / 2
    np.testing.assert_allclose(cloud.activation["fused"], mean)
    assert cloud.target == cloud.predicted and 1 / 3 <= cloud.probability <= 1
    assert activation_cloud(model, source, clip, ("static",), Question("gradient", None, "label"), CPU).target == 1


def test_a_clip_without_points_is_told(model, tmp_path):
    with CloudsWriter(tmp_path / "e.h5") as writer:
        writer.write(CloudSequence.from_frames("gone", [np.zeros((0, 3))] * 9 + [np.ones((3, 3))]))
    source = ClipSource(CloudsReader(tmp_path / "e.h5"), [0], model.config)
    with pytest.raises(DataError, match="3 to 6 of 'gone' have no points"):
        activation_cloud(model, source, source.clips(1)[0], ("static",), Question(), CPU)


# --- any backbone


class Plain(nn.Module):
    """Three methods and nothing else: no head, no stages as modules; its layers see flat rows."""

    tap_widths = ((8,),)

    def __init__(self, config: KinetConfig) -> None:
        super().__init__()
        self.neighbors = config.neighbors
        self.edge, self.out = (
            nn.Linear(3, 8),
            nn.Sequential(nn.Linear(8, 16), nn.ReLU(), nn.Linear(16, config.num_classes)),
        )
        self.scale = nn.Parameter(torch.ones(()))

    def group(self, points, times):
        from dpcli.classify.network.backbones.interface import Grouping
        from dpcli.ops import knn

        return [Grouping(points, times, points, times, knn(points, points, self.neighbors)[1])]

    def taps(self, groups):
        from dpcli.classify.network.backbones.interface import Stage

        edges = torch.relu(self.edge(groups[0].relative()))
        return [Stage(groups[0], [edges])], self.out(edges.amax((1, 2)))

    def forward(self, groups):
        pooled = torch.relu(self.edge(groups[0].relative()).amax(2))
        return self.out(pooled.amax(1))


class Bare(Plain):
    """Its logits are scaled after the last layer, by no module."""

    def taps(self, groups):
        stages, logits = super().taps(groups)
        return stages, 2 * logits


def test_a_backbone_of_three_methods_is_explained_where_it_can_be():
    points = body_like_clip(4, 32)
    model = Kinet(KinetConfig(**TINY, backbone=f"{__name__}:Plain", head=(16, 24))).eval()
    for stream in ("static", "dynamic"):
        layer = stage_layer(model, points, stream, 0, None)
        assert layer.values.shape == (128, 8) and torch.isfinite(centroid_activation(layer)).all()
    assert stage_layer(model, points, "dynamic", None, 1).gradient.shape == (128, 8)
    with pytest.raises(UsageError, match="one feature for each of its 128 centroids"):
        stage_layer(model, points, "static", None, 1)  # pooled by no module, so no hook sees it
    vectors = ClipVectors(model, points).vectors(points)
    assert {key: value.shape for key, value in vectors.items()} == {"static": (1, 16), "dynamic": (1, 24)}
    with torch.no_grad():
        torch.testing.assert_close(model.static.out[-1](vectors["static"]), model(points)[0])
    with pytest.raises(UsageError, match="static stream's logits"):
        ClipVectors(Kinet(KinetConfig(**TINY, backbone=f"{__name__}:Bare")).eval(), points)


@pytest.mark.parametrize("name", ["dgcnn", "spidercnn"])
def test_the_other_backbones_are_explained(name):
    widths = {"dgcnn": ((8, 8, 12), (24,), (8, 8, 16, 8, 8), (16,)), "spidercnn": ((8, 8, 12), (3,), (16,))}[name]
    model = Kinet(KinetConfig(**{**TINY, "widths": widths}, backbone=name, head=(16, 24))).eval()
    points = body_like_clip(4, 32)
    for stream in ("static", "dynamic"):
        values = stage_layer(model, points, stream, 0, None).values
        assert values.shape == (128, 8)
        layer = stage_layer(model, points, stream, None, 1)
        assert len(layer.gradient) == 128 and layer.gradient.abs().max() > 0
    vectors = ClipVectors(model, points).vectors(points)
    assert vectors["static"].shape == (1, 16) and vectors["dynamic"].shape == (1, 24)


# --- videos in the plane


def test_video_features_are_means_of_what_the_last_layers_read(model, data):
    source = ClipSource(CloudsReader(data), [4, 1, 2], model.config)
    found = video_features(model, source, None, 4, CPU)
    for row, sequence in enumerate(source.sequences):
        clips = [clip for clip in source.clips(None) if clip.sequence == sequence]
        assert len(clips) == 2
        points = torch.from_numpy(np.stack([source.load_shown(clip) for clip in clips]))
        with torch.no_grad():
            static, dynamic = (logits.mean(0).numpy() for logits in model(points))
            groups = model.group(points)
            features = model.static.stage2(groups[1], model.static.stage1(groups[0], None))
            embedded = model.static.head.embed(groups[1].centers, features).mean(0).numpy()
            read = [
                stream.head.classify(torch.from_numpy(found[key][row])).numpy()
                for key, stream in (("static", model.static), ("dynamic", model.dynamic))
            ]
        np.testing.assert_allclose(found["static"][row], embedded, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(read[0], static, rtol=1e-4, atol=1e-4)  # the last layer is linear: it takes the mean
        np.testing.assert_allclose(read[1], dynamic, rtol=1e-4, atol=1e-4)


def test_neighbor_accuracy_and_silhouette_against_other_programs():
    from sklearn.neighbors import KNeighborsClassifier

    rng = np.random.default_rng(3)
    labels = rng.integers(0, 2, 40)  # two classes and five neighbors: no tied votes
    features = (rng.normal(size=(40, 7)) + 0.9 * labels[:, None]).astype(np.float32)
    others = ~np.eye(40, dtype=bool)
    voted = [KNeighborsClassifier(5).fit(features[o], labels[o]).predict(f[None])[0] for o, f in zip(others, features)]
    other = (voted == labels).mean()
    assert neighbor_accuracy(features, labels) == pytest.approx(other) and 0.6 < other < 1
    unknown = np.concatenate([labels, [-1, -1]])
    more = np.concatenate([features, features[:2] + 0.01])
    assert neighbor_accuracy(more, unknown) == pytest.approx(other)  # what has no label neither votes nor counts
    distance = np.linalg.norm(features[:, None].astype(float) - features[None], axis=-1)
    by_hand = []
    for i, label in enumerate(labels):
        own = (labels == label) & (np.arange(40) != i)
        a, b = distance[i, own].mean(), distance[i, labels != label].mean()
        by_hand.append((b - a) / max(a, b))
    assert silhouette(more, unknown) == pytest.approx(np.mean(by_hand))
    assert neighbor_accuracy(features, rng.permutation(labels)) < other - 0.1  # shuffled labels are told
    # each video has one of its own class and two of the other beside it
    line = np.array([[0], [1], [2.1], [3.3]], np.float32)
    # tied votes go to the nearest, which is the other
    assert neighbor_accuracy(line, np.array([0, 1, 0, 1]), k=2) == 0.0
    assert neighbor_accuracy(line, np.array([0, 0, 1, 1]), k=1) == 0.75
    for one_class in (np.zeros(4, int), np.full(4, -1)):
        assert neighbor_accuracy(line, one_class) is None and silhouette(line, one_class) is None


def test_neighbors_of_many_videos_need_no_table_of_all_distances():
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 30, 1500)
    features = (rng.normal(size=(1500, 3)) + 9 * rng.normal(size=(30, 3))[labels]).astype(np.float32)
    tracemalloc.start()
    found = neighbor_accuracy(features, labels)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    near = cKDTree(features.astype(np.float64)).query(features, 6)[1][:, 1:]
    by_hand = np.mean([max(own := labels[row].tolist(), key=own.count) == label for row, label in zip(near, labels)])
    assert found == pytest.approx(by_hand, abs=1e-3) and 0.5 < found < 1
    assert peak < 12e6  # all distances: 18 MB, and as much for their order


def test_the_map_keeps_clusters_and_repeats_by_seed():
    rng = np.random.default_rng(0)
    labels = np.repeat(range(3), 6)
    features = (rng.normal(size=(18, 20)) + 6 * np.eye(20)[labels]).astype(np.float32)
    first, again, other = (plane(features, 5, seed) for seed in (2**40, 2**40, 1))  # more than scikit-learn takes
    assert first.shape == (18, 2) and first.dtype == np.float32 and np.array_equal(first, again)
    assert neighbor_accuracy(first, labels, 3) == neighbor_accuracy(other, labels, 3) == 1.0
    with pytest.raises(DataError, match="same feature vector"):
        plane(np.ones((9, 4), np.float32), 3, 0)


def test_perplexity_follows_the_number_of_videos():
    assert (chosen_perplexity(None, 500), chosen_perplexity(None, 31), chosen_perplexity(12, 13)) == (30, 10, 12)
    with pytest.raises(UsageError, match="less than the 13 videos"):
        chosen_perplexity(13, 13)
    with pytest.raises(DataError, match="at least 4"):
        chosen_perplexity(None, 3)


# --- the commands


def dpc(*words: object) -> int:
    from dpcli.cli.app import main

    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    return ended.value.code


def test_pac_writes_clouds_pictures_and_animations(data, weights, tmp_path, monkeypatch, capsysbinary):
    from PIL import Image

    out, png, gif = tmp_path / "pac.h5", tmp_path / "x.png", tmp_path / "x.gif"
    words = (
        "classify",
        "explain",
        "pac",
        data,
        "--model",
        weights,
        "--samples",
        "2",
        "--set",
        "rule=gradient",
        "--set",
        "class=bend",
        "--set",
        "stage=1",  # where this untrained network has evidence for the class in both streams
    )
    assert dpc(*words, "-o", out, "--picture", png, "--animation", gif, "--set", "frames=3") == 0
    with CloudsReader(out) as reader, h5py.File(out) as file:
        assert reader.names == ["v0", "v2"] and reader.fields == FIELDS and reader.frame_counts.tolist() == [4, 4]
        assert file["frame"][:].tolist() == [0, 1, 2, 3] * 2 and file["explained"][:].tolist() == [2, 2]
        for stream in ("static", "dynamic"):
            values = file["activation"][stream][:]
            assert values.dtype == np.float32 and len(values) == reader.num_points
            assert values.min() >= 0 and values.max() == 1
        source = CloudsReader(data).read(2, [0, 1, 2, 3])
        for name in ("points", *FIELDS):
            np.testing.assert_array_equal(reader.read(1).value(name), source.value(name))
    with Image.open(png) as picture, Image.open(gif) as moving:
        assert picture.width > 3 * 130 and picture.height > 4 * 130 and moving.n_frames == 4
        assert len(np.unique(np.asarray(picture).reshape(-1, 3), axis=0)) > 50
    before = out.read_bytes()
    assert dpc(*words, "-o", out) == 2 and out.read_bytes() == before
    assert b"--force" in capsysbinary.readouterr().err
    with open(data) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        piped = ["-" if word is data else word for word in words]
        assert dpc(*piped, "-o", "-") == 0
    with h5py.File(io.BytesIO(capsysbinary.readouterr().out)) as file, h5py.File(out) as same:
        assert np.array_equal(file["activation/dynamic"][:], same["activation/dynamic"][:])


def test_tsne_writes_an_embedding_that_info_understands(data, weights, tmp_path, capsys):
    out, png = tmp_path / "t.h5", tmp_path / "t.png"
    words = (
        "classify",
        "explain",
        "tsne",
        data,
        "--model",
        weights,
        "--stream",
        "static,fused",
        "--clips-per-video",
        1,
    )
    assert dpc(*words, "-o", out, "--picture", png, "--json") == 0
    said = json.loads(capsys.readouterr().out)
    reader = EmbeddingReader(out)
    assert reader.names == [f"v{i}" for i in range(6)] and set(reader.streams) == {"static", "fused"}
    assert reader.streams["static"].features.shape == (6, 32) and reader.streams["fused"].features.shape == (6, 64)
    for stream, one in reader.streams.items():
        expected = neighbor_accuracy(one.features, reader.labels)
        assert said["metrics"][f"{stream}_neighbor_accuracy"] == expected == one.values["neighbor_accuracy"]
        assert said["metrics"][f"{stream}_silhouette"] == pytest.approx(silhouette(one.features, reader.labels))
    assert png.read_bytes().startswith(b"\x89PNG") and not list(tmp_path.glob(".*"))
    assert dpc("info", out, "--json") == 0
    info = json.loads(capsys.readouterr().out)
    assert info["kind"] == "embedding" and info["counts"]["samples"] == 6 and info["classes"][2]["samples"] == 2
    with h5py.File(out, "r+") as file:
        file["features/static"][3, 1] = np.nan
    with pytest.raises(DataError, match="features/static must be finite"):
        EmbeddingReader(out)


def test_unlabeled_videos_get_a_map_and_a_sentence(weights, tmp_path, capsys):
    data = blobs(tmp_path / "u.h5", videos=5, labeled=False)
    words = (data, "--model", weights, "-o", tmp_path / "t.h5", "--clips-per-video", 1)
    assert dpc("classify", "explain", "tsne", *words, "--picture", tmp_path / "t.png") == 0
    said = capsys.readouterr()
    assert "no labels" in said.err and "nearest neighbors -" in said.out
    words = (data, "--model", weights, "-o", tmp_path / "p.h5", "--set", "rule=gradient", "--set", "class=label")
    assert dpc("classify", "explain", "pac", *words) == 3 and not (tmp_path / "p.h5").exists()
    assert "has no label" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        (("pac", "--set", "class=kick"), 2, "rule=gradient"),
        (("pac", "--set", "rule=gradient", "--set", "class=swim"), 2, "wave, kick, bend"),
        (("pac", "--samples", "v1,nobody"), 3, "'nobody'"),
        (("pac", "--stream", "both"), 2, "static, dynamic, fused"),
        (("tsne", "--stream", "fused,what"), 2, "static, dynamic, fused"),
        (("pac", "--set", "stage=3"), 2, "expected 1..2"),
        (("pac", "--animation", "a.avi"), 2, ".gif, .mp4"),
        (("pac", "--picture", "nowhere/a.png"), 3, "does not exist"),
        (("tsne", "--perplexity", "6"), 2, "less than the 6 videos"),
    ],
)
def test_mistakes_end_with_a_sentence_and_no_file(data, weights, tmp_path, capsys, words, code, sentence):
    out = tmp_path / "out.h5"
    assert dpc("classify", "explain", words[0], data, "--model", weights, "-o", out, *words[1:]) == code
    assert sentence in capsys.readouterr().err and not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", [("pac", "--samples", "1"), ("tsne", "--clips-per-video", "1")])
@pytest.mark.parametrize("size, told", [(1.0, False), (1000.0, True)])
def test_videos_unlike_those_of_the_training_are_told(data, model, tmp_path, capsys, words, size, told):
    extent = file_like(CloudsReader(data), range(6))["extent"]
    known = {"extent": extent / size, "points": 40.0, "frames": 5.0}
    save_model(tmp_path / "m.safetensors", model, ModelInfo(model.config, NAMES, "clips", {NOTE: known}))
    assert (
        dpc(
            "classify",
            "explain",
            words[0],
            data,
            "--model",
            tmp_path / "m.safetensors",
            "-o",
            tmp_path / "o.h5",
            *words[1:],
        )
        == 0
    )
    assert ("is the unit of length another one" in capsys.readouterr().err) is told
