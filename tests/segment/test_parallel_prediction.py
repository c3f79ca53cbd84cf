"""The network works beside the search for flows: sooner, and with the same result."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import torch

from dpcli.segment.network.part_network import FrameParts
from dpcli.segment.prediction import predict_parts
from dpcli.segment.prediction_settings import Refinement
from dpcli.segment.segmenters import NetworkSegmenter
from dpcli.store import CloudSequence
from tests.support.segmenters import FunctionSegmenter


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def sequence() -> CloudSequence:
    points = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)
    return CloudSequence.from_frames("s", [points + np.float32(0.1 * t) for t in range(3)])


def halves(points: torch.Tensor) -> FrameParts:
    """A network that cuts each frame in two."""
    side = (points[..., 0] > points[..., 0].mean(1, keepdim=True)).float()
    return FrameParts(torch.stack([0.9 - 0.8 * side, 0.1 + 0.8 * side], -1), None)


def to_center(first: torch.Tensor, second: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    shift = second.mean(0) - first.mean(0)
    return shift.expand_as(first).clone(), (-shift).expand_as(second).clone()


def predict(segmenter, estimate):
    return predict_parts(sequence(), segmenter, estimate, Refinement(), 0)


def test_flows_and_network_meet(two_threads) -> None:
    """Each waits for the other to have begun, which ends well only side by side, with one of torch's threads each."""
    begun = {"flow": threading.Event(), "network": threading.Event()}
    threads = []

    def meet(own: str, other: str) -> None:
        threads.append(torch.get_num_threads())
        begun[own].set()
        assert begun[other].wait(90), f"no {other} while there is a {own}"

    def network(points):
        meet("network", "flow")
        return halves(points)

    def estimate(first, second):
        meet("flow", "network")
        return to_center(first, second)

    predict(NetworkSegmenter(network, torch.device("cpu")), estimate)
    assert set(threads) == {1} and torch.get_num_threads() == 2


def test_the_result_is_that_of_one_after_the_other(two_threads) -> None:
    network = NetworkSegmenter(halves, torch.device("cpu"))
    labels, sample = predict(network, to_center)
    seen = []

    def afterwards(frames, flows):
        seen.extend(flows)
        return network.segment(frames, flows)

    same, again = predict(FunctionSegmenter(afterwards), to_center)
    assert sorted(seen) == [(0, 1), (1, 0), (1, 2), (2, 1)]
    assert np.array_equal(labels, same) and np.array_equal(sample.motion, again.motion)
    assert np.array_equal(sample.probability, again.probability) and len(np.unique(labels)) == 2


@pytest.mark.parametrize("broken", ["network", "flow"])
def test_an_error_in_either_comes_out(two_threads, broken: str) -> None:
    def fail(*_):
        raise ValueError(broken)

    with pytest.raises(ValueError, match=broken):
        predict(
            NetworkSegmenter(fail if broken == "network" else halves, torch.device("cpu")),
            fail if broken == "flow" else to_center,
        )
    assert torch.get_num_threads() == 2
