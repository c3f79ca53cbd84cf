"""Parts and motions of one sequence: true motions, frames without points, poor input."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dpcli.segment.frame_pairs import frame_parts, sequence_scale, true_flow
from dpcli.segment.prediction import predict_parts
from dpcli.segment.prediction_settings import Refinement
from dpcli.segment.training.trainer import rand_index
from dpcli.store import CloudSequence
from tests.support.drawers import drawer
from tests.support.segmenters import FunctionSegmenter


def two_halves(frames, flows):
    """The right masks for points in the order of `drawer`."""
    masks = []
    for frame in frames:
        mask = torch.full((len(frame), 3), 1e-6)
        mask[: len(frame) // 2, 0], mask[len(frame) // 2 :, 2] = 1 - 2e-6, 1 - 2e-6
        masks.append(mask)
    return masks


def true_flows(sequence: CloudSequence, scale: float):
    """An estimator that knows the answer; frames are told apart by their first point."""
    clouds = [sequence.frame(t) for t in range(sequence.num_frames)]
    center = np.concatenate(clouds).mean(0)
    whole = [(c - center) * scale for c in clouds]

    def which(points):
        return int(np.argmin([np.abs(c[0] - points[0].numpy()).max() for c in whole]))

    def one(first, second):
        i, j = which(first), which(second)
        flow = true_flow(clouds[i], frame_parts(sequence, i), sequence.pose[i], sequence.pose[j])
        return torch.tensor(np.float32(flow * scale))

    def estimate(first, second):
        return one(first, second), one(second, first)

    return estimate


@pytest.mark.parametrize("pairs", ["adjacent", "all"])
def test_motions_are_the_true_ones_in_the_inputs_own_coordinates(pairs):
    """With the right masks and flows, part_motion is pose_j pose_i^-1 and flow follows, whatever place and unit."""
    sequence = drawer("d", 5)
    sequence.points = np.float32(sequence.points * 7 + [100, -50, 3])
    sequence.pose[:, :, :3, 3] = sequence.pose[:, :, :3, 3] * 7 + [100, -50, 3]
    scale = sequence_scale([sequence.frame(t) for t in range(3)])
    options = Refinement(pairs=pairs, icp=0, vote=False)  # where parts touch, a neighbor frame votes otherwise
    labels, sample = predict_parts(sequence, FunctionSegmenter(two_halves), true_flows(sequence, scale), options, 0)
    assert rand_index(torch.tensor(labels), torch.tensor(np.int64(sequence.part))) == 1
    for (i, j), motion, flow in zip(sample.pairs, sample.motion, sample.flow):
        truth = sequence.pose[j] @ np.linalg.inv(sequence.pose[i])
        assert np.abs(motion[[0, 2], :3, :3] - truth[:, :3, :3]).max() < 2e-3
        points = sequence.frame(i)
        moved = np.einsum("nij,nj->ni", truth[sequence.part[:60], :3, :3], points) + truth[sequence.part[:60], :3, 3]
        assert np.abs(flow - (moved - points)).max() < 1e-2  # of 7 units an object


@pytest.mark.parametrize("pairs", ["adjacent", "all"])
@pytest.mark.parametrize("empty", [(0,), (2,), (1, 3), (0, 5, 6)])
def test_frames_without_points_change_nothing_for_the_others(empty, pairs):
    whole = drawer("d", 5, frames=4)
    clouds, rest = [whole.frame(t) for t in range(4)], list(range(4))
    for t in empty:
        clouds.insert(t, np.zeros((0, 3), np.float32))
        rest = [k + (k >= t) for k in rest]
    holed = CloudSequence.from_frames("d", clouds)

    def halves_and_flow(found: list):
        """Masks from the points; flow from nearest neighbors; and what was asked for."""

        def estimate(first, second):
            found.append((len(first), len(second)))
            shift = 0.01 * float((first.sum() + 2 * second.sum()).sin())  # of the pair: threads ask in any order
            return torch.full_like(first, shift), torch.full_like(second, -0.01)

        return estimate

    asked, same = [], []
    options = Refinement(pairs=pairs, icp=0)
    labels, sample = predict_parts(whole, FunctionSegmenter(two_halves), halves_and_flow(asked), options, 0)
    found, holes = predict_parts(holed, FunctionSegmenter(two_halves), halves_and_flow(same), options, 0)
    np.testing.assert_array_equal(found, labels)
    np.testing.assert_array_equal(holes.probability, sample.probability)
    known = {tuple(pair): number for number, pair in enumerate(sample.pairs.tolist())}
    assert len(holes.pairs) == (len(clouds) - 1 if pairs == "adjacent" else len(clouds) * (len(clouds) - 1))
    for (i, j), motion, flow in zip(holes.pairs.tolist(), holes.motion, holes.flow):
        assert flow.shape == (len(clouds[i]), 3)
        if i in rest and j in rest:
            own = known[rest.index(i), rest.index(j)]
            np.testing.assert_array_equal(motion, sample.motion[own])
            np.testing.assert_array_equal(flow, sample.flow[own])
        else:
            assert (motion == np.eye(4)).all() and not flow.any()


@pytest.mark.parametrize("copied", [slice(None), slice(0, 7), slice(59, None)])
def test_copies_of_points_change_nothing(copied):
    """A segmenter sees each point of a frame once: vertices that faces share, and frames padded to one size, are no more points."""
    sequence = drawer("d", 5)
    frames = [sequence.frame(t) for t in range(sequence.num_frames)]
    padded = CloudSequence.from_frames("d", [np.concatenate([frame, *[frame[copied]] * 3]) for frame in frames])

    def still(first, second):
        return torch.zeros_like(first), torch.zeros_like(second)

    plain, few = predict_parts(sequence, FunctionSegmenter(two_halves), still, Refinement(icp=0), 0)
    found, said = predict_parts(padded, FunctionSegmenter(two_halves), still, Refinement(icp=0), 0)
    np.testing.assert_allclose(said.motion, few.motion, atol=1e-6)  # the center of the scaling may be another
    for t, frame in enumerate(frames):
        own = found[padded.frame_offsets[t] : padded.frame_offsets[t + 1]]
        once = plain[sequence.frame_offsets[t] : sequence.frame_offsets[t + 1]]
        np.testing.assert_array_equal(own, np.concatenate([once, *[once[copied]] * 3]))
        assert len(own) > len(frame)


def test_poor_sequences_get_an_answer():
    def anything(frames, flows):
        return [torch.softmax(torch.randn(len(f), 4, generator=torch.Generator().manual_seed(0)), 1) for f in frames]

    def still(first, second):
        return torch.zeros_like(first), torch.zeros_like(second)

    for name, frames in {
        "one frame": [np.random.default_rng(0).normal(size=(50, 3))],
        "one point": [np.zeros((1, 3)), np.ones((1, 3))],
        "an empty frame": [np.zeros((0, 3)), np.random.default_rng(0).normal(size=(9, 3))],
        "all equal": [np.ones((30, 3)), np.ones((40, 3))],
    }.items():
        sequence = CloudSequence.from_frames(name, [np.float32(f) for f in frames])
        labels, sample = predict_parts(sequence, FunctionSegmenter(anything), still, Refinement(points=32), 0)
        assert len(labels) == len(sequence.points) and np.isfinite(sample.probability).all(), name
        assert np.isfinite(sample.motion).all() and all(np.isfinite(f).all() for f in sample.flow), name
