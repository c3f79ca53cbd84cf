"""What `dpc segment` does, one function per subcommand; the options come from `cli/segment.py`."""

from __future__ import annotations

import json
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dpcli.errors import DataError, UsageError
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.mixed_precision import wanted
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.seeds import SegmentStream, generator
from dpcli.runtime.signals import stop_requested
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.runtime.whole_file import PICTURES, check_target
from dpcli.segment.baselines.classical import classical_labels, classical_options
from dpcli.segment.commands.estimate_flow import flow_weights
from dpcli.segment.flow.pair_flow import pair_flow
from dpcli.segment.frame_pairs import MOTION_FIELDS, PairSource
from dpcli.segment.network.config import PartConfig, find_config
from dpcli.segment.network.model_file import SHIPPED, find_model, load_model
from dpcli.segment.network.part_network import PartNetwork
from dpcli.segment.prediction import Estimate, Refinement, Segmenter, network_segmenter, predict_parts
from dpcli.segment.training.flow_store import first_flows
from dpcli.segment.training.learning_curves import COLUMNS, draw_curves
from dpcli.segment.training.objective import Objective
from dpcli.segment.training.trainer import Schedule, Trainer
from dpcli.store import CloudsReader, input_file, output_file
from dpcli.store.parts import PartsReader, PartsWriter
from dpcli.store.writing.already_made import WORK, already_made

_SHOWN = 8  # sequences in a picture
CLASSICAL = ("dbscan", "ward", "ssc", "trajaffn")


def run_training(
    data: str,
    output: str,
    *,
    config: str,
    network: dict[str, Any],
    schedule: dict[str, Any],
    objective: dict[str, Any],
    flow: str,
    points: int | None,
    validation: str | None,
    start_from: str | None,
    flows_of: Path | None,
    seed: int,
    device: str,
    force: bool,
    amp: bool | None = None,
) -> None:
    """`dpc segment train`."""
    chosen = choose_device(device)
    plan, aims = Schedule(**_given(schedule)), Objective(**_given(objective))
    shape = find_config(config).changed(**network, points=points)
    with input_file(data) as path:
        reader = CloudsReader(path)
        train_part, held = split_sequences(reader, validation, seed)
        _check_supervision(reader, aims)
        record = {
            "network": json.loads(shape.to_json()),
            "schedule": asdict(plan),
            "objective": asdict(aims),
            "flow": flow,
            "validation": validation,
            "start_from": start_from,
            "seed": seed,
            "data": provenance.file_digest(path),
        }
        estimator = None if aims.supervised else flow_weights(flow)
        start = find_model(start_from, "--start-from") if start_from else None
        used = {"flow_weights": estimator, "start_weights": start}
        record |= {
            role: provenance.file_digest(file) for role, file in used.items() if file
        }  # what a path leads to may change
        mixed = wanted(amp, chosen)
        record |= {"amp": True} if mixed else {}
        folder = RunFolder(output, json.loads(json.dumps(record)), force, columns=COLUMNS, curves=draw_curves)
        training = PairSource(reader, train_part, shape.points, seed)
        _check_flows(estimator, flows_of, record, folder, training)
        checking = PairSource(reader, held, shape.points, seed) if held else None
        torch.manual_seed(seed)
        model = _new_model(shape, start, folder).to(chosen)
        model.mixed = mixed
        notes = {
            "command": provenance.command_line(),
            "data": record["data"],
            "seed": seed,
            "supervised": aims.supervised,
            "flow": flow,
            "trained_on": f"{len(train_part)} sequences, {len(training.pairs)} pairs",
        }
        log.info(
            f"training on {chosen}: {notes['trained_on']}, {len(held)} sequences for validation; {plan.epochs} epochs"
        )
        keep_freed_memory()
        with folder, stop_requested() as stop:  # last: with --force this deletes an earlier model
            estimate = (
                None if aims.supervised else partial(pair_flow, method=str(estimator or flow))
            )  # supervised: the true flow is at hand
            Trainer(model, folder, plan, aims, training, checking, estimate, notes, chosen, stop, seed, flows_of).run()
    print(folder.file("best.safetensors"))


def _check_flows(
    estimator: Path | None, folder: Path | None, record: dict, run: RunFolder, training: PairSource
) -> None:
    """Raises UsageError where the estimator's file is one that the run replaces, or another run's flows are of other pairs.

    Only the same data, seed, ... give the same pairs.
    """
    if estimator is not None:
        run.refuse_inside("--flow", estimator)
    if folder is None:
        return
    run.refuse_inside("--flows-of", folder / "flows_first.npy")
    try:
        other = json.loads((folder / "config.json").read_text())
    except (OSError, ValueError):
        raise UsageError(f"--flows-of {folder}: no folder of a `dpc segment train` run") from None
    mine = json.loads(json.dumps(record))
    for key in ("data", "seed", "validation", "flow", "flow_weights"):
        if other.get(key) != mine.get(key):
            raise UsageError(
                f"--flows-of {folder}: its {key} is {other.get(key)!r}, here {mine.get(key)!r}; flows don't fit"
            )
    first_flows(folder, len(training.pairs), training.points)


def _given(options: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in options.items() if value is not None}


def _new_model(shape: PartConfig, start: Path | None, folder: RunFolder) -> PartNetwork:
    model = PartNetwork(shape)
    if start is not None:
        folder.refuse_inside("--start-from", start)
        other, _ = load_model(start)
        if other.config != shape:
            raise UsageError(
                f"--start-from {start}: its network has another configuration; give the same --config and switches"
            )
        model.load_state_dict(other.state_dict())
    return model


def _check_supervision(reader: CloudsReader, aims: Objective) -> None:
    missing = [] if "part" in reader.fields else ["part"]
    if not any(name in reader.fields for name in MOTION_FIELDS):
        missing.append(" or ".join(MOTION_FIELDS))
    if aims.supervised and missing:
        raise DataError(
            f"{reader.path}: --supervised needs part ids and poses or scene flow, but the file has no "
            f"{' and no '.join(missing)}"
        )


def split_sequences(reader: CloudsReader, validation: str | None, seed: int) -> tuple[list[int], list[int]]:
    """(training, validation) sequences of two frames or more. Training: split `train`, or all when nothing is named so.

    validation: `none`; a fraction of the training sequences; class names with commas, held out whole; None: the split
    `validation` if there is one, else nothing.
    """
    long = [i for i in range(len(reader)) if reader.frame_counts[i] >= 2]
    train = [i for i in long if reader.splits[i] == "train"] or [i for i in long if reader.splits[i] == ""]
    if not train:
        raise DataError(f"{reader.path}: no sequence of split 'train' with two frames or more")
    if validation is None or validation == "none":
        held = [i for i in long if reader.splits[i] in ("validation", "val")] if validation is None else []
        return train, held
    try:
        share = float(validation)
    except ValueError:
        left, held = _hold_out_classes(reader, train, validation)
    else:
        if not 0 < share < 1:
            raise UsageError(f"--validation {validation}: expected none, a fraction below 1, or class names")
        order = generator(seed, SegmentStream.VALIDATION).permutation(len(train))
        count = max(1, round(share * len(train)))
        left, held = [train[i] for i in sorted(order[count:])], [train[i] for i in sorted(order[:count])]
    if not left:
        raise UsageError(
            f"--validation {validation}: holds out all of the {len(train)} training sequences; none is left to train on"
        )
    return left, held


def _hold_out_classes(reader: CloudsReader, train: list[int], names: str) -> tuple[list[int], list[int]]:
    wanted = [word.strip() for word in names.split(",")]
    unknown = [name for name in wanted if name not in reader.class_names]
    if unknown:
        raise UsageError(
            f"--validation {names}: no class {unknown[0]!r}; the file has {', '.join(reader.class_names) or 'none'}"
        )
    held = [i for i in train if reader.labels[i] >= 0 and reader.class_names[reader.labels[i]] in wanted]
    return [i for i in train if i not in set(held)], held


def run_prediction(
    data: str,
    model: str,
    output: str,
    *,
    method: str | None,
    method_options: dict[str, Any],
    num_parts: int | None,
    flow: str,
    refinement: dict[str, Any],
    split: str,
    seed: int,
    device: str,
    force: bool,
    picture: Path | None,
    ply: Path | None,
    turntable: Path | None,
    amp: bool | None = None,
) -> None:
    """`dpc segment predict`."""
    for path, option, kinds in ((picture, "--picture", PICTURES), (turntable, "--turntable", (".gif",))):
        if path is not None:
            check_target(path, option, kinds)
    chosen = choose_device(device)
    options = Refinement(**_given(refinement))
    keep_freed_memory()
    with input_file(data) as path, output_file(output) as target:
        reader = CloudsReader(path)
        sequences = _select(reader, split)
        segmenter, slots, said = _segmenter(
            method, method_options, num_parts, model, chosen, seed, wanted(amp, chosen), options.points
        )
        config = {"split": split, "flow": flow, "refinement": asdict(options), **said}
        estimator = flow_weights(flow)
        inputs = {"clouds": path, **({"flow": estimator} if estimator else {})}
        history = [*reader.provenance, provenance.record(config, seed, inputs)]
        fields = [name for name in reader.fields if name not in ("part", "pose")]
        if force or not _already_there(target, history[-1]):
            with PartsWriter(
                target,
                num_parts=slots,
                class_names=reader.class_names,
                length_unit=reader.length_unit,
                seed=seed,
                source=reader.path.name if data != "-" else "stdin",
                provenance=history,
                fields=[*fields, "part"],
                force=force,
                resume=True,
            ) as writer:
                _predict_all(
                    reader,
                    sequences,
                    segmenter,
                    partial(pair_flow, method=str(estimator or flow)),
                    options,
                    seed,
                    writer,
                    fields,
                )
        _show(target, picture, ply, turntable)
    if output != "-":
        print(f"{output}: parts of {len(sequences)} sequences")


def _segmenter(
    method: str | None,
    method_options: dict[str, Any],
    num_parts: int | None,
    model_name: str,
    device: torch.device,
    seed: int,
    mixed: bool = False,
    points: int = Refinement.points,
) -> tuple[Segmenter, int, dict[str, Any]]:
    if method is None:
        file = find_model(model_name)
        model, notes = load_model(file)
        model.mixed = mixed
        weights = provenance.file_digest(file)
        said = {"model": notes, "weights": weights, **({"amp": True} if mixed else {})}
        return network_segmenter(model.to(device), device), model.config.slots, said
    if method not in CLASSICAL:
        raise UsageError(f"--method {method}: expected one of {', '.join(CLASSICAL)}; without it the network is used")
    chosen = classical_options(method, method_options)
    said = {"method": method, "options": asdict(chosen), "num_parts": num_parts}
    if num_parts is not None and num_parts > points:
        raise UsageError(f"--parts {num_parts}: more than the {points} points of a frame that are divided (--points)")
    slots = max(chosen.max_parts, num_parts or 0)
    return _classical_segmenter(method, method_options, num_parts, slots, seed), slots, said


def _classical_segmenter(
    method: str, options: dict[str, Any], num_parts: int | None, slots: int, seed: int
) -> Segmenter:
    """A classical method behind the network's interface: certain masks."""

    def segment(frames: list[torch.Tensor], flows: dict[tuple[int, int], torch.Tensor]) -> list[torch.Tensor]:
        arrays = {pair: flow.numpy() for pair, flow in flows.items()}
        labels = classical_labels(
            [f.numpy() for f in frames],
            arrays,
            method,
            num_parts,
            options=options,
            rng=generator(seed, SegmentStream.CLASSICAL),
        )
        return [torch.nn.functional.one_hot(torch.from_numpy(np.int64(own)), slots).float() for own in labels]

    return segment


def _select(reader: CloudsReader, split: str) -> list[int]:
    chosen = [i for i, name in enumerate(reader.splits) if split == "all" or name == split]
    if not chosen:
        raise DataError(f"{reader.path}: no sequence of split {split!r}; it has {sorted(set(reader.splits))}")
    return chosen


def _already_there(target: Path, entry: dict) -> bool:
    """Returns whether `target` holds the parts of this very work, and says so; UsageError when it holds something else."""
    refusal = "holds parts of another model, data or choice; use another -o, or --force to replace it"
    made = already_made(target, entry, PartsReader, refusal, WORK)
    if made:
        log.info(f"{target}: already complete, made from the same model and data (--force makes it again)")
    return made


def _predict_all(
    reader: CloudsReader,
    sequences: list[int],
    segmenter: Segmenter,
    estimate: Estimate,
    options: Refinement,
    seed: int,
    writer: PartsWriter,
    fields: list[str],
) -> None:
    done = set(writer.written_names)
    with Progress("segment predict", len(sequences), "sequence") as bar, stop_requested() as stop:
        bar.skip(len(done))
        for index in sequences:
            if reader.names[index] in done:
                continue
            sequence = reader.read(index, fields=fields)
            try:
                labels, sample = predict_parts(sequence, index, segmenter, estimate, options, seed)
            except Exception as error:
                writer.keep = not isinstance(error, DataError)  # too little memory says nothing about the others
                raise
            sequence.part = labels
            writer.write(sequence, sample.probability, sample.pairs, sample.motion, sample.flow)
            bar.advance(1, frames=sequence.num_frames)
            stop.check(f"{len(writer)} sequences are kept beside the output")


def _show(target: Path, picture: Path | None, ply: Path | None, turntable: Path | None) -> None:
    """Pictures of what was just written."""
    if picture is None and ply is None and turntable is None:
        return
    from dpcli.draw.ply import write_ply_frames
    from dpcli.segment.pictures import parts_picture
    from dpcli.segment.pictures import turntable as write_turntable

    with PartsReader(target) as reader:
        if picture is not None:
            shown = np.unique(np.linspace(0, len(reader) - 1, min(len(reader), _SHOWN)).astype(int))
            parts_picture(picture, [reader.read(int(i)) for i in shown])
        if turntable is not None:
            write_turntable(turntable, reader.read(0))
        if ply is not None:
            for index in range(len(reader)):
                write_ply_frames(ply / reader.names[index].replace("/", "_"), reader.read(index))


def default_model() -> str:
    """The shipped model used when none is named. UsageError when this installation has none."""
    from dpcli.runtime.weights import shipped_models

    names = shipped_models(SHIPPED)
    if not names:
        raise UsageError(
            "no trained part network comes with this installation; train one (`dpc segment train`) and name it with --model"
        )
    return names[0]
