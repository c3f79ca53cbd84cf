"""`dpc classify train`: gathers data, network, schedule and folder, says what it found, and lets the trainer run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dpcli.classify.commands.baseline import forest_accuracy
from dpcli.classify.confidence import NOTE
from dpcli.classify.data.clips import ClipSource
from dpcli.classify.data.copies import tell_copies
from dpcli.classify.data.likeness import (
    ANY_UNIT,
    file_like,
    tell_mixed_rates,
    tell_mixed_sizes,
    tell_rounded,
    tell_unlike,
    tell_upright,
)
from dpcli.classify.data.likeness import NOTE as NOTE_LIKE
from dpcli.classify.data.slots import measured, preset_for
from dpcli.classify.data.validation_split import (
    about_absent_classes,
    about_classes,
    about_frequent_class,
    about_other_splits,
    about_people,
    about_tested_people,
    carve_validation,
    class_table,
    cross_folds,
    default_rule,
    lasting_rule,
)
from dpcli.classify.data.videos import report_backward, report_gaps, report_short
from dpcli.classify.network.config import CROSS
from dpcli.classify.network.kinet import STREAMS, Kinet
from dpcli.classify.network.model_file import ModelInfo, find_model, load_model, save_model
from dpcli.classify.settings import TrainingSettings, about_unread, training_settings, with_classes
from dpcli.classify.training.confidence_fit import fitted_confidence
from dpcli.classify.training.fine_tune import resolved, settings_from, settings_of_model
from dpcli.classify.training.first_weights import take_weights
from dpcli.classify.training.forests import grow_forests
from dpcli.classify.training.learning_curves import COLUMNS, draw_curves
from dpcli.classify.training.schedule import Schedule
from dpcli.classify.training.trainer import Trainer
from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.path_names import first_names
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device, cpu_count
from dpcli.runtime.distributed import Processes, from_environment, process_group
from dpcli.runtime.mixed_precision import wanted
from dpcli.runtime.progress import log
from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.settings.catalog import Given
from dpcli.runtime.signals import stop_requested
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.store import CloudsReader, input_file
from dpcli.store.scores import check_class_names

AUTO = "auto"  # the preset that the data choose
_STARTS = {"static_from": "static_from =", "init": "--init"}  # settings that name trained weights, as errors call them
_FOREST = 20, 5000  # training videos, from and to, that a forest is trained on for comparison


@dataclass(frozen=True)
class Training:
    """Names the weights that a training left, and says how well its validation videos are classified, by stream.

    caveat: what the people of these videos have to do with those of the training, "" where they are others. forest: the
    share of them that a random forest on descriptors gets right, None where it was not asked.
    """

    weights: Path
    videos: int  # that validated; those too short for a clip may be left out
    accuracy: dict[str, float]
    caveat: str = ""
    forest: float | None = None


@dataclass(frozen=True)
class _Videos:
    """Holds the training and validation clips of a file, and what the run's records say of it."""

    training: ClipSource
    validation: ClipSource | None
    counts: tuple[int, int]  # videos of both, those too short for a clip included
    class_names: list[str]
    digest: str
    caveat: str  # see `Training`
    looks: dict[str, float]  # `file_like` of the training videos
    not_read: dict[str, str]  # columns of the file, and why the network doesn't read them
    rule: str  # `lasting_rule` of what validates


def train(
    data: str, output: str, given: Given, *, seed: int = 0, device: str = "auto", force: bool = False
) -> Training | None:
    """Trains a network on a clouds file, alone or as one of torchrun's processes; continues a stopped run.

    data: a file, or `-` for stdin. output: the folder. given: the preset and the changes over it. Returns None in all
    processes but the first. Raises UsageError for settings that don't fit together or a folder with another run, DataError
    for data that can't be learned from.
    """
    start = _model_that_chooses(given)
    _refuse_wrong(given, start)
    if data == "-" and from_environment().count > 1:
        raise UsageError("several processes can't share a pipe: give a file instead of -")
    chosen = choose_device(device)
    with input_file(data) as path, process_group(chosen) as processes:
        settings = _chosen_settings(given, start, CloudsReader(path))
        for sentence in about_unread(settings, {**given.sets, **given.flags}):
            log.warn(sentence)
        settings = replace(settings, schedule=_for_device(settings.schedule, chosen))
        return _train(path, output, settings, seed, processes.place(chosen), force, processes)


def _model_that_chooses(given: Given) -> ModelInfo | None:
    """Returns the model to go on from where the preset is `auto`: network and timing are then that model's."""
    values = given.values
    if given.preset != AUTO or not values.get("init"):
        return None
    return load_model(find_model(values["init"], "--init"), values.get("backbone"))[1]


def _refuse_wrong(given: Given, start: ModelInfo | None) -> None:
    """Raises UsageError for settings that are wrong whatever the file holds, before it is read: with the preset `auto` those
    that fit neither network among which the file chooses, or not the one to go on from."""
    if start is not None:
        training_settings(replace(given, preset="quick"), settings_of_model(start))
        return
    problems = []
    for preset in ("quick", "sparse") if given.preset == AUTO else (given.preset,):
        try:
            training_settings(replace(given, preset=preset))
            return
        except UsageError as problem:
            problems.append(problem)
    raise problems[0]


def _chosen_settings(given: Given, start: ModelInfo | None, reader: CloudsReader) -> TrainingSettings:
    """Returns the settings, with what the data choose where a person left it to them."""
    preset, base = given.preset, None
    if start is not None:
        preset, base = "quick", settings_from(start, reader, given.values.get("fine_tune"))
    elif given.preset == AUTO:
        preset = preset_for(reader, given.values)
    settings = training_settings(replace(given, preset=preset), base)
    if given.preset == AUTO and preset == "long":
        log.info(
            f"preset long: the median video has {counted(int(np.median(reader.frame_counts)), 'frame')}, four clips of"
            f" {settings.network.num_frames} or more; clips of a video are judged together (--preset quick: each for itself)"
        )
    return replace(settings, schedule=resolved(settings.schedule, reader))


def _train(
    path: Path,
    output: str,
    settings: TrainingSettings,
    seed: int,
    device: torch.device,
    force: bool,
    processes: Processes,
) -> Training | None:
    settings, videos = _videos(path, settings, seed)
    schedule, run = settings.schedule, settings.run
    schedule.share(processes.count)
    folder = RunFolder(output, _record(settings, seed, videos.digest), force, columns=COLUMNS, curves=draw_curves)
    check_shares(len(videos.training.epoch(0, schedule.clips_per_video or None)), schedule, processes.count)
    sources = [source for source in (videos.training, videos.validation) if source is not None]
    for source in sources:
        report_short(source)
    looked_at = sorted({i for source in sources for i in source.sequences})
    report_backward(videos.training.reader, looked_at)
    report_gaps(videos.training.reader, looked_at)
    torch.manual_seed(seed)
    model = _new_model(settings, videos, folder).to(device)
    info = ModelInfo(settings.network, videos.class_names, run.timing, _notes(videos, seed))
    _announce(device, processes, videos, settings)
    keep_freed_memory()
    # last: --force deletes an earlier model
    with folder if processes.first else nullcontext(), stop_requested() as stop:
        if processes.first:
            folder.write_settings(settings.to_toml(f"classify train --seed {seed}"))
        processes.wait()  # the others find the folder as it is to be
        trainer = Trainer(model, info, folder, schedule, videos.training, videos.validation, device, stop, processes)
        trainer.run()
        if settings.network.backbone == "slots":
            info.config = grow_forests(trainer.model, videos.training, seed)
            if processes.first:
                save_model(folder.file("best.safetensors"), trainer.model, info)
        if processes.first and videos.validation is not None:
            _add_confidence(trainer, info, videos.validation, folder)
    accuracy = trainer.validate() if videos.validation is not None else {}
    if not processes.first:
        return None
    judged = len(videos.validation.sequences) if videos.validation is not None else 0
    return Training(folder.file("best.safetensors"), judged, accuracy, videos.caveat, _forest(videos, seed))


def _forest(videos: _Videos, seed: int) -> float | None:
    """Returns the accuracy that the network had to beat, where it takes seconds and says something."""
    source, held = videos.training, videos.validation
    if held is None or not _FOREST[0] <= len(source.sequences) <= _FOREST[1]:
        return None
    groups = _judgments(source.sequences, held.sequences, source.folds)
    right = [len(judged) * forest_accuracy(source.reader, learned, judged, seed) for learned, judged in groups]
    return sum(right) / sum(len(judged) for _, judged in groups)


def _judgments(
    training: Sequence[int], validation: Sequence[int], of: Mapping[int, int]
) -> list[tuple[list[int], list[int]]]:
    """Returns the sequences that are learned from, and those that what learned is judged on: fold by fold where there are some.

    of: the fold of each sequence, {} without folds.
    """
    if not of:
        return [(list(training), list(validation))]
    return [([i for i in of if of[i] != k], [i for i in of if of[i] == k]) for k in sorted(set(of.values()))]


def _add_confidence(trainer: Trainer, info: ModelInfo, validation: ClipSource, folder: RunFolder) -> None:
    """Writes the weights again with temperature and threshold fitted on the validation videos in their notes."""
    schedule, streams = trainer.schedule, list(STREAMS) if trainer.schedule.epochs_dynamic else ["static"]
    clips, device = schedule.validation_clips, trainer.device
    found = fitted_confidence(trainer.model, validation, clips, schedule.batch, device, streams)
    info.notes |= {"streams": streams, NOTE: found.notes()}
    save_model(folder.file("best.safetensors"), trainer.model, info)
    log.info(
        f"confidence: temperature {found.temperature:g}; below {found.threshold:g} nothing is recognized: that keeps"
        f" {100 * (found.kept or 0):.0f} % of {found.clips} validation clips and rejects"
        f" {100 * (found.rejected_still or 0):.0f} % of those in which nobody moves"
    )


def _for_device(schedule: Schedule, device: torch.device) -> Schedule:
    """Returns the schedule with what depends on the device chosen: on a CPU clips are loaded in the same process."""
    workers = schedule.workers
    if workers is None:
        workers = 0 if device.type == "cpu" else min(4, cpu_count())
    return replace(schedule, workers=workers, amp=wanted(schedule.amp, device))


def _videos(path: Path, settings: TrainingSettings, seed: int) -> tuple[TrainingSettings, _Videos]:
    """Returns the settings with the file's classes and rule of validation, and its clips. Raises DataError where nothing can
    be learned."""
    reader = CloudsReader(path)
    names = class_table(reader)
    if not names:
        raise DataError(f"{path}: no video has a label; prepare it with --labels or --label-from-folder")
    settings = with_classes(settings, len(names))
    run = settings.run
    rule = default_rule(reader, settings.network.members) if run.validation == "auto" else run.validation
    settings = replace(settings, run=replace(run, validation=rule))
    training, validation = carve_validation(reader, rule, seed)
    if not validation and run.validation not in ("auto", "none"):
        log.warn(
            f"--validation {rule}: no class has so many videos that one of them would be held out, so nothing is; ask for a"
            " larger fraction"
        )
    _check_labels(reader, training, validation, rule)
    _tell_unlabeled(reader, ("train", "validation") if rule == "split" else ("train",))
    if others := about_other_splits(reader):
        log.warn(f"{path}: {others}")
    if said := about_tested_people(reader, training, _tests(reader)):
        log.warn(f"{path}: {said}")
    looks = file_like(reader, training)
    tell_rounded(str(path), looks)
    tell_upright(str(path), looks, settings.network.normalize)
    tell_mixed_rates(reader, training, looks, run.timing)
    if settings.network.normalize not in ANY_UNIT:
        tell_mixed_sizes(reader, sorted({*training, *validation}))
    left_out: dict[str, str] = {}
    if run.timing == "slots" and not settings.network.scales:
        network, left_out = measured(settings.network, reader, training)
        settings = replace(settings, network=network)
    folds = cross_folds(reader, training, settings.network.members, seed) if rule == CROSS else {}
    tell_copies(reader, [*_judgments(training, validation, folds), (training, _tests(reader))])
    options = {"timing": run.timing, "drop_short": run.drop_short, "seed": seed, "folds": folds}
    source = ClipSource(reader, training, settings.network, augmentation=settings.augmentation, **options)
    held = ClipSource(reader, validation, settings.network, **options) if validation else None
    counts = len(training), len(validation)
    remarks = (
        about_classes(reader, folds),
        about_absent_classes(reader, training, validation),
        about_frequent_class(reader, validation),
        about_people(reader, training, validation),
    )
    caveat = "; ".join(filter(None, remarks))
    digest = provenance.file_digest(path)
    lasting = lasting_rule(reader, rule, validation)
    return settings, _Videos(source, held, counts, names, digest, caveat, looks, left_out, lasting)


def _tests(reader: CloudsReader) -> list[int]:
    """Returns the labeled videos that the file keeps for tests."""
    return [i for i, split in enumerate(reader.splits) if split == "test" and reader.labels[i] >= 0]


def _record(settings: TrainingSettings, seed: int, digest: str) -> dict[str, Any]:
    """Returns what shapes the result, for `config.json`: not how many processes load clips. Weights to start from are there by
    name and by digest, since what a name leads to may change."""
    schedule = {key: value for key, value in asdict(settings.schedule).items() if key != "workers"}
    run = {key: getattr(settings.run, key) for key in ("timing", "validation", "drop_short", *_STARTS)}
    starts = {
        key.replace("_from", "") + "_weights": find_model(run[key], option)
        for key, option in _STARTS.items()
        if run[key]
    }
    return {
        "network": asdict(settings.network),
        "schedule": schedule,
        "augmentation": asdict(settings.augmentation),
        **run,
        **{key: provenance.file_digest(file) for key, file in starts.items()},
        "seed": seed,
        "data": digest,
    }


def _notes(videos: _Videos, seed: int) -> dict[str, Any]:
    """Returns what a weights file says of its making."""
    return {
        "command": provenance.command_line(),
        "data": videos.digest,
        "seed": seed,
        "validation": videos.rule,
        "trained_on": counted(videos.counts[0], "video"),
        NOTE_LIKE: videos.looks,
        **({"columns_not_read": videos.not_read} if videos.not_read else {}),
    }


def _check_labels(reader: CloudsReader, training: list[int], validation: list[int], rule: str) -> None:
    """Raises DataError where there is nothing to tell apart, or two classes have one name; names the classes that training
    never sees."""
    names = class_table(reader)
    check_class_names(reader.path, names)
    seen = {int(reader.labels[i]) for i in training}
    if len(seen) < 2:
        others = {int(reader.labels[i]) for i in validation} - seen
        raise DataError(
            f"{reader.path}: {counted(len(training), 'training video')}, of class {names[min(seen)]!r} alone;"
            " at least two classes are needed"
            + (f" (--validation {rule} holds out all videos of the others: give another)" if others else "")
        )
    missing = [names[label] for label in sorted(set(reader.labels[reader.labels >= 0].tolist()) - seen)]
    if missing:
        log.warn(
            f"{len(missing)} of {counted(len(names), 'class')} without a training video, so never recognized: {first_names(missing, 8)}"
        )


def _tell_unlabeled(reader: CloudsReader, splits: tuple[str, ...]) -> None:
    """Counts the videos of each of these splits that have no label to learn or to judge by, with a message."""
    for own in splits:
        names = [name for name, of, label in zip(reader.names, reader.splits, reader.labels) if of == own and label < 0]
        if names:
            log.warn(
                f"{reader.path}: {counted(len(names), 'video')} of the split {own!r} without a label, left out: {first_names(names)}"
            )


def check_shares(clips: int, schedule: Schedule, processes: int) -> None:
    """Raises UsageError where processes get unequal shares of a batch: each divides its gradient by its own clips, and the
    mean of these is the whole batch's only where shares are equal."""
    if processes > 1 and clips < schedule.batch:
        raise UsageError(
            f"batch = {schedule.batch}: an epoch has {counted(clips, 'clip')}, which {processes} processes can't share evenly; take a"
            " smaller batch, more clips_per_video or one process"
        )


def _new_model(settings: TrainingSettings, videos: _Videos, folder: RunFolder) -> Kinet:
    """Returns a fresh network, or one that starts from a trained one's static stream or from all of it, as far as shapes
    and class names agree."""
    config, run = settings.network, settings.run
    model = Kinet(config)
    for key, option in _STARTS.items():
        name, alone = getattr(run, key), key == "static_from"
        if not name:
            continue
        weights = find_model(name, option)
        folder.refuse_inside(option, weights)
        other, info = load_model(weights, config.backbone)
        mine, theirs = (model.static, other.static) if alone else (model, other)
        take_weights(mine, theirs, videos.class_names, info.class_names, f"{option} {name}")
        if not alone:
            looks = videos.looks | {"step": 0.0}  # that coordinates are rounded was told when they were read
            tell_unlike(str(videos.training.reader.path), looks, replace(info, config=config), name)
        if other.config.num_frames > 1 and other.config.static_radius != config.static_radius:
            log.warn(
                f"{option} {name}: its static stream learned from neighbors up to {counted(other.config.static_radius, 'frame')} away, here"
                f" {config.static_radius}; --set static_temporal_radius={other.config.static_radius} keeps that"
            )
    return model


def _announce(device: torch.device, processes: Processes, videos: _Videos, settings: TrainingSettings) -> None:
    schedule = settings.schedule
    threads = f"{device} ({counted(torch.get_num_threads(), 'thread')})"
    where = threads if device.type == "cpu" else torch.cuda.get_device_name(device)
    if processes.count > 1:
        where = f"{processes.count} processes, each on {where}, {counted(schedule.batch // processes.count, 'clip')} of a batch each"
    log.info(
        f"training on {where}: {counted(videos.counts[0], 'video')}, {videos.counts[1]} for validation ({settings.run.validation});"
        f" epochs {schedule.epochs} + {schedule.epochs_dynamic}"
        + (f"; of {settings.run.init} learns: {schedule.fine_tune}" if settings.run.init else "")
    )
