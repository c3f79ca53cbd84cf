"""How long and how fast a Kinet is trained."""

from __future__ import annotations

import math
from dataclasses import dataclass

from dpcli.errors import UsageError

DECAYS = ("cosine", "staircase", "constant")


@dataclass(frozen=True)
class Schedule:
    """How long and how fast. Learning rates are Adam's; `staircase` is the release's x0.7 every 200,000 clips, floor 1e-5."""

    epochs: tuple[int, int] = (150, 150)  # static, dynamic
    batch: int = 16
    learning_rate: float = 1e-3
    learning_rate_dynamic: float | None = None  # None: the same
    decay: str = "cosine"  # cosine (after a short warm-up, to zero) | staircase | constant
    weight_decay: float = 0.0
    label_smoothing: float = 0.0
    clips_per_video: int | None = 1  # per epoch; None: every start
    validate_every: int = 1  # epochs
    validation_clips: int = 4  # per video
    accumulate: int = (
        1  # parts a batch is computed in, one after the other: less memory; batch norm sees one part at a time
    )
    amp: bool = False  # matrix products in bfloat16
    workers: int = 0  # processes that load clips; 0: this one
    draws: int | None = (
        None  # dynamic stage: fixed draws of each clip in turn, neighbors searched once; None: one an epoch
    )

    def __post_init__(self) -> None:
        dynamic = self.learning_rate_dynamic
        problem = {
            f"--batch {self.batch}: expected at least 1": self.batch < 1,
            f"--epochs {self.epochs[0]}: expected 0 or more": self.epochs[0] < 0,
            f"--epochs-dynamic {self.epochs[1]}: expected 0 or more": self.epochs[1] < 0,
            f"--lr {self.learning_rate}: expected a number above 0": not self.learning_rate > 0,
            f"--lr-dynamic {dynamic}: expected a number above 0": dynamic is not None and not dynamic > 0,
            f"--label-smoothing {self.label_smoothing}: expected 0 to below 1": not 0 <= self.label_smoothing < 1,
            f"--decay {self.decay}: expected cosine, staircase or constant": self.decay not in DECAYS,
            f"--accumulate {self.accumulate}: expected at least 1": self.accumulate < 1,
            f"--workers {self.workers}: expected 0 or more": self.workers < 0,
            f"--draws {self.draws}: expected 0 (new every epoch) or more": self.draws is not None and self.draws < 1,
            f"--clips-per-video {self.clips_per_video}: expected 0 (every start) or more": (self.clips_per_video or 1)
            < 1,
        }
        for message, wrong in problem.items():
            if wrong:
                raise UsageError(message)

    def share(self, processes: int) -> int:
        """Clips of a batch that one process takes at a time. UsageError when they don't divide."""
        parts = processes * self.accumulate
        if self.batch % parts:
            raise UsageError(
                f"--batch {self.batch}: the batch of all together has to divide by {processes} processes"
                f" x --accumulate {self.accumulate}"
            )
        return self.batch // parts

    def rate(self, stage: int, step: int, steps: int) -> float:
        """Learning rate at an optimizer step of a stage (0 static, 1 dynamic) with `steps` in all."""
        top = self.learning_rate if stage == 0 or self.learning_rate_dynamic is None else self.learning_rate_dynamic
        if self.decay == "constant":
            return top
        if self.decay == "staircase":
            return max(top * 0.7 ** (step * self.batch // 200_000), 1e-5)
        warm = max(1, min(100, steps // 10))
        if step < warm:
            return top * (step + 1) / warm
        return top * 0.5 * (1 + math.cos(math.pi * (step - warm) / max(steps - warm, 1)))
