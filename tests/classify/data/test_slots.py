"""Clips of sparse clouds: what of a video gets into which slot, whatever its place, unit and outliers; and who reads it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dpcli.classify.data.augment import NONE
from dpcli.classify.data.augment import SPARSE as CHANGE
from dpcli.classify.data.clips import ClipSource, OneVideo
from dpcli.classify.data.slots import changed_rows, in_slots, measured, measured_scales, preset_for, slot_rows
from dpcli.classify.data.validation_split import (
    about_classes,
    about_people,
    carve_validation,
    cross_folds,
    default_rule,
)
from dpcli.classify.network import sync_norm
from dpcli.classify.network.backbones.point_slots import slot_quantiles
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network.layers import RowNorm
from dpcli.classify.network.model_file import ModelInfo
from dpcli.classify.settings import network_config
from dpcli.classify.stream.sliding_window import StreamPredictor
from dpcli.classify.training.fine_tune import freeze, train_mode
from dpcli.errors import DataError, UsageError
from dpcli.runtime.settings.catalog import Given
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter
from dpcli.store.schema import kept_name

SPEED = kept_name("speed")
SMALL = {
    "frames": 4,
    "points": 8,
    "widths": ((8, 8), (16,)),
    "members": 2,
    "dropout": 0.0,
    "copies": False,
    "slot_details": False,
}

NO_FOREST = torch.tensor(0.0)


def video(name="v", frames=12, points=3, place=(0.0, 0.0, 2.0), scale=1.0, seed=0, label=0):
    """A video whose points rise through time, with one 30 m away; the column is 1 in its first half, -1 then."""
    rng = np.random.default_rng(seed)
    made = [place + scale * rng.normal((0, 0.1 * t, 0), 0.1, (points, 3)) for t in range(frames)]
    made[1][0] += 30 * scale
    sequence = CloudSequence.from_frames(name, [one.astype(np.float32) for one in made], label=label, split="train")
    sequence.extra = {SPEED: np.repeat(np.where(np.arange(frames) < frames / 2, 1, -1), points).astype(np.float32)}
    return sequence


def config_of(tmp_path, videos, fields=(SPEED,)):
    with CloudsWriter(tmp_path / "c.h5", class_names=["a", "b"], fields=list(fields)) as writer:
        for one in videos:
            writer.write(one)
    reader = CloudsReader(tmp_path / "c.h5")
    return measured(network_config(Given("sparse", sets=SMALL), 2), reader, list(range(len(reader))))[0]


def test_slots_hold_the_video_in_its_order_about_its_median_without_what_is_far(tmp_path, capsys):
    config = config_of(tmp_path, [video()])
    assert config.columns == ("speed",) and config.scales[1:] == (0.0, 1.0)  # both signs: 0 is the middle
    assert "(1 of 36)" in capsys.readouterr().err
    clip = in_slots(slot_rows(video(), config), config, np.random.default_rng(0))
    assert clip.shape == (4, 8, 6) and clip[..., 3].sum() == 32  # 8 of each slot's 9 points, or all 8
    heights = [slot[slot[:, 3] > 0, 1].mean() for slot in clip]
    assert heights == sorted(heights) and np.abs(clip[..., :3]).max() < 3
    assert (clip[:2, :, 5] == 1).all() and (clip[2:, :, 5] == -1).all()
    assert np.abs(clip[..., 4]).max() <= 0.5


def test_place_and_unit_of_the_data_make_no_difference(tmp_path):
    config = config_of(tmp_path, [video()])
    elsewhere = video(place=(5.0, -3.0, 9.0))
    assert np.allclose(slot_rows(video(), config), slot_rows(elsewhere, config), atol=1e-4)
    millimeters = video(place=(0.0, 0.0, 2000.0), scale=1000.0)
    again = config.changed(scales=(config.scales[0] * 1000, *config.scales[1:]))
    assert np.allclose(slot_rows(video(), config), slot_rows(millimeters, again), atol=1e-3)


def test_speeds_count_by_their_video_s_level_and_other_columns_from_its_middle():
    fields = ("speed", "snr")
    config = network_config(Given("sparse", sets=SMALL), 2)
    config = config.changed(columns=fields, scales=(1.0, 0.0, 1.0, 4.0, 2.0))
    rng = np.random.default_rng(0)
    for speed in (rng.normal(-0.8, 0.4, 40), rng.normal(0, 0.01, 40), rng.normal(2, 4, 40)):
        snr = rng.normal(5, 9, 40)
        made = CloudSequence.from_frames("v", list(rng.normal(0, 0.1, (8, 5, 3)).astype(np.float32)))
        made.extra = {kept_name(name): own.astype(np.float32) for name, own in zip(fields, (speed, snr))}
        level = max(np.sort(np.abs(speed))[31] * 0.8 + np.sort(np.abs(speed))[32] * 0.2, 0.1)  # of 40, the quantile 0.8
        expected = np.stack([speed * 2 / (1 + level), (snr - np.median(snr)) / 2], axis=1).clip(-3, 3)
        np.testing.assert_allclose(slot_rows(made, config)[:, 4:], expected, atol=1e-5)


@pytest.mark.parametrize("points", [1, 2])
def test_a_video_of_one_frame_or_point_makes_a_clip(tmp_path, points):
    config = config_of(tmp_path, [video()])
    single = CloudSequence.from_frames("s", [np.full((points, 3), 7, np.float32)])
    single.extra = {SPEED: np.full(points, np.nan, np.float32)}
    rows = slot_rows(single, config)
    clip = in_slots(changed_rows(rows, CHANGE, [0], np.random.default_rng(0)), config, np.random.default_rng(0))
    assert clip[..., 3].sum() == points and np.isfinite(clip).all()
    model = Kinet(config)
    for mode in (model.train(), model.eval()):
        assert torch.isfinite(mode.static_logits(torch.from_numpy(clip)[None])).all()


def test_a_column_of_one_sign_that_is_mostly_0_is_no_speed(tmp_path):
    """Such as a count of targets: reversed in time, it keeps its sign."""
    videos = [video(f"v{k}", seed=k) for k in range(3)]
    for one in videos:
        one.extra = {SPEED: np.where(np.arange(len(one.points)) % 3, 0, 5).astype(np.float32)}
    assert config_of(tmp_path, videos).signed_columns == []


def test_a_window_of_an_endless_stream_costs_no_more_at_its_end():
    config = network_config(Given("sparse", sets=SMALL), 2)
    config = config.changed(columns=("speed",), scales=(1.0, 0.0, 1.0))
    predictor = StreamPredictor(
        Kinet(config).eval(), ModelInfo(config, ["a", "b"], "slots", {"streams": ["static"]}), window=4
    )
    predictor.window.count = 10**12  # a list of so many frames would need terabytes
    frames = np.ones((5, 3, 4), np.float32)
    assert [made.frame for made in map(predictor.add, frames) if made] == [10**12 + k for k in range(5)]


def test_changes_keep_the_order_in_time_and_change_speeds_together(tmp_path):
    config = config_of(tmp_path, [video(frames=40)])
    rows = slot_rows(video(frames=40), config)
    assert changed_rows(rows, NONE, [0], np.random.default_rng(0)) is rows
    changed = changed_rows(rows, CHANGE, [0], np.random.default_rng(1))
    assert len(changed) < len(rows) and (np.diff(changed[:, 3]) >= 0).all()
    assert len(np.unique(np.abs(changed[:, 4]))) == 1 and not np.allclose(np.abs(changed[:, 4]), 1)
    assert np.allclose(rows, slot_rows(video(frames=40), config))  # the rows themselves stay


def test_each_change_of_sparse_rows_is_the_one_that_it_names():
    rng = np.random.default_rng(0)
    rows = np.column_stack([rng.normal(size=(300, 3)), np.sort(rng.random(300)), np.arange(300), np.ones(300)])
    rows = rows.astype(np.float32)

    def changed(seed, **ranges):
        return changed_rows(rows, replace(NONE, **ranges), [1], np.random.default_rng(seed))

    for seed in range(20):
        moved = changed(seed, shift=0.2)
        step = moved[:, :3] - rows[:, :3]
        assert np.allclose(step, step[0], atol=1e-5) and 0 < np.abs(step).max() < 0.2001
        assert np.array_equal(moved[:, 3:], rows[:, 3:])
        faster = changed(seed, speed=0.5)
        assert np.allclose(faster[:, :5], rows[:, :5], atol=1e-5) and len(np.unique(faster[:, 5])) == 1
        assert 1 / 1.5001 < faster[0, 5] < 1.5001 and abs(faster[0, 5] - 1) > 1e-4
        cut = changed(seed, crop=0.3)
        kept = cut[:, 4].astype(int)
        slope, start = np.polyfit(rows[kept, 3], cut[:, 3], 1)  # the kept stretch fills the time, or leaves rests
        assert 1 / 1.6 < slope < 1 / 0.4 and np.allclose(cut[:, 3], slope * rows[kept, 3] + start, atol=1e-5)
        late = slope * rows[:, 3] + start
        assert kept.tolist() == np.flatnonzero((late >= 0) & (late < 1)).tolist()
        assert -0.3001 < -start / slope < 0.3001 and -0.3001 < 1 - (1 - start) / slope < 0.3001
    lost = [1 - len(changed(seed, dropout=0.5)) / 300 for seed in range(40)]
    assert min(lost) < 0.05 and 0.42 < max(lost) < 0.58


def test_scales_are_medians_of_the_videos_and_of_their_columns(tmp_path):
    rng = np.random.default_rng(0)
    made = [video(f"v{k}", frames=9 + k, seed=k) for k in range(3)]
    for one in made:
        values = {SPEED: rng.normal(0.5, 2, len(one.points)), kept_name("snr"): rng.gamma(2, 3, len(one.points))}
        one.extra = {name: own.astype(np.float32) for name, own in values.items()}
        one.extra[kept_name("snr")][3] = np.nan
    with CloudsWriter(tmp_path / "c.h5", class_names=["a", "b"], fields=[SPEED, kept_name("snr")]) as writer:
        for one in made:
            writer.write(one)
    found = measured_scales(CloudsReader(tmp_path / "c.h5"), [0, 1, 2], ("speed", "snr"))
    away = [np.linalg.norm(one.points - np.median(one.points, axis=0), axis=1) for one in made]
    speed, snr = (np.concatenate([one.extra[name] for one in made]) for name in (SPEED, kept_name("snr")))
    spreads = [np.ptp(np.nanquantile(own, [0.1, 0.9])) / 2 for own in (speed, snr)]
    expected = [2 * np.median(np.concatenate(away)), 0, spreads[0], np.nanmedian(snr), spreads[1]]
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_a_batch_in_training_is_shared_by_the_members_in_its_order(tmp_path):
    config = config_of(tmp_path, [video()])
    model = Kinet(config)
    clips = torch.from_numpy(
        np.stack([in_slots(slot_rows(video(seed=k), config), config, np.random.default_rng(0)) for k in range(5)])
    )
    model.train()
    torch.manual_seed(0)
    for layer in model.modules():
        if isinstance(layer, torch.nn.Dropout):
            layer.p = 0.0
    together = model.static_logits(clips)
    members = model.static.members
    for k in range(2):
        assert torch.allclose(together[k::2], torch.log(members[k].scores(clips[k::2], NO_FOREST)), atol=1e-5)
    mean = torch.softmax(model.eval().static_logits(clips), -1)
    expected = torch.stack([one.scores(clips, NO_FOREST) for one in members]).mean(0)
    assert torch.allclose(mean, expected, atol=1e-6)


@pytest.mark.parametrize("part", ["all", "head", "probe"])
def test_no_member_learns_from_the_fold_that_it_judges_alone(tmp_path, part):
    config = config_of(tmp_path, [video(str(k), seed=k) for k in range(6)])
    reader = CloudsReader(tmp_path / "c.h5")
    source = ClipSource(reader, range(6), config, timing="slots", folds={0: 0, 1: 1, 2: 0})
    clips = torch.from_numpy(np.stack([source.load(source.video_clips(k, 1)[0], k) for k in range(6)]))
    model = Kinet(config)
    nobody = model.static._voting_members(torch.tensor([0, 1, 0, -1, -1, -1]))
    assert nobody.tolist() == [[False, True], [True, False], [False, True], [False, True], [True, False], [False, True]]
    freeze(model.static, part)
    train_mode(model.static, part)
    model.static_logits(clips[:1]).sum().backward()
    grads = [sum(p.grad is not None for p in one.parameters()) for one in model.static.members]
    assert grads[0] == 0 < grads[1]
    scores = torch.softmax(model.eval().static_logits(clips), -1)
    for k, member in ((0, 0), (1, 1), (2, 0)):
        alone = model.static.members[member].scores(clips[k : k + 1], NO_FOREST)
        assert torch.allclose(scores[k], alone[0], atol=1e-6)


def test_processes_that_share_a_batch_wait_for_one_another_equally_often(tmp_path, monkeypatch):
    """A member without a clip in one process still joins the sums of norms; they would mix with another member's."""
    config = config_of(tmp_path, [video()]).changed(copies=True, slot_details=True)
    clip = torch.from_numpy(in_slots(slot_rows(video(), config), config, np.random.default_rng(0)))[None]
    calls = []
    monkeypatch.setattr(sync_norm, "_summed", lambda values: calls.append(tuple(values.shape)) or values)
    counts = []
    for clips in (clip, clip.repeat(2, 1, 1, 1)):  # for one member of two, and for both
        model = Kinet(config).train()
        sync_norm.synchronize_norms(model)
        calls.clear()
        model.static_logits(clips).sum().backward()
        counts.append(list(calls))
        assert all(torch.isfinite(value).all() for value in model.state_dict().values())
        assert all(one.grad is not None for member in model.static.members for one in member.parameters())
    assert counts[0] == counts[1] and counts[0]


def test_copies_are_mirrored_or_reversed_and_have_classifiers_of_their_own(tmp_path):
    config = config_of(tmp_path, [video()]).changed(copies=True)
    clip = torch.from_numpy(in_slots(slot_rows(video(), config), config, np.random.default_rng(0)))[None]
    member = Kinet(config).static.members[0]
    kinds = torch.arange(4)
    plain, mirrored, reverse, both = member._copied(clip.expand(4, -1, -1, -1), kinds)
    assert torch.equal(plain, clip[0]) and torch.equal(mirrored[..., 0], -plain[..., 0])
    assert torch.equal(mirrored[..., 1:], plain[..., 1:]) and torch.equal(
        both, mirrored.flip(0) * both[..., 4:5].new_tensor([1, 1, 1, 1, -1, -1])
    )
    assert torch.equal(reverse[..., :4], plain.flip(0)[..., :4]) and torch.equal(
        reverse[..., 4:], -plain.flip(0)[..., 4:]
    )
    one = torch.tensor([2])
    member.train()(member._copied(clip, one), one).sum().backward()
    assert (member.classify.weight.grad.view(4, 2, -1).abs().sum((1, 2)) > 0).tolist() == [False, False, True, False]
    member.eval()
    each = [torch.softmax(member(member._copied(clip, one), one), -1) for one in kinds[:, None]]
    assert torch.allclose(member.scores(clip, NO_FOREST), torch.stack(each).mean(0), atol=1e-6)


@pytest.mark.parametrize("part", ["all", "head", "probe"])
def test_whatever_learns_of_a_member_it_learns_one_copy_of_each_clip(tmp_path, part):
    """All four would cost four times as much, and be learned together, while each has a classifier of its own."""
    config = config_of(tmp_path, [video()]).changed(copies=True)
    clip = torch.from_numpy(in_slots(slot_rows(video(), config), config, np.random.default_rng(0)))[None]
    model, seen = Kinet(config), []
    branch = model.static
    freeze(branch, part)
    train_mode(branch, part)
    for member in branch.members:
        member.register_forward_hook(lambda _, given, __: seen.append(len(given[0])))
    model.static_logits(clip).sum().backward()
    assert sum(seen) == 1
    norms = [module.training for module in branch.modules() if isinstance(module, RowNorm)]
    assert norms and set(norms) == {part == "all"}


def test_details_tell_when_something_happens_and_are_not_moved_by_a_point_far_off(tmp_path):
    config = config_of(tmp_path, [video()], fields=()).changed(slot_details=True)
    assert network_config(Given("sparse"), 2).slot_details
    clips = torch.from_numpy(in_slots(slot_rows(video(), config), config, np.random.default_rng(0)))[None]
    far = clips.clone()
    far[0, 1, 7, :3] = 2.9
    before, after = slot_quantiles(clips).view(4, 5, 3), slot_quantiles(far).view(4, 5, 3)
    assert torch.allclose(before[1, 1:3], after[1, 1:3], atol=0.3) and before[:, 2, 1].diff().min() > 0
    assert torch.equal(before[0, 2], clips[0, 0, :, :3].sort(0).values[4]) and torch.isfinite(before).all()
    clips[0, 2] = 0  # a slot without points
    assert (slot_quantiles(clips).view(4, 5, 3)[2] == 0).all()
    # without layers over time, what is read is a sum and a maximum, or one slot after the other
    for details in (True, False):
        member = Kinet(config.changed(slot_details=details)).eval().static.members[0]
        member.over_time = torch.nn.ModuleList()
        here, late = (
            member(far, torch.zeros(1, dtype=torch.long)),
            member(far.flip(1), torch.zeros(1, dtype=torch.long)),
        )
        assert torch.allclose(here, late, atol=1e-6) != details


def test_whole_people_share_a_fold(tmp_path):
    videos = [video(str(k), label=k % 2) for k in range(12)]
    for k, one in enumerate(videos):
        one.subject = k // 4
    config_of(tmp_path, videos)
    reader = CloudsReader(tmp_path / "c.h5")
    found = cross_folds(reader, list(range(12)), 4, 0)
    assert [len({found[k] for k in range(12) if k // 4 == person}) for person in range(3)] == [1, 1, 1]
    assert sorted(set(found.values())) == [0, 1, 2]
    chosen, judged = carve_validation(reader, "cross", 0)
    assert chosen is judged and default_rule(reader, 4) == "cross" and default_rule(reader) == "subject"
    assert about_people(reader, chosen, judged) == "" and about_classes(reader, found) == ""
    by_class = {k: int(reader.labels[k]) for k in range(11)}  # no judge saw another video of its class
    assert "11 of these videos count as wrong" in about_classes(reader, by_class)


def test_the_data_choose_the_preset_unless_another_network_is_named(tmp_path):
    config_of(tmp_path, [video()])
    sparse = CloudsReader(tmp_path / "c.h5")
    assert preset_for(sparse, {}) == "sparse" and preset_for(sparse, {"epochs": 3}) == "sparse"
    assert preset_for(sparse, {"backbone": "dgcnn"}) == "quick" and preset_for(sparse, {"init": "x"}) == "quick"
    (tmp_path / "dense").mkdir()
    config_of(tmp_path / "dense", [video(points=65)])
    dense = CloudsReader(tmp_path / "dense" / "c.h5")
    length = int(dense.frame_counts[0])
    assert (
        preset_for(dense, {"frames": length // 4}) == "long"
        and preset_for(dense, {"frames": length // 4 + 1}) == "quick"
    )
    assert preset_for(dense, {"frames": 1, "timing": "uniform"}) == "quick"
    assert (
        preset_for(dense, {"frames": 1, "batch": 6})
        == preset_for(dense, {"frames": 1, "clips_per_video": 0})
        == "quick"
    )


def test_a_file_without_the_columns_is_refused(tmp_path):
    config = config_of(tmp_path, [video()])
    bare = video()
    bare.extra = {}
    with pytest.raises(DataError, match="no column speed.*--keep-fields speed$"):
        ClipSource(OneVideo.of(bare), [0], config, timing="slots")
    renamed = video()
    renamed.extra = {kept_name("Doppler"): renamed.extra[kept_name("speed")]}
    with pytest.raises(DataError, match=r"no column speed.*--keep-fields speed \(the file has Doppler: .*call it so"):
        ClipSource(OneVideo.of(renamed), [0], config, timing="slots")
    assert ClipSource(OneVideo.of(video()), [0], config, timing="slots").load(
        ClipSource(OneVideo.of(video()), [0], config, timing="slots").video_clips(0, None)[0], 0
    ).shape == (4, 8, 6)


def test_the_backbone_has_no_activations_to_explain(tmp_path):
    config = config_of(tmp_path, [video()])
    with pytest.raises(UsageError, match="no neighborhoods"):
        Kinet(config).eval()(torch.zeros(1, 4, 8, 6))
