"""`dpc classify explain pac`: point activation clouds of some videos, as a file, a picture and an animation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dpcli.classify.commands.explain_inputs import check_targets, chosen_streams
from dpcli.classify.commands.model_task import ModelTask
from dpcli.classify.data.clips import ClipSource
from dpcli.classify.data.videos import check_classes, select_videos
from dpcli.classify.explain.pac_settings import PacSettings
from dpcli.classify.explain.pictures import ANIMATIONS, activation_animation, activation_sheet
from dpcli.classify.explain.point_activation_cloud import ActivationCloud, Question, activation_cloud
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network.model_file import ModelInfo, load_model
from dpcli.draw.clouds_sheet import first_of_classes
from dpcli.draw.view import default_view, parse_view
from dpcli.errors import DataError, UsageError
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.progress import Progress
from dpcli.runtime.signals import stop_requested
from dpcli.runtime.whole_file import PICTURES
from dpcli.store import CloudsReader, CloudsWriter, input_file, output_file
from dpcli.store.clouds_reader import OPTIONAL
from dpcli.store.file import PACKED


@dataclass(frozen=True)
class PacRequest:
    """Says which videos and streams are explained, how, and into which pictures.

    samples: names with commas between, or how many over all classes. stream: streams with commas between, None for those
    that were trained.
    """

    samples: str = "4"
    stream: str | None = None
    settings: PacSettings = PacSettings()
    picture: Path | None = None
    animation: Path | None = None


@dataclass(frozen=True)
class Explained:
    """Counts what was explained: points in all, clips, and frames in each."""

    points: int
    clips: int
    frames: int


def explain_pac(task: ModelTask, request: PacRequest) -> Explained:
    """Writes the activations of all points of each video's middle clip, and draws them.

    Raises UsageError for options that don't fit the model, DataError for videos that can't be explained.
    """
    settings = request.settings
    pictures = ((request.picture, "--picture", PICTURES), (request.animation, "--animation", ANIMATIONS))
    check_targets(str(task.output), task.force, *pictures)
    device = choose_device(task.device)
    model, info = load_model(task.model, task.backbone)
    streams = chosen_streams(request.stream, info)
    stage = None if settings.stage is None else settings.stage - 1
    question = Question(settings.rule, stage, _target(settings.target, info.class_names))
    with input_file(task.data) as path, output_file(task.output) as place:
        reader = CloudsReader(path)
        check_classes(reader, info, task.model)
        axes = parse_view(settings.view or default_view(reader.length_unit, reader.provenance))
        pool = select_videos(reader, task.split, info, task.model) if _is_count(reader, request.samples) else []
        sequences = chosen_samples(reader, request.samples, pool)
        source = task.clips(reader, sequences, info)
        entry = provenance.record(_record(task, request, streams, info), task.seed, {"clouds": path})
        clouds = _explain(model.to(device), source, streams, question, device)
        write_clouds(
            place,
            clouds,
            class_names=info.class_names,
            length_unit=reader.length_unit,
            seed=task.seed,
            rule=settings.rule,
            source=task.source,
            provenance=[*reader.provenance, entry],
            force=task.force,
        )
        if request.picture:
            activation_sheet(request.picture, clouds, info.class_names, axes, settings.frames)
        if request.animation:
            activation_animation(request.animation, clouds, info.class_names, axes)
    points = sum(len(cloud.sequence.points) for cloud in clouds)
    return Explained(points, len(clouds), info.config.num_frames)


def _record(task: ModelTask, request: PacRequest, streams: Sequence[str], info: ModelInfo) -> dict[str, Any]:
    """Returns what shapes the activations, for the file's provenance."""
    return {
        "streams": list(streams),
        "rule": request.settings.rule,
        "class": request.settings.target,
        "stage": request.settings.stage,
        "samples": request.samples,
        "split": task.split,
        **task.model_record(info),
    }


def _explain(
    model: Kinet, source: ClipSource, streams: tuple[str, ...], question: Question, device: torch.device
) -> list[ActivationCloud]:
    """Returns the activations of the middle clip of each video."""
    clouds, clips = [], source.clips(1)
    with stop_requested() as stop, Progress("explain pac", len(clips), "video") as bar:
        for clip in clips:
            clouds.append(activation_cloud(model, source, clip, streams, question, device))
            bar.advance(1)
            stop.check("nothing was kept", again="to start over")
    return clouds


def _target(text: str | None, class_names: list[str]) -> str | int:
    """Returns `predicted`, `label`, or the number of a class given by name or number. Raises UsageError for another."""
    if text is None or text in ("predicted", "label"):
        return text or "predicted"
    if text in class_names:
        return class_names.index(text)
    if text.isdigit() and int(text) < len(class_names):
        return int(text)
    raise UsageError(f"class = {text}: the model knows {', '.join(class_names)}; or say predicted or label")


def _is_count(reader: CloudsReader, samples: str) -> bool:
    return samples.isdigit() and samples not in reader.names


def chosen_samples(reader: CloudsReader, wanted: str, pool: Sequence[int]) -> list[int]:
    """Returns the sequences named in `wanted` (with commas between) in that order, or so many of the pool, by `first_of_classes`.

    Raises DataError for a name that isn't there, UsageError for the number 0.
    """
    if not _is_count(reader, wanted):
        names = [wanted] if wanted in reader.names else [name for name in wanted.split(",") if name]
        missing = sorted(set(names) - set(reader.names))
        if missing or not names:
            raise DataError(
                f"{reader.path}: no sample {', '.join(missing)!r}; it has {', '.join(reader.names[:3])}, ..."
            )
        return [reader.names.index(name) for name in dict.fromkeys(names)]
    count = int(wanted)
    if count < 1:
        raise UsageError(f"--samples {wanted}: expected 1 or more, or names")
    return [pool[place] for place in first_of_classes(reader.labels[list(pool)], count)]


class _ActivationWriter(CloudsWriter):
    """Writes a clouds file with further data sets, `more`, before the index, when all samples are there."""

    more: dict[str, np.ndarray] = {}

    def _complete(self) -> None:
        for name, values in self.more.items():
            self._file.create_dataset(name, data=values, **PACKED)
        super()._complete()


def write_clouds(path: Path, clouds: Sequence[ActivationCloud], *, rule: str, **options: Any) -> None:
    """Writes a `clouds` file with the clips' frames and, beside the usual fields, `activation/STREAM` f32 (P) in 0..1, `frame`
    i32 (F) the frames' numbers in their videos, `explained` and `predicted` i32 (S) classes; root attribute
    `activation_rule`.

    options: CloudsWriter's. Raises UsageError when the file exists and `force` is off.
    """
    first = clouds[0].sequence
    fields = [*(key for key in OPTIONAL if first.value(key) is not None), *first.extra]
    with _ActivationWriter(path, fields=fields, **options) as writer:
        for cloud in clouds:
            writer.write(cloud.sequence)
        writer._file.attrs["activation_rule"] = rule
        writer.more = {
            **{f"activation/{s}": np.concatenate([c.activation[s] for c in clouds]) for s in clouds[0].activation},
            "frame": np.concatenate([c.frames for c in clouds]).astype(np.int32),
            "explained": np.array([c.target for c in clouds], np.int32),
            "predicted": np.array([c.predicted for c in clouds], np.int32),
        }
