"""What `dpc classify` does, from options to files: gathers the pieces, says what it found, calls one thing."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from dpcli.classify.augment import PRESETS as AUGMENTATIONS
from dpcli.classify.clips import ClipSource
from dpcli.classify.config import KinetConfig
from dpcli.classify.curves import COLUMNS, draw_curves
from dpcli.classify.kinet import Kinet
from dpcli.classify.model_file import ModelInfo, find_model, load_model
from dpcli.classify.predict import predict_videos
from dpcli.classify.presets import find_preset
from dpcli.classify.split import carve_validation, class_table, default_rule
from dpcli.classify.train import Schedule, Trainer
from dpcli.errors import DataError, UsageError
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.memory import keep_freed_memory
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.signals import stop_requested
from dpcli.store import CloudsReader, ScoresReader, ScoresWriter, input_file, output_file

_RELEASE = {key: getattr(KinetConfig.release(), key) for key in
            ("variant", "group_size", "xyz_group", "time_input", "weighting", "merge", "guard", "fusion", "grouping")}  # fmt: skip


def network_config(preset: str, variant: str | None, changes: dict[str, Any], classes: int) -> KinetConfig:
    """The preset's configuration, the variant's choices over it, explicit options over both."""
    config = find_preset(preset).config
    if variant == "release":
        config = config.changed(**_RELEASE)
    elif variant not in (None, "thesis"):
        raise UsageError(f"--variant {variant}: expected thesis or release")
    return config.changed(num_classes=classes, **{key: value for key, value in changes.items() if value is not None})


def _schedule(preset: str, changes: dict[str, Any], device: torch.device) -> Schedule:
    base = find_preset(preset).schedule
    epochs = tuple(new if new is not None else old for new, old in zip(changes.pop("epochs"), base.epochs))
    clips = changes.pop("clips_per_video") or None
    workers = changes.pop("workers")
    workers = workers if workers is not None else (0 if device.type == "cpu" else 4)
    given = {key: value for key, value in changes.items() if value is not None}
    return replace(base, epochs=epochs, clips_per_video=clips, workers=workers, **given)


def run_training(
    data: str, output: str, *, preset: str, variant: str | None, network: dict, schedule: dict, augment: str | None, timing: str,
    drop_short: bool, validation: str | None, static_from: str | None, seed: int, device: str, force: bool,
) -> None:  # fmt: skip
    """`dpc classify train`."""
    if timing not in ("clips", "uniform"):
        raise UsageError(f"--timing {timing}: expected clips or uniform")
    if augment is not None and augment not in AUGMENTATIONS:
        raise UsageError(f"--augment {augment}: expected one of {', '.join(AUGMENTATIONS)}")
    chosen = choose_device(device)
    augmentation = AUGMENTATIONS[augment] if augment else find_preset(preset).augmentation
    plan = _schedule(preset, schedule, chosen)
    with input_file(data) as path:
        reader = CloudsReader(path)
        config = network_config(preset, variant, network, len(class_table(reader)))
        rule = validation or default_rule(reader)
        train_part, val_part = carve_validation(reader, rule, seed)
        record = {"network": json.loads(config.to_json()), "schedule": _content(plan), "augmentation": asdict(augmentation),
                  "timing": timing, "validation": rule, "drop_short": drop_short, "seed": seed, "static_from": static_from,
                  "data": provenance.file_digest(path)}  # fmt: skip
        folder = RunFolder(output, json.loads(json.dumps(record)), force, columns=COLUMNS, curves=draw_curves)
        training = ClipSource(
            reader, train_part, config, timing=timing, augmentation=augmentation, drop_short=drop_short, seed=seed
        )
        held = (
            ClipSource(reader, val_part, config, timing=timing, drop_short=drop_short, seed=seed) if val_part else None
        )
        _report_short(training, config.num_frames)
        torch.manual_seed(seed)
        model = Kinet(config)
        if static_from:
            _start_from(model, static_from)
        notes = {"command": provenance.command_line(), "data": record["data"], "seed": seed, "validation": rule,
                 "trained_on": f"{len(train_part)} videos"}  # fmt: skip
        info = ModelInfo(config, class_table(reader), timing, notes)
        _announce(chosen, len(train_part), len(val_part), rule, plan)
        keep_freed_memory()
        with stop_requested() as stop:
            trainer = Trainer(model, info, folder, plan, training, held, chosen, stop)
            trainer.run()
        summary = trainer.validate() if held is not None else {}
    _print_outcome(folder, summary, len(val_part))


def _content(plan: Schedule) -> dict:
    """What of the schedule shapes the result: not how many processes load clips."""
    return {key: value for key, value in asdict(plan).items() if key != "workers"}


def _start_from(model: Kinet, name: str) -> None:
    other, _ = load_model(name)
    mine, theirs = model.static.state_dict(), other.static.state_dict()
    fitting = {k: v for k, v in theirs.items() if k in mine and v.shape == mine[k].shape}
    if not any(key.startswith("stage1") for key in fitting):
        raise UsageError(f"--static-from {name}: its static stream has other widths than this configuration")
    model.static.load_state_dict({**mine, **fitting})
    left = sorted(set(mine) - set(fitting))
    log.info(f"static stream starts from {name}" + (f"; fresh: {', '.join(left)}" if left else ""))


def _announce(device: torch.device, training: int, validation: int, rule: str, plan: Schedule) -> None:
    where = (
        f"{device} ({torch.get_num_threads()} threads)" if device.type == "cpu" else torch.cuda.get_device_name(device)
    )
    log.info(
        f"training on {where}: {training} videos, {validation} for validation ({rule}); epochs {plan.epochs[0]} + {plan.epochs[1]}"
    )


def _report_short(source: ClipSource, frames: int) -> None:
    for names, what in ((source.dropped, "dropped"), (source.padded, "padded by holding their last frame")):
        if names:
            log.info(
                f"{len(names)} videos shorter than {frames} frames are {what}: {', '.join(names[:5])}{' ...' if len(names) > 5 else ''}"
            )


def _print_outcome(folder: RunFolder, summary: dict[str, float], videos: int) -> None:
    print(folder.file("best.safetensors"))
    if summary:
        scores = ", ".join(f"{key} {100 * value:.1f} %" for key, value in summary.items())
        print(f"{videos} validation videos: {scores}")


def run_prediction(
    data: str, model_name: str, output: str, *, split: str, clips_per_video: int | None, drop_short: bool, batch: int, seed: int,
    device: str, force: bool,
) -> None:  # fmt: skip
    """`dpc classify predict`."""
    chosen = choose_device(device)
    model, info = load_model(model_name)
    with input_file(data) as path, output_file(output) as target:
        reader = CloudsReader(path)
        sequences = _select(reader, split)
        _check_classes(reader, info, model_name)
        source = ClipSource(reader, sequences, info.config, timing=info.timing, drop_short=drop_short, seed=seed)
        _report_short(source, info.config.num_frames)
        config = {"split": split, "clips_per_video": clips_per_video, "drop_short": drop_short, "dropped": source.dropped,
                  "model": info.notes, "weights": provenance.file_digest(find_model(model_name)), "fusion": info.config.fusion}  # fmt: skip
        history = [*reader.provenance, provenance.record(config, seed, {"clouds": path})]
        if not force and _already_scored(target, history[-1]):
            return
        keep_freed_memory()
        with ScoresWriter(target, class_names=info.class_names, seed=seed, source=reader.path.name if data != "-" else "stdin",
                          provenance=history, streams=("static", "dynamic"), force=force) as writer:  # fmt: skip
            _score(model.to(chosen), source, writer, clips_per_video, batch, chosen)
    if output != "-":
        print(f"{output}: scores of {len(writer)} videos in {len(info.class_names)} classes")


def _already_scored(target: Path, entry: dict) -> bool:
    """Whether `target` holds the scores of this very work; UsageError when it holds something else."""
    if not target.exists():
        return False
    try:
        before = ScoresReader(target).provenance[-1:]
    except DataError as error:
        raise UsageError(f"{error}\nIt stands where the output should go: write to another file, or --force") from None
    if not before or any(before[0].get(key) != entry[key] for key in ("config", "seed", "inputs", "version")):
        raise UsageError(
            f"{target}: holds scores of another model, data or choice; use another -o, or --force to replace it"
        )
    log.info(f"{target}: already complete, made from the same model and data (--force makes it again)")
    print(f"{target}: complete")
    return True


def _select(reader: CloudsReader, split: str) -> list[int]:
    wanted = split
    if split == "auto":
        wanted = "test" if "test" in reader.splits else "all"
    chosen = [i for i, name in enumerate(reader.splits) if wanted == "all" or name == wanted]
    if not chosen:
        raise DataError(f"{reader.path}: no sample of split {wanted!r}; it has {sorted(set(reader.splits))}")
    if split == "auto":
        log.info(f"scoring split {wanted!r}: {len(chosen)} of {len(reader)} videos (--split chooses)")
    return chosen


def _check_classes(reader: CloudsReader, info: ModelInfo, model_name: str) -> None:
    if reader.class_names and reader.class_names != info.class_names:
        pairs = zip(reader.class_names + [""] * 99, info.class_names + [""] * 99)
        index, (mine, theirs) = next((i, pair) for i, pair in enumerate(pairs) if pair[0] != pair[1])
        raise DataError(
            f"{reader.path}: class {index} is {mine!r}, in {model_name} it is {theirs!r}; the model was trained for other classes"
        )


def _score(
    model: Kinet, source: ClipSource, writer: ScoresWriter, count: int | None, batch: int, device: torch.device
) -> None:
    reader = source.reader
    with stop_requested() as stop, Progress("classify predict", len(source.sequences), "video") as bar:
        for video in predict_videos(model, source, count, batch, device):
            i = video.sequence
            streams = {"static": video.static, "dynamic": video.dynamic}
            writer.write(
                reader.names[i], video.fused, label=int(reader.labels[i]), split=reader.splits[i], streams=streams
            )
            bar.advance(1, clips=video.clips)
            stop.check(f"{len(writer)} videos were scored, none kept")


def run_profile(
    model_name: str | None, *, preset: str, variant: str | None, classes: int, frames: int | None, points: int | None, steps: bool,
    device: str, json_output: bool,
) -> None:  # fmt: skip
    """`dpc classify profile`."""
    from dpcli.classify import profile

    chosen = choose_device(device)
    if model_name:
        model = load_model(model_name)[0]
    else:
        model = Kinet(
            network_config(preset, variant, {"num_frames": frames, "points_per_frame": points}, classes)
        ).eval()
    result = profile.measure(model.to(chosen), chosen, steps)
    print(json.dumps(result) if json_output else profile.render(result), file=sys.stdout)
