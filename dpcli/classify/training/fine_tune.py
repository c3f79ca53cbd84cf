"""Fine-tuning: which part of a trained network goes on learning from a person's own videos, and for how long.

A few videos can't teach a network's local features, and spoil them; many can. So the number of videos a class decides.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from torch import nn

from dpcli.classify.data.clips import DEVIATION
from dpcli.classify.data.validation_split import labeled
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.model_file import ModelInfo
from dpcli.classify.presets import PRESETS
from dpcli.classify.training.schedule import Schedule
from dpcli.errors import UsageError
from dpcli.runtime.progress import log
from dpcli.store import CloudsReader

_PROBE, _HEAD = 3, 20  # videos a class, at most, for which the last layers alone, or the heads alone, learn
_CLIPS = {"probe": 3000, "head": 5000, "all": 9000}  # that each stream sees in all
_RATE = 6e-3  # of heads and last layers: at a sixth of it the dynamic stream lagged 20 points behind what it can learn
_EPOCHS = 5, 100  # at least, at most, of what is frozen but for its last layers
_SHORTEST = 4  # where everything learns: this part of the epochs of a training from nothing, at least
_UNIT = 2.0  # times as large or small as what a network learned from: another unit
_LOOKED_AT = 50  # videos at most, evenly over those for training: files are often in the order of their classes
_TELLING = 16  # points of a frame that tell how tall a body is, at least


def part_for(reader: CloudsReader) -> str:
    """Returns which part of a network learns from a file's training videos: `probe`, `head` or `all`, by the median number of
    videos a class. Raises DataError where none has a label."""
    labels = reader.labels[labeled(reader, "train")]
    videos = float(np.median(np.unique(labels, return_counts=True)[1]))
    return "probe" if videos <= _PROBE else "head" if videos <= _HEAD else "all"


def settings_of_model(info: ModelInfo) -> dict[str, Any]:
    """Returns the groups of settings, as a preset has them, that a run from a model begins with: its network and its timing."""
    base = PRESETS["sparse" if info.timing == "slots" else "quick"]
    return {**base, "network": info.config, "run": replace(base["run"], timing=info.timing)}


def settings_from(info: ModelInfo, reader: CloudsReader, part: str | None) -> dict[str, Any]:
    """Returns `settings_of_model` fitted to a file: the part that learns (chosen by the data for `auto` and None), and as many
    epochs as the data need.

    Raises DataError where no training video has a label.
    """
    base = settings_of_model(info)
    chosen = part_for(reader) if part in (None, "auto") else part
    return {
        **base,
        "network": _in_its_unit(info.config, reader).changed(forest=(0, 0)),
        "schedule": _schedule(base["schedule"], chosen, len(labeled(reader, "train"))),
    }


def _schedule(preset: Schedule, part: str, videos: int) -> Schedule:
    """Returns how long and how fast a part of a network learns from so many videos.

    Where everything learns, it is at the preset's rate and for up to its epochs, since a slower or shorter training ends below
    one from nothing. So is what learns of a network for sparse clouds, whose rate was not tried.
    """
    epochs = []
    for own in preset.stage_epochs:
        least, most = (-(-own // _SHORTEST), own) if part == "all" else _EPOCHS
        epochs.append(min(max(round(_CLIPS[part] / videos), least), most) if own else 0)
    return replace(
        preset,
        epochs=epochs[0],
        epochs_dynamic=epochs[1],
        learning_rate=_RATE if part != "all" and preset.epochs_dynamic else preset.learning_rate,
        fine_tune=part,
        validate_every=max(1, epochs[0] // 10),
    )


def _in_its_unit(config: KinetConfig, reader: CloudsReader) -> KinetConfig:
    """Returns a network's configuration that brings bodies to the height it learned from where the data are in another unit.

    A network that only centers its clips was trained on bodies about as tall as `height` makes them.
    """
    if config.normalize != "center":
        return config
    videos = labeled(reader, "train")
    deviation = _deviation(reader, videos[:: -(-len(videos) // _LOOKED_AT)])
    if deviation is None or DEVIATION / _UNIT < deviation < DEVIATION * _UNIT:
        return config
    log.warn(
        f"{reader.path}: y deviates by {deviation:.3g} in a frame, by about {DEVIATION} in what the model learned from; bodies are"
        " made as tall as those (normalize = height; --set normalize=center leaves them)"
    )
    return config.changed(normalize="height")


def _deviation(reader: CloudsReader, videos: list[int]) -> float | None:
    """Returns how much y deviates in the median of some frames of the videos; None where no frame has enough points to tell."""
    found = []
    for i in videos:
        count = int(reader.frame_counts[i])
        video = reader.read(i, sorted({0, count // 3, 2 * count // 3}), fields=())
        frames = [video.frame(t) for t in range(video.num_frames)]
        found += [frame[:, 1].std() for frame in frames if len(frame) >= _TELLING]
    return float(np.median(found)) if found else None


def resolved(schedule: Schedule, reader: CloudsReader) -> Schedule:
    """Returns the schedule with the part that the data choose in place of `auto`."""
    return replace(schedule, fine_tune=part_for(reader)) if schedule.fine_tune == "auto" else schedule


def freeze(branch: nn.Module, part: str) -> None:
    """Stops the gradients of what doesn't learn. Raises UsageError for a network without such a part."""
    if part == "all":
        return
    for name, parameter in branch.named_parameters():
        parameter.requires_grad_(_learns(name.rpartition(".")[0], part))
    if not any(parameter.requires_grad for parameter in branch.parameters()):
        raise UsageError(
            f"--fine-tune {part}: this backbone has no layers named head or classify; take --fine-tune all"
        )


def train_mode(branch: nn.Module, part: str) -> None:
    """Sets what learns to training mode, and the rest, batch norms above all, to evaluation mode.

    The branch itself trains whatever learns of it: `PointSlots` then chooses the members that may learn from a clip.
    """
    branch.train()
    for name, module in branch.named_modules():
        module.training = not name or _learns(name, part)


def _learns(module: str, part: str) -> bool:
    """Returns whether a module of that name learns: the last layer with `probe`, all of the head with `head`."""
    words = module.split(".")
    return part == "all" or "classify" in words or (part == "head" and words[0] == "head")
