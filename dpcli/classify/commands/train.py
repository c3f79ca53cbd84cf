"""`dpc classify train`: gathers data, network, schedule and folder, says what it found, and lets the trainer run."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import asdict

import numpy as np
import torch

from dpcli.classify.data.augment import find_augmentation
from dpcli.classify.data.clips import ClipSource
from dpcli.classify.data.validation_split import carve_validation, class_table, default_rule
from dpcli.classify.data.videos import report_short
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network.model_file import ModelInfo, find_model, load_model
from dpcli.classify.presets import find_preset
from dpcli.classify.settings import network_config, training_schedule
from dpcli.classify.training.learning_curves import COLUMNS, draw_curves
from dpcli.classify.training.schedule import Schedule
from dpcli.classify.training.trainer import Trainer
from dpcli.errors import DataError, UsageError
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.distributed import Processes, from_environment, process_group
from dpcli.runtime.progress import log
from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.signals import stop_requested
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.store import CloudsReader, input_file

# A single cloud a video: what a static stream learns shapes from.
_PRETRAINING = {"num_frames": 1, "temporal_radius": 0}


def run_training(
    data: str,
    output: str,
    *,
    preset: str,
    backbone: str | None,
    variant: str | None,
    network: dict,
    schedule: dict,
    augment: str | None,
    timing: str,
    drop_short: bool,
    validation: str | None,
    static_from: str | None,
    init: str | None,
    pretrain: bool,
    seed: int,
    device: str,
    force: bool,
) -> None:
    """`dpc classify train`, alone or as one of torchrun's processes."""
    if timing not in ("clips", "uniform"):
        raise UsageError(f"--timing {timing}: expected clips or uniform")
    if static_from and init:
        raise UsageError("--init starts both streams, --static-from the static one: give one of them")
    if data == "-" and from_environment().count > 1:
        raise UsageError("several processes can't share a pipe: give a file instead of -")
    if pretrain:
        network, schedule = _pretraining(network, schedule)
    chosen = choose_device(device)
    augmentation = find_augmentation(augment) if augment is not None else find_preset(preset).augmentation
    plan = training_schedule(preset, schedule, chosen)
    if augmentation.speed and (timing == "uniform" or plan.clips_per_video is None):
        raise UsageError(
            f"--augment {augment}: speed changes random clips of consecutive frames; leave it out with --timing uniform"
            " or --clips-per-video 0"
        )
    with input_file(data) as path, process_group(chosen) as processes:
        chosen = processes.place(chosen)
        reader = CloudsReader(path)
        config = network_config(preset, variant, network, len(class_table(reader)), backbone)
        rule = validation or default_rule(reader)
        parts = carve_validation(reader, rule, seed)
        _check_labels(reader, *parts)
        record = {
            "network": json.loads(config.to_json()),
            "schedule": _content(plan),
            "augmentation": asdict(augmentation),
            "timing": timing,
            "validation": rule,
            "drop_short": drop_short,
            "seed": seed,
            "static_from": static_from,
            "init": init,
            "data": provenance.file_digest(path),
        }
        plan.share(processes.count)
        folder = RunFolder(output, json.loads(json.dumps(record)), force, columns=COLUMNS, curves=draw_curves)
        options = {"timing": timing, "drop_short": drop_short, "seed": seed}
        training = ClipSource(reader, parts[0], config, augmentation=augmentation, **options)
        held = ClipSource(reader, parts[1], config, **options) if parts[1] else None
        check_shares(len(training.epoch(0, plan.clips_per_video)), plan, processes.count)
        report_short(training, config.num_frames)
        torch.manual_seed(seed)
        model = _new_model(config, static_from, init, backbone, folder).to(chosen)
        notes = {
            "command": provenance.command_line(),
            "data": record["data"],
            "seed": seed,
            "validation": rule,
            "trained_on": f"{len(parts[0])} videos",
        }
        info = ModelInfo(config, class_table(reader), timing, notes)
        _announce(chosen, processes, len(parts[0]), len(parts[1]), rule, plan)
        keep_freed_memory()
        with (
            folder if processes.first else nullcontext(),
            stop_requested() as stop,
        ):  # last: --force deletes an earlier model
            processes.wait()  # the others find the folder as it is to be
            trainer = Trainer(model, info, folder, plan, training, held, chosen, stop, processes)
            trainer.run()
        summary = trainer.validate() if held is not None else {}
    if processes.first:
        _print_outcome(folder, summary, len(parts[1]))


def _pretraining(network: dict, schedule: dict) -> tuple[dict, dict]:
    """Options of a static stream alone on single clouds. UsageError when they contradict."""
    if network["num_frames"] not in (None, 1) or schedule["epochs"][1]:
        raise UsageError(
            "--pretrain: trains the static stream on clips of one frame; leave out --frames and --epochs-dynamic"
        )
    return {**network, **_PRETRAINING}, {**schedule, "epochs": (schedule["epochs"][0], 0)}


def _check_labels(reader: CloudsReader, training: list[int], validation: list[int]) -> None:
    """Something must be there to tell apart; classes that training never sees are named."""
    names = class_table(reader)
    seen = {int(reader.labels[i]) for i in training}
    if len(seen) < 2:
        raise DataError(
            f"{reader.path}: all {len(training)} training videos are of class {names[min(seen)]!r}; at least two classes are needed"
        )
    judged = {int(reader.labels[i]) for i in validation} | set(np.unique(reader.labels[reader.labels >= 0]).tolist())
    missing = [names[label] for label in sorted(judged - seen)]
    if missing:
        log.warn(
            f"{len(missing)} of {len(names)} classes have no training video and can't be recognized: {', '.join(missing[:8])}"
        )


def check_shares(clips: int, plan: Schedule, processes: int) -> None:
    """Each process divides its gradient by its own clips: their mean is the whole batch's only where shares are equal."""
    if processes > 1 and clips < plan.batch:
        raise UsageError(
            f"--batch {plan.batch}: an epoch has {clips} clips, which {processes} processes can't share evenly; take a smaller batch,"
            " more --clips-per-video or one process"
        )


def _content(plan: Schedule) -> dict:
    """What of the schedule shapes the result: not how many processes load clips."""
    return {key: value for key, value in asdict(plan).items() if key != "workers"}


def _new_model(
    config: KinetConfig, static_from: str | None, init: str | None, backbone: str | None, folder: RunFolder
) -> Kinet:
    """A fresh network, or one that starts from a trained one's static stream or from all of it, as far as shapes agree."""
    model = Kinet(config)
    for name, option, mine in ((static_from, "--static-from", model.static), (init, "--init", model)):
        if not name:
            continue
        weights = find_model(name, option)
        folder.refuse_inside(option, weights)
        other, _ = load_model(weights, backbone)
        theirs = other.static if option == "--static-from" else other
        _copy_fitting(mine, theirs, f"{option} {name}")
        if other.config.num_frames > 1 and other.config.static_radius != config.static_radius:
            log.warn(
                f"{option} {name}: its static stream learned from neighbors up to {other.config.static_radius} frames away, here"
                f" {config.static_radius}; --static-temporal-radius {other.config.static_radius} goes on as it was"
            )
    return model


def _copy_fitting(mine: torch.nn.Module, theirs: torch.nn.Module, what: str) -> None:
    own, others = mine.state_dict(), theirs.state_dict()
    fitting = {key: value for key, value in others.items() if key in own and value.shape == own[key].shape}
    left = sorted(set(own) - set(fitting))
    weights = [key for key in own if own[key].dim() > 1]
    if 2 * sum(key in fitting for key in weights) < len(weights):
        key = next((key for key in weights if key not in fitting), "?")
        shape = tuple(others[key].shape) if key in others else "absent"
        raise UsageError(
            f"{what}: another network ({key}: {shape}, here {tuple(own[key].shape)}); give the same --preset and --backbone"
        )
    mine.load_state_dict({**own, **fitting})
    log.info(f"{what}: {len(fitting)} of {len(own)} tensors taken" + (f"; fresh: {', '.join(left)}" if left else ""))


def _announce(
    device: torch.device, processes: Processes, training: int, validation: int, rule: str, plan: Schedule
) -> None:
    threads = f"{device} ({torch.get_num_threads()} threads)"
    where = threads if device.type == "cpu" else torch.cuda.get_device_name(device)
    if processes.count > 1:
        where = f"{processes.count} processes, each on {where}, {plan.batch // processes.count} clips of a batch each"
    log.info(
        f"training on {where}: {training} videos, {validation} for validation ({rule}); epochs {plan.epochs[0]} + {plan.epochs[1]}"
    )


def _print_outcome(folder: RunFolder, summary: dict[str, float], videos: int) -> None:
    print(folder.file("best.safetensors"))
    if summary:
        scores = ", ".join(f"{key} {100 * value:.1f} %" for key, value in summary.items())
        print(f"{videos} validation videos: {scores}")
