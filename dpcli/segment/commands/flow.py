"""`dpc segment flow`: a scene-flow estimator learned from the pairs of frames of a clouds file, without labels."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from dpcli.draw.learning_curves import Curve, Panel, draw_learning_curves
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.distributed import refuse_several
from dpcli.runtime.progress import log
from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.signals import stop_requested
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.segment.flow.config import CATALOG, FlowConfig, FlowSchedule
from dpcli.segment.flow.trainer import COLUMNS, FlowTrainer
from dpcli.store import CloudsReader, input_file


def train_flow_estimator(
    data: str, output: str, *, network: FlowConfig, schedule: FlowSchedule, seed: int, device: str, force: bool
) -> Path:
    """Trains on a clouds file; returns `best.safetensors` of the folder `output`, which --flow of other commands takes.

    Running again continues a stopped run of the same settings. Raises UsageError where the folder holds another run.
    """
    refuse_several("segment flow")
    chosen = choose_device(device)
    with input_file(data) as path:
        reader = CloudsReader(path)
        record = {
            "network": asdict(network),
            "schedule": asdict(schedule),
            "seed": seed,
            "data": provenance.file_digest(path),
        }
        folder = RunFolder(output, record, force, columns=COLUMNS, curves=draw_flow_curves)
        log.info(
            f"training a flow estimator on {chosen}: {len(reader)} sequences, {schedule.steps} steps of"
            f" {schedule.batch} pairs"
        )
        keep_freed_memory()
        with stop_requested() as stop:
            trainer = FlowTrainer(reader, folder, network, schedule, seed=seed, device=chosen, stop=stop)
            with folder:  # last: it may delete an earlier model
                folder.write_settings(CATALOG.to_toml({"network": network, "schedule": schedule}, "segment flow"))
                trainer.run()
    return folder.file("best.safetensors")


def draw_flow_curves(rows: list[dict], path: Path) -> None:
    """Draws the Chamfer distance in training, and the end point error where poses are known, over steps, as a PNG."""
    curves = [Curve("chamfer", "Chamfer, training"), Curve("validation_epe", "end point error, validation")]
    draw_learning_curves(rows, [Panel("flow estimator", curves, "object diameters", (0, None))], path, "step")
