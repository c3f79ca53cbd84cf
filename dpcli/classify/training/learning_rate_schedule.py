"""The learning-rate schedule: which rate each optimizer step takes."""

from __future__ import annotations

import math

from dpcli.classify.training.schedule import Schedule

_STAIR, _FALL, _FLOOR = 200_000, 0.7, 1e-5  # the published code's staircase: clips, factor, least rate
_WARM_UP = 100  # steps, at most a tenth of all


def learning_rate(schedule: Schedule, stage: int, step: int, steps: int) -> float:
    """Returns the learning rate of an optimizer step of a stage (0 static, 1 dynamic) that has `steps` in all.

    With `cosine` it rises linearly over the first tenth of the steps (100 at most) and falls to 0 as half a cosine.

    >>> schedule = Schedule(learning_rate=0.01)
    >>> [round(learning_rate(schedule, 0, step, 20), 5) for step in (0, 1, 2, 11, 19)]
    [0.005, 0.01, 0.01, 0.005, 8e-05]
    """
    own = schedule.learning_rate_dynamic
    top = schedule.learning_rate if stage == 0 or own is None else own
    if schedule.decay == "constant":
        return top
    if schedule.decay == "staircase":
        return max(top * _FALL ** (step * schedule.batch // _STAIR), _FLOOR)
    warm = max(1, min(_WARM_UP, steps // 10))
    if step < warm:
        return top * (step + 1) / warm
    return top * 0.5 * (1 + math.cos(math.pi * (step - warm) / max(steps - warm, 1)))
