"""Pairs of frames for training: which there are, and their true flow."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dpcli.errors import DataError
from dpcli.segment.frame_pairs import PairSource, backward_flow, without_strays
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter, PartsReader, PartsWriter
from tests.support.drawers import drawer, predicted


def test_training_leaves_pairs_without_points_out(tmp_path, capsys):
    clouds = [drawer("d", 0, frames=5).frame(t) for t in range(5)]
    clouds[2] = np.zeros((0, 3), np.float32)
    with CloudsWriter(tmp_path / "a.h5") as writer:
        writer.write(CloudSequence.from_frames("a", clouds))
        writer.write(drawer("b", 1))
        writer.write(CloudSequence.from_frames("c", [clouds[0], clouds[2]]))
    reader = CloudsReader(tmp_path / "a.h5")
    source = PairSource(reader, [0, 1, 2], 20, 0)
    assert [(p.number, p.sequence, p.first) for p in source.pairs] == [(0, 0, 0), (1, 0, 3), (2, 1, 0), (3, 1, 1)]
    assert "3 of 7 pairs of frames left out" in capsys.readouterr().err
    assert all(np.isfinite(source.load(pair).points).all() for pair in source.pairs)
    with pytest.raises(DataError, match="all with a frame without points"):
        PairSource(reader, [2], 20, 0)


def test_pairs_with_scene_flow_are_those_with_poses(data, flow_data):
    """Where the file tells both ways, both are equal; elsewhere the way back is found among the points (below)."""
    ours, theirs = (PairSource(CloudsReader(path), [0, 1], 48, 3) for path in (flow_data, data))
    for pair in ours.pairs:
        one, other = ours.load(pair), theirs.load(pair)
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_allclose(one.flow[0], other.flow[0], atol=1e-6)
        if pair.first == 1:  # of three frames
            np.testing.assert_allclose(one.flow[1], other.flow[1], atol=1e-6)
        else:
            assert np.linalg.norm(one.flow[1] - other.flow[1], axis=1).mean() < 0.1 * np.abs(other.flow[1]).max()
    still = PairSource(CloudsReader(flow_data), [0], 48, 3)
    still.fields = ["part"]
    assert still.load(still.pairs[0]).flow is None


def test_the_way_back_ends_where_the_way_there_began():
    rng = np.random.default_rng(0)
    points, order = rng.normal(size=(40, 3)), rng.permutation(40)
    flow = rng.normal(size=(40, 3)) * 0.3
    np.testing.assert_array_equal(backward_flow(points, flow, (points + flow)[order]), -flow[order])


def test_true_flow_of_loaded_pairs_maps_parts_onto_parts(data):
    source = PairSource(CloudsReader(data), [0], 60, 0)
    pair = source.load(source.pairs[0])
    moved = pair.points[0] + pair.flow[0]
    for part in (0, 1):  # independent samples of the same solid: the same extent within sampling
        a, b = moved[pair.part[0] == part], pair.points[1][pair.part[1] == part]
        assert np.abs(a.mean(0) - b.mean(0)).max() < 0.08


@pytest.mark.parametrize("points", [63, 64, 320, 2000])
def test_a_few_points_far_from_all_others_are_strays(points):
    rng = np.random.default_rng(points)
    cloud = rng.random((points, 3))
    most = min(points // 64, 8)
    for strays in range(most + 3):
        far = 20 + rng.random((strays, 3))
        kept = without_strays(np.concatenate([cloud, far]))
        expected = cloud if 0 < strays <= min((points + strays) // 64, 8) else np.concatenate([cloud, far])
        np.testing.assert_array_equal(kept, expected)
    assert len(without_strays(np.ones((points, 3)))) == points
    assert len(without_strays(np.concatenate([np.zeros((points, 3)), np.ones((1, 3))]))) == points + 1


def test_a_pose_without_an_inverse_is_bad_data(tmp_path):
    from tests.support.drawers import drawer

    sequence = drawer("d", 0)
    sequence.pose[1] = 0
    with CloudsWriter(tmp_path / "d.h5", class_names=["drawer"], fields=["part", "pose"]) as writer:
        writer.write(sequence)
    with CloudsReader(tmp_path / "d.h5") as reader, pytest.raises(DataError, match="d: a pose is not a rigid motion"):
        source = PairSource(reader, [0], 20, 0)
        source.load(source.pairs[0])


def test_points_of_unknown_part_count_in_no_flow_error(tmp_path):
    """Poses don't tell how they move: the error of no motion at all is that of the points whose part is known."""
    from types import SimpleNamespace

    from dpcli.segment.flow.trainer import FlowTrainer
    from dpcli.segment.training.trainer import Trainer

    sources = []
    for name in ("whole", "half", "none"):
        sequence = drawer("d", 0)
        sequence.part[sequence.part >= {"whole": 2, "half": 1, "none": 0}[name]] = -1
        with CloudsWriter(tmp_path / f"{name}.h5", fields=["part", "pose"]) as writer:
            writer.write(sequence)
        sources.append(PairSource(CloudsReader(tmp_path / f"{name}.h5"), [0], 48, 3))
    whole, half = ([source.load(pair) for pair in source.pairs] for source in sources[:2])
    for pairs, source, most in ((whole, sources[0], 2), (half, sources[1], 1), ([], sources[2], 0)):
        norms = [np.linalg.norm(own.flow, axis=-1)[own.part < most] for own in whole] if most else []
        counted: dict[str, float] = {}
        loaded = pairs or [source.load(pair) for pair in source.pairs]
        Trainer._measure_flow_error(SimpleNamespace(_count=counted.update), torch.zeros(2, 2, 48, 3), loaded)
        assert counted == ({"flow_error": pytest.approx(np.concatenate(norms).mean(), rel=1e-5)} if most else {})
        judge = SimpleNamespace(held=source, model=_Still(), device=torch.device("cpu"))
        _, error = FlowTrainer._validate(judge)
        forth = [np.linalg.norm(own.flow[0], axis=-1)[own.part[0] < most].mean() for own in whole] if most else []
        assert error == (pytest.approx(np.mean(forth), rel=1e-5) if most else None)


class _Still(torch.nn.Module):
    """Says that nothing moves."""

    def forward(self, first, second):
        return [torch.zeros_like(first)]


def test_a_pair_of_a_prediction_is_read_alone(tmp_path):
    """What is read of two frames is what they are in the whole, whatever pairs of frames the file tells."""
    sequence = drawer("d", 0, frames=5)
    sizes = np.diff(sequence.frame_offsets)
    rng = np.random.default_rng(0)
    said = np.array([(i, j) for i in range(5) for j in range(5) if i != j], np.int32)[rng.permutation(20)[:17]]
    motion = np.tile(np.eye(4), (17, 2, 1, 1))
    motion[:, :, :3, 3] = rng.normal(size=(17, 2, 3))
    flow = [rng.normal(size=(sizes[i], 3)) for i, _ in said]
    probability = rng.uniform(size=(len(sequence.points), 2))
    with PartsWriter(tmp_path / "p.h5", num_parts=2, fields=["part"]) as writer:
        for name in ("before", "d"):
            sequence.name, sequence.pose = name, None
            writer.write(sequence, probability, said, motion, flow)
    with PartsReader(tmp_path / "p.h5") as reader:
        whole = reader.read_parts(1)
        for first, end in ((0, 5), (0, 2), (3, 5), (1, 4), (2, 3)):
            own = reader.read_parts_between(1, first, end)
            rows = [q for q, pair in enumerate(whole.pairs) if first <= pair.min() and pair.max() < end]
            np.testing.assert_array_equal(own.pairs, whole.pairs[rows] - first)
            np.testing.assert_array_equal(own.motion, whole.motion[rows])
            assert [len(one) for one in own.flow] == [len(whole.flow[row]) for row in rows]
            assert all((one == whole.flow[row]).all() for one, row in zip(own.flow, rows))
            points = slice(*sequence.frame_offsets[[first, end]])
            np.testing.assert_array_equal(own.probability, whole.probability[points])


def test_a_prediction_gives_pairs_its_parts_and_motions(tmp_path):
    """The true parts and motions, told by a parts file, give what poses give; unsure points have no part."""
    path = predicted(tmp_path / "parts.h5", [drawer("d", 0)], unsure=7)
    with CloudsWriter(tmp_path / "d.h5", fields=["part", "pose"]) as writer:
        writer.write(drawer("d", 0))
    ours, theirs = PairSource(PartsReader(path), [0], 48, 3), PairSource(CloudsReader(tmp_path / "d.h5"), [0], 48, 3)
    for pair in ours.pairs:
        one, other = ours.load(pair), theirs.load(pair)
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_allclose(one.flow, other.flow, atol=1e-5)
        assert 0 < (one.part == -1).sum() < 14  # of the seven in each frame, those that were drawn
        np.testing.assert_array_equal(one.part[one.part >= 0], other.part[one.part >= 0])
    short = PairSource(PartsReader(predicted(tmp_path / "one.h5", [drawer("d", 0)], pairs=1)), [0], 48, 3)
    with pytest.raises(DataError, match="'d' has no motion from frame 1 to 2; predict it again"):
        short.load(short.pairs[1])
