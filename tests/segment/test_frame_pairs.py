"""Pairs of frames for training: which there are, and their true flow."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.segment.frame_pairs import PairSource, backward_flow, without_strays
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter, PartsReader
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
