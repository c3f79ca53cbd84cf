"""What `dpc generate4d fit` does; the options come from `cli/generate4d.py`."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from dpcli.errors import DataError, UsageError
from dpcli.generate4d.config import PRIORS, preset
from dpcli.generate4d.fit import COLUMNS, Fit
from dpcli.generate4d.out.fit_curves import draw_curves
from dpcli.generate4d.out.preview import write_preview
from dpcli.generate4d.out.scene_writer import to_scene
from dpcli.generate4d.scene.model import Model4D
from dpcli.generate4d.targets import Targets, load_targets
from dpcli.ops.cameras import orbit_of
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.progress import log
from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.signals import stop_requested
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.runtime.whole_file import PICTURES, check_target
from dpcli.store import input_file, output_file
from dpcli.store.gaussians import read_scene, scene_origin, write_scene
from dpcli.store.writing.already_made import already_made


def run_fit(
    views: str,
    output: str,
    *,
    preset_name: str,
    changes: dict[str, Any],
    prior: str,
    prior_model: str | None,
    regularize: bool,
    run: str | None,
    picture: Path | None,
    seed: int,
    device: str,
    force: bool,
) -> None:
    """`dpc generate4d fit`: reads a views file, keeps checkpoints in a folder beside the output, writes the scene."""
    config = preset(preset_name, **changes)
    if prior not in PRIORS:
        raise UsageError(f"--prior {prior}: expected one of {', '.join(PRIORS)}")
    if picture is not None:
        check_target(picture, "--picture", PICTURES)
    chosen = choose_device(device)
    where = _run_folder(output, run)
    with input_file(views) as path:
        record = {
            "config": json.loads(json.dumps(asdict(config))),
            "prior": prior,
            "prior_model": prior_model,
            "regularize": regularize,
            "seed": seed,
            "data": provenance.file_digest(path),
        }
        roles = ("train",) if prior == "views" else ()
        refusal = "exists already and is no scene of this fit; --force replaces it"
        done = output != "-" and not force
        if done and already_made(Path(output), {"config": record}, scene_origin, refusal, ["config"]):
            log.info(f"{output}: this fit is finished; --force fits again")
            if picture is not None:
                write_preview(read_scene(Path(output)), load_targets(path, config.size, roles), picture)
            return
        targets = load_targets(path, config.size, roles)
        if prior == "views" and targets.num_views < 2:
            raise DataError(
                f"{path}: --prior views needs views of the role 'train', but there is none; give them to"
                " `dpc prepare video --views`, or use --prior none"
            )
        folder = RunFolder(where, record, force, columns=COLUMNS, curves=draw_curves)
        judge = _prior(prior, prior_model, targets, device)
        log.info(
            f"fitting {targets.name} on {chosen}: {targets.num_views} view(s) x {targets.num_frames} frames of"
            f" {targets.size[0]} x {targets.size[1]}, {config.dense_steps} dense + {config.sparse_steps} sparse steps"
        )
        keep_freed_memory()
        with folder, stop_requested() as stop:
            fit = Fit(targets, config, folder, stop, seed, judge, chosen, _previews(folder, targets), regularize)
            model = fit.run().cpu()
            model.refresh_neighbors()
        scene = to_scene(model, targets, _metrics(model, targets, fit))
        history = [*targets.history, provenance.record(record, seed, {"views": path})]
        with output_file(output) as place:
            write_scene(
                place,
                scene,
                seed=seed,
                source=targets.name,
                provenance=history,
                length_unit=targets.length_unit,
                force=force,
            )
        if picture is not None:
            write_preview(model, targets, picture)
    log.info(
        f"reference view {scene.metrics['psnr_reference']:.2f} dB PSNR, {scene.metrics['gaussians']} Gaussians,"
        f" {scene.metrics['seconds']:.0f} s"
    )


def _run_folder(output: str, run: str | None) -> Path:
    if run is not None:
        return Path(run)
    if output == "-":
        raise UsageError("-o -: say with --run FOLDER where checkpoints and previews go")
    return Path(output).with_suffix(".fit")


def _previews(folder: RunFolder, targets: Targets):
    def write(model: Model4D, step: int) -> None:
        write_preview(model, targets, folder.file("preview.png"))

    return write


def _prior(name: str, model: str | None, targets: Targets, device: str):
    """The generative prior, ready; None where given views or regularizers do the work."""
    if name != "zero123":
        return None
    import numpy as np

    from dpcli.generate4d.priors.sds import Zero123

    elevation = orbit_of(targets.world_to_camera[targets.reference])[1]
    prior = Zero123.load(model, device, reference_elevation=elevation)
    frames = [targets.picture(targets.reference, frame) for frame in range(targets.num_frames)]
    prior.prepare(np.stack([(frame * 255).round().astype(np.uint8) for frame in frames]))
    return prior


@torch.no_grad()
def _metrics(model: Model4D, targets: Targets, fit: Fit) -> dict:
    """What the fit itself can say: PSNR of the fitted views on white at the fitted size, mean over frames of each."""
    times, per_view = targets.times(), {}
    for view in range(targets.num_views):
        values = []
        for frame in range(targets.num_frames):
            wanted, intrinsics, poses = targets.at([view], [frame])
            white = torch.ones(1, 3)
            rendered, _, _ = model.render(model.at(times[[frame]]), poses, intrinsics, *targets.size, white)
            error = (rendered.clamp(0, 1) - (wanted[..., :3] + 1 - wanted[..., 3:])).square().mean()
            values.append(-10 * math.log10(max(float(error), 1e-10)))
        per_view["reference" if view == targets.reference else f"train{view}"] = sum(values) / len(values)
    named = {f"psnr_{key}": round(value, 3) for key, value in per_view.items()}
    return {**named, "gaussians": len(model.gaussians), "seconds": round(fit.spent, 1), "steps": fit.step}
