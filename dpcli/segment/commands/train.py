"""`dpc segment train`: a part network learned from pairs of frames, without labels or with them."""

from __future__ import annotations

import json
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch

from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.distributed import refuse_several
from dpcli.runtime.mixed_precision import wanted
from dpcli.runtime.progress import log
from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.signals import stop_requested
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.segment.flow.estimators import estimate_flow_both_ways, find_estimator
from dpcli.segment.frame_pairs import MOTION_FIELDS, PairSource
from dpcli.segment.network.config import PartConfig
from dpcli.segment.network.model_file import find_model, load_model
from dpcli.segment.network.part_network import PartNetwork
from dpcli.segment.sequence_splits import hold_out_sequences
from dpcli.segment.training.flow_store import first_flows
from dpcli.segment.training.learning_curves import COLUMNS, draw_curves
from dpcli.segment.training.settings import CATALOG, RunSettings, TrainSettings
from dpcli.segment.training.trainer import Trainer
from dpcli.store import CloudsReader, input_file
from dpcli.store.parts import PartsReader
from dpcli.text_files import read_json


def train_part_network(data: str, output: str, settings: TrainSettings, *, seed: int, device: str, force: bool) -> Path:
    """Trains on a clouds file and returns the file of the best weights; the folder `output` gets logs, curves, settings.

    Running again continues a stopped run of the same settings. Raises UsageError where the folder holds another run.
    """
    refuse_several("segment train")
    chosen, supervised = choose_device(device), settings.objective.supervised
    config = settings.network.config()
    with input_file(data) as path:
        reader = _open_labels(path) if supervised else CloudsReader(path)
        learned, held = hold_out_sequences(reader, settings.run.validation, seed)
        mixed = wanted(settings.precision.amp, chosen)
        used = _find_weights(settings)
        record = _describe_run(path, config, settings, seed, mixed, used)
        folder = RunFolder(output, record, force, columns=COLUMNS, curves=draw_curves)
        training = PairSource(reader, learned, config.points, seed)
        estimator = used.get("flow_weights")
        _check_flows(settings.run, estimator, record, folder, training)
        validation = PairSource(reader, held, config.points, seed) if held else None
        torch.manual_seed(seed)
        model = _start_network(config, used.get("init_weights"), folder).to(chosen)
        model.mixed = mixed
        predicted = isinstance(reader, PartsReader)
        notes = {
            "command": provenance.command_line(),
            "data": record["data"],
            "seed": seed,
            "supervised": supervised and not predicted,
            **({"labels": "predicted"} if predicted else {}),
            "flow": settings.run.flow,
            "trained_on": f"{counted(len(learned), 'sequence')}, {counted(len(training.pairs), 'pair')}",
        }
        log.info(
            f"training on {chosen}: {notes['trained_on']}, {counted(len(held), 'sequence')} for validation;"
            f" {counted(settings.schedule.epochs, 'epoch')}"
        )
        keep_freed_memory()
        estimate = partial(estimate_flow_both_ways, method=str(estimator or settings.run.flow), device=str(chosen))
        with folder, stop_requested() as stop:  # last: with --force this deletes an earlier model
            folder.write_settings(CATALOG.to_toml(settings._asdict(), "segment train"))
            Trainer(model, folder, settings, training, validation, estimate, notes, stop, seed).run()
    return folder.file("best.safetensors")


def _find_weights(settings: TrainSettings) -> dict[str, Path]:
    """Returns the files of trained weights that the run starts from, by role."""
    run, supervised = settings.run, settings.objective.supervised
    used = {
        "flow_weights": None if supervised else find_estimator(run.flow),
        "init_weights": find_model(run.init, "--init") if run.init else None,
    }
    return {role: file for role, file in used.items() if file}


def _describe_run(
    path: Path, config: PartConfig, settings: TrainSettings, seed: int, mixed: bool, used: dict[str, Path]
) -> dict[str, Any]:
    """Returns what must be equal for a run to be continued; files by their digests, since what a path leads to may change."""
    return {
        "network": json.loads(config.to_json()),
        "schedule": asdict(settings.schedule),
        "objective": asdict(settings.objective),
        "flow": settings.run.flow,
        "validation": settings.run.validation,
        "init": settings.run.init,
        "seed": seed,
        "data": provenance.file_digest(path),
        **{role: provenance.file_digest(file) for role, file in used.items()},
        **({"amp": True} if mixed else {}),
    }


def _check_flows(
    settings: RunSettings, estimator: Path | None, record: dict[str, Any], run: RunFolder, training: PairSource
) -> None:
    """Raises UsageError where the estimator's file is one that the run replaces, or flows_of is of other pairs.

    Only the same data, seed and choices give the same pairs.
    """
    if estimator is not None:
        run.refuse_inside("--flow", estimator)
    if settings.flows_of is None:
        return
    folder = Path(settings.flows_of)
    run.refuse_inside("flows_of", folder / "flows_first.npy")
    try:
        other = read_json(folder / "config.json")
    except (OSError, DataError):
        raise UsageError(f"flows_of = {folder}: no folder of a `dpc segment train` run") from None
    for key in ("data", "seed", "validation", "flow", "flow_weights"):
        if other.get(key) != record.get(key):
            raise UsageError(
                f"flows_of = {folder}: its {key} is {other.get(key)!r}, here {record.get(key)!r}; flows don't fit"
            )
    first_flows(folder, len(training.pairs), training.points)


def _start_network(config: PartConfig, init: Path | None, folder: RunFolder) -> PartNetwork:
    """Returns a new network, or one with the weights of --init. Raises UsageError where these are of another size."""
    model = PartNetwork(config)
    if init is not None:
        folder.refuse_inside("--init", init)
        other, _ = load_model(init)
        if other.config != config:
            raise UsageError(
                f"--init {init}: its network has another configuration; give the same --preset and network settings"
            )
        model.load_state_dict(other.state_dict())
    return model


def _open_labels(path: Path) -> CloudsReader:
    """Returns the reader of a file to learn from its labels: a PartsReader where the file is a prediction.

    Raises DataError where the file lacks what --supervised learns from.
    """
    reader = CloudsReader(path)
    if reader.attributes["dpc_kind"] == "parts":
        return PartsReader(path)
    missing = [] if "part" in reader.fields else ["part"]
    if not any(name in reader.fields for name in MOTION_FIELDS):
        missing.append(" or ".join(MOTION_FIELDS))
    if missing:
        raise DataError(
            f"{reader.path}: --supervised needs part ids and poses or scene flow, but the file has no "
            f"{' and no '.join(missing)}"
        )
    return reader
