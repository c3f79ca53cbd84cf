"""`dpc segment flow`: train a scene-flow estimator on a clouds file."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.progress import log
from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.signals import stop_requested
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.segment.flow.config import find_flow_config
from dpcli.segment.flow.trainer import COLUMNS, train_flow
from dpcli.store import CloudsReader, input_file


def run_flow_training(
    data: str, output: str, *, config: str, steps: int, batch: int, seed: int, device: str, force: bool
) -> None:
    """Resumes a stopped run of the same configuration; leaves `best.safetensors`, which --flow of train and predict takes."""
    chosen = choose_device(device)
    shape = find_flow_config(config)
    with input_file(data) as path:
        reader = CloudsReader(path)
        record = {
            "network": asdict(shape),
            "steps": steps,
            "batch": batch,
            "seed": seed,
            "data": provenance.file_digest(path),
        }
        folder = RunFolder(output, json.loads(json.dumps(record)), force, columns=COLUMNS, curves=draw_flow_curves)
        log.info(
            f"training a flow estimator ({config}) on {chosen}: {len(reader)} sequences, {steps} steps of {batch} pairs"
        )
        keep_freed_memory()
        with stop_requested() as stop:
            train_flow(reader, folder, steps=steps, batch=batch, seed=seed, device=chosen, stop=stop, config=config)
    print(folder.file("best.safetensors"))


def draw_flow_curves(rows: list[dict], path: Path) -> None:
    """Chamfer distance in training and end point error where poses are known, over steps, as a PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.6, 3.8), layout="constrained")
    axes = figure.add_subplot()
    for key, label in (("chamfer", "Chamfer, training"), ("validation_epe", "end point error, validation")):
        known = [(row["step"], row[key]) for row in rows if row.get(key) is not None]
        if known:
            axes.plot(*zip(*known), label=label)
    axes.set(xlabel="step", ylabel="object diameters", title="flow estimator")
    axes.set_ylim(bottom=0)
    if axes.get_lines():
        axes.legend(frameon=False)
    figure.savefig(path, dpi=120)
