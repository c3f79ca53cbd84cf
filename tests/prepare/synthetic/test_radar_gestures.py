"""Radar gestures: what a frame holds, whose speeds are measured, and that people differ."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.prepare.synthetic.human_figure import PARTS
from dpcli.prepare.synthetic.radar_gestures import (
    DOPPLER,
    INTENSITY,
    MOST_POINTS,
    RadarGestures,
    detect,
    draw_radar_subject,
    measure,
    reach_and_return,
)
from dpcli.runtime.seeds import generator


def test_frames_are_sparse_and_carry_both_columns():
    reader = RadarGestures(videos_per_class=1, frames=12)
    found = [reader.read(item, generator(0, k)).sequence for k, item in enumerate(reader.items())]
    sizes = np.concatenate([np.diff(one.frame_offsets) for one in found])
    assert sizes.min() >= 1 and sizes.max() <= MOST_POINTS and np.median(sizes) < 20
    for one in found:
        assert set(one.extra) == {DOPPLER, INTENSITY} and len(one.time) == one.num_frames
        assert all(len(values) == len(one.points) for values in one.extra.values())
    distance = np.concatenate([np.linalg.norm(one.points, axis=1) for one in found])
    assert distance.max() > 8 and np.median(distance) < 4  # outliers, and people


def test_a_body_that_comes_nearer_is_seen_with_its_speed_and_a_still_one_hardly():
    starts = np.zeros((3, len(PARTS), 3)) + [0, 0, 3]
    ends = starts + [0, 0.3, 0]
    radii = np.full(len(PARTS), 0.1)
    still = detect(radii, starts, ends, 1, generator(0))
    move = np.array([1, 0, -1])[:, None, None] * np.array([0, 0, 0.1])  # 0.1 m a frame: 1.5 m/s toward the radar
    moving = detect(radii, starts + move, ends + move, 1, generator(0))
    assert len(moving) > 5 * len(still)
    assert np.median(moving[:, 3]) == pytest.approx(-1.5, abs=0.05)


def test_without_noise_a_detection_stays_where_it_is_but_for_the_steps():
    rows = np.array([[0.3, -0.2, 2.0, 0.52, 20.0]])
    found = measure(rows, 0.0, generator(0))[0]
    np.testing.assert_allclose(found[:3], rows[0, :3], atol=0.03)
    assert found[3] == pytest.approx(0.5) and found[4] == 20.0


def test_the_way_from_rest_joins_the_path_without_changing_it():
    path = np.cumsum(generator(1).normal(size=(10, 3)), 0)
    shown = reach_and_return(path, generator(2))
    start = next(k for k in range(len(shown) - 9) if np.array_equal(shown[k : k + 10], path))
    assert len(shown) > 10 and 0 <= start <= len(shown) - 10


def test_people_differ_and_stay_themselves():
    people = [draw_radar_subject(0, k) for k in range(1, 21)]
    assert draw_radar_subject(0, 3) == people[2] != people[3]
    assert {one.left_handed for one in people} == {True, False}
    assert max(one.tempo for one in people) > 1.5 * min(one.tempo for one in people)
