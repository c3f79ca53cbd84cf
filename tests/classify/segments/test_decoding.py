"""The best division of a recording against all divisions, and the segments of made-up windows."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from dpcli.classify.confidence import Confidence
from dpcli.classify.segments.decoding import best_path, runs
from dpcli.classify.segments.recording import Cutting, WindowScores, cut


def worth(path: tuple[int, ...], evidence: np.ndarray, change: float) -> float:
    return sum(evidence[t, c] for t, c in enumerate(path)) - change * sum(a != b for a, b in zip(path, path[1:]))


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("least", [1, 2, 3])
def test_no_division_is_better(seed, least):
    rng = np.random.default_rng(seed)
    steps, classes, change = int(rng.integers(1, 8)), 3, float(rng.choice([0.0, 0.7]))
    evidence = rng.normal(size=(steps, classes))
    if seed % 3 == 0:
        evidence[:, 2] = -np.inf
    found = best_path(evidence, least, change)
    shortest = min(least, steps)
    legal = [
        path
        for path in product(range(classes), repeat=steps)
        if min(end - start for start, end in runs(np.array(path))) >= shortest
    ]
    assert tuple(found) in legal
    best = max(worth(path, evidence, change) for path in legal)
    assert worth(tuple(found), evidence, change) == pytest.approx(best)


def test_an_hour_takes_no_time_and_an_empty_recording_no_steps():
    assert len(best_path(np.random.default_rng(0).normal(size=(20_000, 21)), 2, 1.0)) == 20_000
    assert len(best_path(np.zeros((0, 3)), 2, 1.0)) == 0


def windows(classes: list[int], hop: int = 4, window: int = 8, sure: float = 0.9) -> WindowScores:
    """Windows, each of a class (-1: of none) it is sure of, with two classes to choose from."""
    rows = [[0.5, 0.5] if c < 0 else [sure, 1 - sure] if c == 0 else [1 - sure, sure] for c in classes]
    last = window - 1 + hop * np.arange(len(classes))
    return WindowScores(last, np.array(rows, np.float32), int(last[-1]) + 3)


def test_segments_cover_every_frame_and_change_halfway_between_windows():
    found = windows([0, 0, 0, 1, 1, 1, 1, 1])
    how = Cutting(window=8, hop=4, shortest=8, confidence=Confidence())
    made = cut(found, ["a", "b"], how)
    assert [one.name for one in made] == ["a", "b"]
    assert made[0].start == 0 and made[0].end == made[1].start and made[1].end == found.frames
    # window 2 is centered at frame 11.5 and window 3 at 15.5
    assert made[0].end == 14


def test_what_is_unsure_is_nothing_and_a_flicker_is_smoothed():
    how = Cutting(window=8, hop=4, shortest=8, confidence=Confidence(threshold=0.7))
    made = cut(
        windows([0, 0, 0, 0, 0, 0, 0, -1, -1, -1, -1, -1, -1, -1, -1, 1, 1, 1, -1, 1, 1, 1, 1, 1, 1], sure=0.99),
        ["a", "b"],
        how,
    )
    assert [one.name for one in made] == ["a", "", "b"]
    assert made[0].confidence == pytest.approx(0.99, abs=0.01) and made[1].confidence == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("threshold", [0.2, 0.5, 0.9, 0.99])
def test_an_action_between_pauses_is_found_whatever_the_threshold(threshold):
    how = Cutting(window=8, hop=2, shortest=8, confidence=Confidence(threshold=threshold))
    scores = np.full((22, 10), 0.1, np.float32)  # below every threshold
    scores[8:14] = np.eye(10)[0]
    found = WindowScores(7 + 2 * np.arange(22), scores, 50)
    made = cut(found, list("abcdefghij"), how)
    assert [one.name for one in made] == ["", "a", ""]


def test_one_window_is_one_segment():
    how = Cutting(window=8, hop=4, shortest=100, confidence=Confidence())
    assert [(one.start, one.end, one.name) for one in cut(windows([1]), ["a", "b"], how)] == [(0, 10, "b")]


@pytest.mark.parametrize("seed", range(60))
def test_no_segment_is_shorter_than_was_asked_for(seed):
    """Whatever window, hop and length; a hop that doesn't divide the length made segments too short."""
    rng = np.random.default_rng(seed)
    window = int(rng.integers(4, 40))
    hop, shortest, frames = rng.integers((1, 1, window), (window + 1, 2 * window, window + 400)).tolist()
    last = np.arange(window - 1, frames, hop)
    found = WindowScores(last, rng.dirichlet(np.full(3, 0.2), len(last)), frames)
    made = cut(found, ["a", "b", "c"], Cutting(window, hop, shortest, Confidence(threshold=0.3)))
    assert [one.start for one in made] == [0, *(one.end for one in made[:-1])] and made[-1].end == frames
    assert len(made) == 1 or min(one.end - one.start for one in made) >= shortest
