"""Does the work of `dpc generate4d train-prior`; the options are in `cli/generate4d/train_prior.py`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dpcli.counted import counted
from dpcli.errors import UsageError
from dpcli.generate4d.shape.model_file import find_shape_model, load_shape_model
from dpcli.generate4d.shape.network import ShapeNetwork
from dpcli.generate4d.shape.training.learning_curves import COLUMNS, draw_curves
from dpcli.generate4d.shape.training.rounds import Kept, Sources, draw_round
from dpcli.generate4d.shape.training.settings import CATALOG, ShapeTraining
from dpcli.generate4d.shape.training.trainer import ShapeTrainer
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.progress import log
from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.seeds import Generate4DStream, torch_seed
from dpcli.runtime.signals import stop_requested
from dpcli.runtime.tuning import keep_freed_memory

HELD_OUT_ROUND = 1 << 20  # the number of the round that validates: no training gets so far


def train_shape_prior(
    output: str,
    settings: ShapeTraining,
    sources: Sources,
    models: dict[str, Any],
    *,
    seed: int,
    jobs: int,
    force: bool,
    device: str = "cpu",
) -> Path:
    """Trains on the pictures of the models to learn from and returns the file of the best weights, by the held-out ones.

    models: what the pictures come from; a run continues only with the same, and with the same weights to start from.
    Raises UsageError where the settings don't fit each other or the folder holds another run.
    """
    check_sizes(settings)
    where = choose_device(device)
    groups = {name: asdict(group) for name, group in settings._asdict().items()}
    record: dict[str, Any] = {**groups, "seed": seed, **models}
    if settings.data.init is not None:
        record["init_weights"] = provenance.file_digest(find_shape_model(settings.data.init))
    folder = RunFolder(output, record, force, columns=COLUMNS, curves=draw_curves)
    torch.manual_seed(torch_seed(seed, Generate4DStream.SHAPE_WEIGHTS))
    model = _start(settings, folder)
    notes = {"command": provenance.command_line(), "seed": seed, "trained_on": models}
    keep_freed_memory()
    with folder:
        folder.write_settings(CATALOG.to_toml(settings._asdict(), "generate4d train-prior"))
        drawn = [draw_round(make(HELD_OUT_ROUND, settings.data.validation)) for make in sources[1:]]
        weights = sum(value.numel() for value in model.parameters())
        log.info(
            f"{weights:,} weights; {counted(len(drawn[0].rgba), 'picture')} for validation; {counted(settings.schedule.steps, 'step')}"
        )
        held, creatures, things = (pictures.take(np.arange(len(pictures.rgba))) for pictures in drawn)
        with stop_requested() as stop:  # until here there is nothing to be kept, and a signal ends it at once
            kept = Kept(held, creatures.pictures, things.pictures)
            trainer = ShapeTrainer(
                model,
                folder,
                settings.schedule,
                sources.learned,
                kept,
                notes,
                seed=seed,
                jobs=jobs,
                stop=stop,
                device=where,
            )
            return trainer.run()


def check_sizes(settings: ShapeTraining) -> None:
    """Raises UsageError where the pictures can't be halved as often as the network has levels."""
    factor, size = 2 ** len(settings.network.widths), settings.schedule.size
    if size % factor:
        raise UsageError(
            f"size = {size}: expected a multiple of {factor}, as the network has {len(settings.network.widths)} levels"
        )


def _start(settings: ShapeTraining, folder: RunFolder) -> ShapeNetwork:
    """Returns a new network, or one with the weights of `init`. Raises UsageError where these are of another size."""
    init = settings.data.init
    if init is None:
        if not settings.schedule.steps:
            raise UsageError("steps = 0 scores the weights of init again, and none are given")
        return ShapeNetwork(settings.network)
    folder.refuse_inside("init", Path(init))
    found, _ = load_shape_model(init)
    if found.config != settings.network:
        raise UsageError(f"init = {init}: its network has another configuration; give the same network settings")
    model = ShapeNetwork(settings.network)
    model.load_state_dict(found.state_dict())
    return model
