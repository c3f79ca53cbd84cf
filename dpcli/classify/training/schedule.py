"""The settings of how long and how fast a Kinet is trained; how the learning rate falls is in `learning_rate_schedule.py`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dpcli.errors import UsageError
from dpcli.runtime.settings.fields import Settings, setting


@dataclass(frozen=True)
class Schedule(Settings):
    """Holds the settings of both training stages: epochs, batch, learning rates, regularization, and how clips are computed.

    Raises UsageError for values out of range.
    """

    epochs: int = setting(150, "Epochs of the static stage.", least=0)
    epochs_dynamic: int = setting(
        150, "Epochs of the dynamic stage, which is trained on the frozen static stream.", least=0
    )
    batch: int = setting(16, "Clips per step, of all processes together.", least=1)
    learning_rate: float = setting(1e-3, "Adam's learning rate at its highest.", above=0, name="lr")
    learning_rate_dynamic: float | None = setting(
        None, "Adam's learning rate in the dynamic stage; none: as lr.", above=0, name="lr_dynamic"
    )
    decay: Literal["cosine", "staircase", "constant"] = setting(
        "cosine",
        "Course of the learning rate: cosine (to 0, after a short warm-up), staircase (times 0.7 every 200,000 clips, as the"
        " published code does), or constant.",
    )
    weight_decay: float = setting(0.0, "Weight decay of AdamW, for matrices and the last layer's biases.", least=0)
    label_smoothing: float = setting(
        0.0, "Share of each label spread over all classes: streams become less confident.", least=0, below=1
    )
    fine_tune: Literal["all", "head", "probe", "auto"] = setting(
        "all",
        "Layers of a model given by --init that are trained: all, the head of each stream, or its last layer (probe); auto: by"
        " the number of videos per class. With --init the preset auto takes auto and the model's own network.",
    )
    clips_per_video: int = setting(1, "Random clips per video and epoch; 0 takes every start.", least=0)
    video_loss: bool = setting(
        False,
        "True: one loss per video, of the mean logits of its clips_per_video clips, each from another part of it, as a prediction"
        " averages them; false: one loss per clip.",
    )
    validate_every: int = setting(1, "Epochs from one validation to the next.", least=1)
    validation_clips: int = setting(4, "Clips per video in a validation.", least=1)
    accumulate: int = setting(
        1,
        "Parts that a batch is computed in, one after the other: less memory, but batch norm sees one part at a time.",
        least=1,
    )
    amp: bool | None = setting(
        None, "Matrix products in bfloat16; none: on GPUs that support it (Ampere and later) only."
    )
    workers: int | None = setting(
        None, "Processes that load clips; none: 0 on a CPU, with a GPU 4 or as many as there are CPUs.", least=0
    )
    draws: int = setting(
        0,
        "Fixed draws of every clip (start, points, augmentation) that the dynamic stage uses in turn; their neighbors are searched"
        " once and kept in an unnamed file in the folder (preset thesis: 0.44 MB per clip and draw, quick 0.03); 0: a new draw in"
        " every epoch.",
        least=0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.video_loss and self.clips_per_video < 2:
            raise UsageError(
                f"video_loss = true with clips_per_video = {self.clips_per_video}: expected two clips per video or more, such as"
                " clips_per_video = 4"
            )

    @property
    def clips_per_loss(self) -> int:
        """Returns how many clips, all of one video, a loss judges by the mean of their logits."""
        return self.clips_per_video if self.video_loss else 1

    @property
    def stage_epochs(self) -> tuple[int, int]:
        """Returns the epochs of both stages: static, dynamic."""
        return self.epochs, self.epochs_dynamic

    def share(self, processes: int) -> int:
        """Returns how many clips of a batch one process takes at a time. Raises UsageError when the batch doesn't divide.

        >>> Schedule(batch=16, accumulate=2).share(processes=4)
        2
        """
        parts = processes * self.accumulate
        if self.batch % (parts * self.clips_per_loss):
            together = (
                f" x clips_per_video = {self.clips_per_video}, which video_loss keeps together"
                if self.video_loss
                else ""
            )
            raise UsageError(
                f"batch = {self.batch}: the batch of all together has to divide by {processes} processes"
                f" x accumulate = {self.accumulate}{together}"
            )
        return self.batch // parts
