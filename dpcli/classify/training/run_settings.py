"""The settings of a training run that are neither the network's nor the schedule's: which clips, and which weights to begin with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dpcli.errors import UsageError
from dpcli.runtime.settings.fields import Settings, setting


@dataclass(frozen=True)
class RunSettings(Settings):
    """Holds which clips are trained on, which videos validate, and which weights a run starts from.

    Raises UsageError where two starts are given.
    """

    timing: Literal["clips", "uniform", "slots"] = setting(
        "clips",
        "Frames of a clip: consecutive ones (clips), or spread over the video (uniform), or all of them in as many equal parts"
        " (slots, which the backbone slots reads).",
    )
    drop_short: bool = setting(
        False, "Leave out videos shorter than a clip, as other methods do, instead of padding them."
    )
    validation: str = setting(
        "auto",
        "Validation videos: split (the file's own); or taken from the training videos by subject, subjects:3,5, fold:3/10"
        " (counted from 0) or a fraction such as 0.15; or none; or cross (preset sparse: all videos are for training, and are"
        " judged by members that never saw them). auto: split where the file has one, else cross or subject, or 0.15 without"
        " subjects.",
    )
    augment: Literal["ours", "sparse", "peers", "release", "none"] = setting(
        "ours",
        "Random changes of training clips, which augment_... settings adjust one by one: ours; sparse; peers (axis scales from"
        " the camera, as other methods have on MSR-Action3D); release (the published code's); or none.",
    )
    pretrain: bool = setting(
        False,
        "Train the static stream alone on single clouds (ModelNet40), for static_from: frames = 1, epochs_dynamic = 0.",
    )
    init: str | None = setting(
        None,
        "A trained or shipped model, with whose two streams training starts; it may have other frames, or other classes (its"
        " last layers are then new).",
    )
    static_from: str | None = setting(
        None, "A trained model, with whose static stream training starts (rows ii and iv of table 3.1)."
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.static_from and self.init:
            raise UsageError("--init starts both streams, static_from the static one: give one of them")
