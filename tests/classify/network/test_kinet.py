"""Kinet's shape: published counts, symmetries, the frozen static stream, the switches."""

from __future__ import annotations

import copy
import json

import pytest
import torch

from dpcli.classify import network_speed
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.kinematic import KinematicUnit
from dpcli.classify.network.kinet import Kinet, fuse
from dpcli.classify.network.layers import GlobalHead, he_init
from dpcli.classify.network_cost import count_parameters, macs, measure, paper_parameters, render
from dpcli.classify.network_speed import body_like_clip
from dpcli.classify.settings import network_config
from dpcli.errors import DataError, UsageError
from dpcli.ops import fps
from dpcli.runtime.settings.catalog import Given

TINY = {
    "num_classes": 5,
    "num_frames": 4,
    "points_per_frame": 64,
    "centroids": (32, 16),
    "neighbors": 8,
    "widths": ((16, 16), (16, 32), (32, 64)),
}


@pytest.mark.parametrize(
    ("classes", "static", "total"),
    [(20, 741_652, 1_586_906), (25, 746_777, 1_597_156), (28, 749_852, 1_603_306), (60, 782_652, 1_668_906)],
)
def test_release_parameter_counts_are_exact(classes, static, total):
    model = Kinet(KinetConfig.release(num_classes=classes))
    assert (count_parameters(model.static), count_parameters(model)) == (static, total)


def test_release_parts_and_the_paper_s_way_of_counting():
    model = Kinet(KinetConfig.release(num_classes=28))
    assert [count_parameters(getattr(model.static, part)) for part in ("stage1", "stage2")] == [8_960, 50_688]
    assert count_parameters(model.dynamic.merge) == 153_520
    assert [unit.groups for unit in model.dynamic.units] == [11, 22, 22, 43]
    assert [unit.channels for unit in model.dynamic.units] == [44, 88, 88, 172]
    assert [count_parameters(u.reduce) for u in model.dynamic.units] == [1_980, 8_190, 8_190, 32_508]
    assert [count_parameters(u.weigh) for u in list(model.dynamic.units)[1:]] == [301, 543, 1_026]
    assert round(paper_parameters(Kinet(KinetConfig.release(num_classes=20)).static), 3) == 2.126  # table A.1: 2.13


def test_macs_of_the_static_stream_as_written():
    """5.018e9 operations of facts section 2: 2 x multiply-adds, counted layer by layer by hand."""
    model = Kinet(KinetConfig.release(num_classes=28, num_frames=16, points_per_frame=256)).eval()
    counts = macs(model, body_like_clip(16, 256))
    by_hand = (
        1024 * 64 * (3 * 64 + 64 * 128)
        + 512 * 64 * (131 * 128 + 128 * 256)
        + 512 * (259 * 512 + 512 * 1024)
        + 1024 * 28
    )
    assert counts["static_as_written"] == by_hand and round(2 * by_hand / 1e9, 3) == 5.018
    assert counts["static"] < by_hand  # gathering after the first layer saves the difference
    assert 5.3e9 < 2 * counts["dynamic"] < 6.1e9  # facts: 5.73e9


def test_a_second_pass_of_the_static_layers_counts_for_the_dynamic_stream():
    """The static stream costs the same alone, whether or not the dynamic stream has other neighborhoods."""
    one, two = (
        macs(Kinet(KinetConfig(**TINY, **own)).eval(), body_like_clip(4, 64))
        for own in ({}, {"static_temporal_radius": 0})
    )
    assert two["static"] == one["static"] and two["static_as_written"] == one["static_as_written"]
    again = two["dynamic"] - one["dynamic"]
    assert 0 < again == two["total"] - one["total"] < one["static"]  # all but the head


CONFIGS = [
    KinetConfig(**TINY),
    KinetConfig.release(**TINY),
    KinetConfig(**TINY, solver="ridge", grouping="nearest"),
    KinetConfig(**TINY, normals=False, weighting="none"),
    KinetConfig(**TINY, weighting="none"),
    KinetConfig(**TINY, temporal_radius=0, grouping="balanced"),
    KinetConfig(**TINY, group_size=8, temporal_radius=2),
    KinetConfig(**TINY, static_temporal_radius=0),
]


@pytest.mark.parametrize(
    "config",
    CONFIGS,
    ids=lambda c: f"{c.variant}-{c.weighting}-{c.normals}-d{c.group_size}-t{c.temporal_radius}-s{c.static_radius}",
)
def test_every_switch_trains_the_dynamic_branch_alone(config):
    torch.manual_seed(0)
    model = Kinet(config)
    model.freeze_static()
    model.dynamic.train()
    before = {key: value.clone() for key, value in model.static.state_dict().items()}
    loss = torch.nn.functional.cross_entropy(model.dynamic_logits(body_like_clip(4, 64, 3)), torch.arange(3))
    loss.backward()
    for name, parameter in model.dynamic.named_parameters():
        if name.startswith("merge.cross.1.0"):
            continue  # dead in the release, too: only stage 2's last output is used
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all(), name
    assert all(p.grad is None for p in model.static.parameters())
    assert all(torch.equal(before[key], value) for key, value in model.static.state_dict().items())


@pytest.mark.parametrize("config", CONFIGS[:2], ids=["thesis", "release"])
def test_a_shift_of_the_body_only_reaches_the_absolute_inputs(config):
    """Groups, normals and weights are relative: with the heads' absolute xyz taken out, nothing may change."""
    torch.manual_seed(0)
    model = Kinet(config).eval()
    clip = body_like_clip(4, 64)
    shift = torch.tensor([0.25, -0.5, 1.0])  # exact in float32 sums of this size
    features = []
    for points in (clip, clip + shift):
        groups = model.group(points)
        stages, _ = model.static.taps(groups)
        features.append((stages[1].activations[1], model.dynamic.features(stages)))
    assert torch.allclose(features[0][0], features[1][0], atol=1e-4)


def test_order_of_points_within_a_frame_doesn_t_matter_with_nearest_neighbors():
    """FPS starts at point 0, so that one stays first; all others may be shuffled."""
    torch.manual_seed(0)
    model = Kinet(KinetConfig(**TINY, grouping="nearest", solver="ridge")).eval()
    clip = body_like_clip(4, 64)
    order = torch.cat([torch.zeros(1, dtype=torch.long), torch.randperm(63) + 1])
    with torch.no_grad():
        static, dynamic = model(clip)
        static2, dynamic2 = model(clip[:, :, order])
    torch.testing.assert_close(static, static2, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(dynamic, dynamic2, atol=1e-3, rtol=1e-3)


def test_reversed_time_is_another_input_to_the_dynamic_stream_only_in_its_normals():
    """The static stream is blind to the direction of time up to its choice of centroids; the dynamic one must not be."""
    torch.manual_seed(0)
    config = KinetConfig(**TINY, solver="ridge", grouping="nearest")
    model = Kinet(config).eval()
    clip = body_like_clip(4, 64)
    with torch.no_grad():
        _, forward = model(clip)
        _, backward = model(clip.flip(1))
    assert (forward - backward).abs().max() > 1e-3


@pytest.mark.parametrize("solver", ["inverse", "ridge"])
@pytest.mark.parametrize("variant", ["thesis", "release"])
def test_surfaces_don_t_depend_on_when_a_clip_begins(variant, solver):
    """A ridge holds the offset b down, too: of absolute frame numbers it would make other normals later in a video."""
    torch.manual_seed(0)
    config = KinetConfig(**TINY).changed(variant=variant, solver=solver, time_input=False)
    unit = KinematicUnit(config, 16, 0).double()
    activation, relative = 4 * torch.rand(1, 6, 40, 16).double(), torch.randn(1, 6, 40, 3).double()
    times = torch.randint(-1, 2, (1, 6, 40)).double()
    normals = [
        unit(activation, relative, times + start, torch.full((1, 6), start).double(), None).normals
        for start in (1.0, 20.0)
    ]
    torch.testing.assert_close(normals[0], normals[1], rtol=1e-6, atol=1e-6)


def test_balanced_grouping_shares_the_slots_between_frames():
    config = KinetConfig(**{**TINY, "points_per_frame": 256, "neighbors": 9}, grouping="balanced")
    group = Kinet(config).group(body_like_clip(4, 256))[0]
    offsets = group.neighbor_times() - group.center_times[..., None]
    inner = (group.center_times > 0) & (group.center_times < 3)
    counts = torch.stack([(offsets[inner] == d).sum(-1) for d in (-1, 0, 1)], -1)
    assert (counts == 3).all() and (offsets.abs() <= 1).all()
    assert (group.relative().norm(dim=-1) < config.radius_table(0, 1)[1]).all()
    first = Kinet(config.changed(grouping="first")).group(body_like_clip(4, 256))[0]
    early = (first.neighbor_times() - first.center_times[..., None])[first.center_times > 0]
    assert (early == -1).float().mean() > 0.9  # why the release's rule can't fit a surface in time on dense frames


def test_fusion_rules():
    static, dynamic = torch.tensor([[2.0, 0.0]]), torch.tensor([[0.0, 4.0]])
    torch.testing.assert_close(fuse(static, dynamic, "softmax"), (static.softmax(-1) + dynamic.softmax(-1)) / 2)
    torch.testing.assert_close(fuse(static, dynamic, "logits"), torch.tensor([[1.0, 2.0]]).softmax(-1))


def test_the_table_s_total_counts_the_frozen_static_stream_once():
    """Facts: 3.13 for the release with 20 classes (thesis: 3.20); with the static stream's moments it would be 4.55."""
    report = measure(Kinet(KinetConfig.release(num_frames=4, points_per_frame=256)).eval(), torch.device("cpu"))
    assert round(report["paper_style_parameters"]["total"], 2) == 3.13


def test_a_group_too_small_for_coordinates_is_refused():
    with pytest.raises(UsageError, match="three coordinates"):
        KinetConfig(**TINY, group_size=2, xyz_group=True)


@pytest.mark.filterwarnings("error")
def test_groups_wider_than_a_layer_leave_it_the_coordinates_alone():
    """Figure 3.5's largest groups on a narrow network: the layer has no features to fit, and nobody is warned of it."""
    model = Kinet(KinetConfig(**{**TINY, "xyz_group": True, "group_size": 16})).eval()
    assert [unit.groups for unit in model.dynamic.units] == [1, 1, 1, 2]
    static, dynamic = model(body_like_clip(4, 64))
    dynamic.sum().backward()
    assert torch.isfinite(static).all() and torch.isfinite(dynamic).all()
    assert all(torch.isfinite(p.grad).all() for p in model.dynamic.parameters() if p.grad is not None)


def test_config_survives_json_and_refuses_nonsense():
    config = KinetConfig.release(num_classes=7, radii=(0.2, 0.4))
    assert KinetConfig.from_json(config.to_json()) == config
    with pytest.raises(DataError, match="unknown keys"):
        KinetConfig.from_json('{"nonsense": 1}')
    for bad in ({"grouping": "random"}, {"reduction": 0.0}, {"num_frames": 1, "points_per_frame": 10}):
        with pytest.raises(UsageError):
            KinetConfig(**bad)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"points_per_frame": -1}, "points = -1: expected at least 1"),
        ({"num_frames": 0}, "frames = 0: expected at least 1"),
        ({"group_size": 0}, "group_size = 0: expected at least 1"),
        ({"temporal_radius": -1}, "temporal_radius = -1: expected at least 0"),
        ({"static_temporal_radius": -1}, "static_temporal_radius = -1: expected at least 0"),
        (
            {"static_temporal_radius": 0, "points_per_frame": 63, "num_frames": 32},
            "static_temporal_radius = 0 hold 63 points",
        ),
        (
            {"static_temporal_radius": 0, "backbone": "dgcnn"},
            "static_temporal_radius = 0: dgcnn's one graph serves both",
        ),
        ({"temporal_radius": 32}, "temporal_radius = 32: balanced grouping shares 64 neighbors among 65 frames"),
        ({"dropout": 1.0}, "dropout = 1.0: expected at least 0 and below 1"),
        ({"dropout": float("nan")}, "dropout = nan: expected at least 0 and below 1"),
        ({"radii": (-0.5, -1.0)}, "radius = -0.5,-1.0: expected numbers, each above 0"),
        ({"radii": (float("inf"), float("inf"))}, "radius = inf,inf: expected a finite number"),
        ({"centroids": (256, 512)}, "centroids = 256,512: expected two counts, the second not above the first"),
        ({"neighbors": 0}, "neighbors = 0: expected at least 1"),
        ({"neighbors": 6145}, "neighbors = 6145: the frames within temporal_radius = 1 hold 6144 points"),
        ({"num_classes": 0}, "number of classes 0: expected at least 1"),
    ],
)
def test_wrong_values_end_with_a_sentence(bad, message):
    with pytest.raises(UsageError) as error:
        KinetConfig(**bad)
    assert message in str(error.value)


def test_the_second_stage_takes_the_first_centroids_as_farthest_points():
    """group_clip relies on it: any first few of a farthest point sample are one, ties and doubled points included."""
    clip = body_like_clip(4, 64)
    clip[:, 2:] = clip[:, :2]  # every position twice
    for points in (clip, (clip * 8).round() / 8):
        first, second = Kinet(KinetConfig(**TINY)).group(points)
        chosen = fps(first.centers, second.centers.shape[1])
        picked = torch.gather(first.centers, 1, chosen[..., None].expand(-1, -1, 3))
        assert torch.equal(second.centers, picked)


def test_shipped_models_load_and_have_a_card():
    from dpcli.classify.network.model_file import SHIPPED, load_model
    from dpcli.runtime.weights import shipped_models

    names = shipped_models(SHIPPED)
    assert names
    for name in names:
        model, info = load_model(name)
        assert model.config.num_classes == len(info.class_names) and not model.training
        card = (SHIPPED / f"{name}.md").read_text()
        assert "Trained on" in card and "Result" in card and "license" in card
        assert (SHIPPED / f"{name}.safetensors").stat().st_size < 8e6
        with torch.no_grad():
            static, dynamic = model(body_like_clip(model.config.num_frames, model.config.points_per_frame))
        assert torch.isfinite(static).all() and torch.isfinite(dynamic).all()
    with pytest.raises(DataError, match=names[0]):
        load_model("nonesuch")


def test_the_shipped_model_recognizes_real_depth_videos(shared_data, tmp_path, dpc_here, one_thread):
    """Five test videos of five actions, from raw file to score: at least four right (93.5 % expected)."""
    for name in ("a01_s06_e01", "a10_s06_e01", "a13_s07_e01", "a16_s08_e01", "a19_s09_e01"):
        (tmp_path / f"{name}_sdepth.mat").symlink_to(shared_data / "msraction3d" / f"{name}_sdepth.mat")
    prepared = dpc_here("prepare", "msraction3d", tmp_path, "-o", tmp_path / "clouds.h5", "--jobs", 1)
    assert prepared.returncode == 0, prepared.stderr.decode()
    words = ("--model", "msraction3d-16", "-o", tmp_path / "scores.h5")
    scored = dpc_here("classify", "predict", tmp_path / "clouds.h5", *words)
    assert scored.returncode == 0, scored.stderr.decode()
    report = dpc_here("evaluate", "classification", tmp_path / "scores.h5", "--json")
    assert json.loads(report.stdout)["metrics"]["accuracy"] >= 0.8


def test_the_global_head_in_training_is_batch_norm_written_out():
    """Pooled as it is made, against torch's own layers in float64: values, gradients and running statistics."""
    torch.manual_seed(0)
    head = GlobalHead(6, (20, 24), 3, 0.0)
    he_init(head)
    centers, features = torch.randn(3, 40, 3), torch.randn(3, 40, 6)
    plain = copy.deepcopy(head).double()
    ours = features.clone().requires_grad_()
    theirs = features.double().requires_grad_()
    values = torch.cat([centers.double(), theirs], -1).view(120, -1)
    hidden = torch.relu(plain.norm1(plain.linear1(values)))
    expected = torch.relu(plain.norm2(plain.linear2(hidden))).view(3, 40, -1).amax(1)
    got = head.embed(centers, ours)
    torch.testing.assert_close(got.double(), expected, rtol=0, atol=2e-5)
    weight = torch.randn(3, 24)
    (got * weight).sum().backward()
    (expected * weight).sum().backward()
    torch.testing.assert_close(ours.grad.double(), theirs.grad, rtol=1e-4, atol=1e-5)
    for name in ("linear1", "norm1", "linear2", "norm2"):
        mine, other = getattr(head, name).weight.grad, getattr(plain, name).weight.grad
        torch.testing.assert_close(mine.double(), other, rtol=1e-4, atol=1e-4)
    for norm in ("norm1", "norm2"):
        mine, other = getattr(head, norm), getattr(plain, norm)
        torch.testing.assert_close(mine.running_mean.double(), other.running_mean, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(mine.running_var.double(), other.running_var, rtol=1e-5, atol=1e-6)


def test_profile_splits_steps_into_their_parts(monkeypatch):
    monkeypatch.setattr(network_speed, "_STEPS", 1)  # more make the times more exact
    result = measure(Kinet(KinetConfig(**TINY)).eval(), torch.device("cpu"), with_steps=True)
    for name in ("static_step", "dynamic_step", "inference"):
        step = result[name]
        assert 0 < step["matrix_products_share"] <= 1
        assert set(step["ms_per_clip"]) == {"matrix_products", "sparse_products", "neighbors", "other"}
        assert step["sparse_products_share"] == 0 or name == "static_step"
        total = sum(step["ms_per_clip"].values())
        assert total == pytest.approx(1000 * step["seconds_on_one_thread"] / step["batch"], rel=0.1, abs=0.05)
        assert f"\n{name.replace('_', ' ')}" in render(result)
    assert "in matrix products" in render(result)


def test_a_static_stream_within_frames_knows_nothing_of_their_order():
    """With every point a centroid, sampling has no say: any order of the frames gives the same logits. Neighborhoods that
    reach into the next frame don't, nor does the dynamic stream, which reads the same layers across frames."""
    clip, order = body_like_clip(4, 32), torch.tensor([2, 0, 3, 1])
    sizes = {**TINY, "centroids": (128, 128), "points_per_frame": 32, "grouping": "nearest", "solver": "ridge"}
    moved = {}
    for reach in (0, None):
        torch.manual_seed(0)
        model = Kinet(KinetConfig(**sizes, static_temporal_radius=reach)).eval()
        with torch.no_grad():
            (static, dynamic), (static2, dynamic2) = model(clip), model(clip[:, order])
        moved[reach] = (static - static2).abs().max() / static.abs().max(), (dynamic - dynamic2).abs().max()
    assert moved[0][0] < 1e-5 < 1e-3 < moved[None][0]
    assert moved[0][1] > 1e-3


def test_a_static_stream_of_its_own_is_that_of_a_network_of_its_reach_and_the_dynamic_one_reads_it_across_frames():
    torch.manual_seed(0)
    model = Kinet(KinetConfig(**TINY, static_temporal_radius=0)).eval()
    alone, shared = (Kinet(KinetConfig(**TINY, temporal_radius=reach)).eval() for reach in (0, 1))
    for other in (alone, shared):
        other.load_state_dict(model.state_dict())
    clip = body_like_clip(4, 64, 2)
    with torch.no_grad():
        assert torch.equal(model.static_logits(clip), alone.static_logits(clip))
        assert torch.equal(model(clip)[0], alone(clip)[0]) and not torch.equal(model(clip)[0], shared(clip)[0])
        groups = model.group(clip)
        across = shared.group(clip)
        assert all(torch.equal(mine.idx, theirs.idx) for mine, theirs in zip(groups[2:], across))
        stages, _ = model.static.taps(groups)
        pooled = alone.static.stage1(alone.group(clip)[0], None)
        expected = model.static.stage2.taps(across[1], pooled)[0]
        assert all(map(torch.equal, stages[1].activations, expected))
        theirs = shared.static.taps(across)[0]
        # the first stage reads coordinates alone
        assert torch.equal(stages[0].activations[1], theirs[0].activations[1])
        assert not torch.equal(stages[1].activations[1], theirs[1].activations[1])
    assert len(model.train().group(clip)) == 2  # training asks for its own alone


def test_models_made_before_the_static_stream_had_neighborhoods_of_its_own_stay_as_they_are():
    values = json.loads(KinetConfig(temporal_radius=2).to_json())
    del values["static_temporal_radius"]
    config = KinetConfig.from_json(json.dumps(values))
    assert config.static_radius == 2 and not config.own_static_groups
    assert KinetConfig.release().static_temporal_radius is None


def test_the_preset_thesis_keeps_its_static_stream_within_a_frame_where_it_can():
    """Also with the default backbone named; a graph that serves both streams, a user's own network and the release share."""
    for backbone, variant, radius in (
        (None, None, 0),
        ("pointnet2", None, 0),
        ("dgcnn", None, 1),
        ("spidercnn", None, 1),
        ("tests.support.tiny_backbone:TinyBackbone", None, 1),
        (None, "release", 1),
    ):
        said = {key: value for key, value in (("backbone", backbone), ("variant", variant)) if value is not None}
        assert network_config(Given("thesis", sets=said), 20).static_radius == radius
    assert network_config(Given("quick"), 20).static_radius == 1
