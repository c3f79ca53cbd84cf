"""The learning-rate schedule: published steps, a warm-up, and its end."""

from __future__ import annotations

import pytest

from dpcli.classify.training.learning_rate_schedule import learning_rate
from dpcli.classify.training.schedule import Schedule


def test_the_staircase_is_the_published_one():
    schedule = Schedule(batch=8, decay="staircase")
    per_stair = 200_000 // 8
    rates = [learning_rate(schedule, 0, step, 10**9) for step in (0, per_stair - 1, per_stair, 2 * per_stair)]
    assert rates == pytest.approx([1e-3, 1e-3, 7e-4, 4.9e-4])
    assert learning_rate(schedule, 0, 10**8, 10**9) == 1e-5


def test_a_cosine_rises_for_a_tenth_and_ends_near_zero():
    schedule = Schedule(learning_rate=0.2, learning_rate_dynamic=0.1)
    static = [learning_rate(schedule, 0, step, 2000) for step in range(2000)]
    assert static[0] == pytest.approx(0.2 / 100) and max(static) == static[99] == static[100] == 0.2
    assert all(a > b for a, b in zip(static[100:], static[101:])) and 0 < static[-1] < 1e-6
    assert static[1050] == pytest.approx(0.1)  # half way
    short = [learning_rate(schedule, 0, step, 200) for step in range(200)]
    assert short[:20] == pytest.approx([0.01 * (step + 1) for step in range(20)]) and short[20] == 0.2 > short[21]
    assert [learning_rate(schedule, 1, step, 2000) for step in range(2000)] == pytest.approx([r / 2 for r in static])


def test_a_stage_of_one_step_has_a_rate():
    assert learning_rate(Schedule(), 0, 0, 1) == learning_rate(Schedule(decay="constant"), 0, 5, 10) == 1e-3
