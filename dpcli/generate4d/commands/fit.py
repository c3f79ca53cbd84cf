"""Does the work of `dpc generate4d fit`; the options are in `cli/generate4d/fit.py`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.generate4d.config import CATALOG, FitConfig, Supervision
from dpcli.generate4d.fit import COLUMNS, FitRun
from dpcli.generate4d.fitted_psnr import fitted_psnr
from dpcli.generate4d.optimizer import SceneOptimizer
from dpcli.generate4d.out.export import POINT_OPACITY
from dpcli.generate4d.out.fit_curves import draw_curves
from dpcli.generate4d.out.preview import write_preview
from dpcli.generate4d.out.scene_writer import to_scene
from dpcli.generate4d.priors.interface import Prior
from dpcli.generate4d.scene.initialization import check_cameras
from dpcli.generate4d.scene.model import Model4D
from dpcli.generate4d.shape.choice import guide
from dpcli.generate4d.shape.model_file import find_shape_model
from dpcli.generate4d.targets import Targets, load_targets
from dpcli.ops.cameras import orbit_of
from dpcli.ops.splatting.rasterization import gsplat_available
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.progress import log
from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.signals import stop_requested
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.runtime.whole_file import PICTURES, check_target
from dpcli.store import input_file, output_file
from dpcli.store.gaussians import GaussianScene, read_scene, scene_origin, write_scene
from dpcli.store.views import ViewsReader
from dpcli.store.writing.already_made import already_made


def fit_scene(
    views: str,
    output: str,
    config: FitConfig,
    supervision: Supervision,
    *,
    run: str | None,
    picture: Path | None,
    seed: int,
    device: str,
    force: bool,
) -> None:
    """Fits a scene to a views file, or continues a stopped fit, and writes it; does nothing where this fit is finished.

    run: folder of checkpoints, log, settings and previews, by default beside the output. picture: where the last preview
    is written. Raises UsageError, DataError for what a user can correct, Stopped after a signal.
    """
    if picture is not None:
        check_target(picture, "--picture", PICTURES)
    device = _device(device, supervision.prior)
    chosen, folder_path = choose_device(device), _run_folder(output, run)
    with input_file(views) as path:
        record = _record(path, config, supervision, seed)
        entry, made = provenance.record(record, seed, {"views": path}), output != "-" and not force
        if made and already_made(Path(output), entry, scene_origin, ["config"]):
            if picture is not None:
                write_preview(read_scene(Path(output)), _load(path, config, supervision), picture)
            return
        targets = _load(path, config, supervision)
        targets.check_world(views)
        targets.check_cut_out(views)
        if targets.num_views > 1:
            check_cameras(targets, views)
        folder = RunFolder(folder_path, record, force, columns=COLUMNS, curves=draw_curves)
        prior = _load_prior(supervision, targets, device)
        shape = guide(supervision.prior, targets, supervision.prior_model)
        optimizer = SceneOptimizer(targets, config, seed, prior, chosen, supervision.regularize, shape)
        settings = CATALOG.to_toml({"fit": config, "supervision": supervision}, "generate4d fit")
        model, metrics = _optimize(optimizer, folder, settings)
        scene = to_scene(model, targets, metrics, calm=shape is not None)
        origin = {"source": targets.name, "length_unit": targets.length_unit, "provenance": [*targets.history, entry]}
        with output_file(output) as place:
            write_scene(place, scene, seed=seed, force=force, **origin)
        if picture is not None:
            write_preview(scene, targets, picture)  # its parts are those of the file
    log.info(
        f"reference view {metrics['psnr_reference']:.2f} dB PSNR, {metrics['gaussians']} Gaussians,"
        f" {metrics['seconds']:.0f} s"
    )
    _tell_faint(scene)


def _tell_faint(scene: GaussianScene) -> None:
    """Warns where a fit let the object fade away: of a small or thin one, an empty picture has a high PSNR, too."""
    if (most := float(scene.opacity.max())) < POINT_OPACITY:
        log.warn(
            f"no Gaussian is {POINT_OPACITY} opaque or more, the most opaque has {most:.2g}: hardly anything of the object is seen, "
            "whatever the PSNR; fit larger pictures (--size) or for more steps, of a clip in which the object is larger"
        )


def _record(views: Path, config: FitConfig, supervision: Supervision, seed: int) -> dict[str, Any]:
    """Returns what makes a fit this one and no other: its settings, seed, input, and the weights that a user named."""
    settings = {"config": asdict(config), **asdict(supervision)}
    record = {**json.loads(json.dumps(settings)), "seed": seed, "data": provenance.file_digest(views)}
    if supervision.prior in ("auto", "network") and supervision.prior_model is not None:
        record["prior_weights"] = provenance.file_digest(find_shape_model(supervision.prior_model))
    return record


def _load(path: Path, config: FitConfig, supervision: Supervision) -> Targets:
    """Returns the pictures to fit. Raises DataError where given views are asked for and the file has none."""
    given = supervision.prior == "views"
    targets = load_targets(path, config.size, ("train",) if given else ())
    if given and targets.num_views < 2:
        raise DataError(
            f"{path}: --prior views needs views of the role 'train', but there is none; give them to"
            " `dpc prepare video --views`, or use --prior none"
        )
    if supervision.prior == "auto":
        with ViewsReader(path) as reader:
            unused = reader.header.role.count("train")
        if unused:
            log.info(f"{path}: {unused} of its views may be fitted to, too, but only --prior views does so")
    return targets


def _optimize(optimizer: SceneOptimizer, folder: RunFolder, settings: str) -> tuple[Model4D, dict[str, Any]]:
    """Runs the fit in its folder; returns the model, on the CPU, and the numbers that the scene file tells of the fit."""
    targets, config = optimizer.targets, optimizer.config
    log.info(
        f"fitting {targets.name} on {optimizer.device}: {counted(targets.num_views, 'view')} x {counted(targets.num_frames, 'frame')} of"
        f" {targets.size[0]} x {targets.size[1]}, {config.dense_steps} dense + {config.sparse_steps} sparse steps"
    )
    keep_freed_memory()
    with folder, stop_requested() as stop:
        folder.write_settings(settings)
        fit = FitRun(optimizer, folder, stop, _preview_writer(folder, targets))
        model = fit.run().cpu()
        model.refresh_neighbors()
    named = {f"psnr_{view}": round(value, 3) for view, value in fitted_psnr(model, targets).items()}
    counts = {"gaussians": len(model.gaussians), "seconds": round(fit.seconds, 1), "steps": optimizer.step}
    return model, {**named, **counts}


def _device(name: str, prior: str) -> str:
    """Returns the device's name; `auto` is the CPU, whose rasterizer is faster than a GPU's without gsplat.

    Zero123's network needs a GPU all the same.
    """
    if name != "auto" or prior == "zero123" or not torch.cuda.is_available() or gsplat_available():
        return name
    log.info("fitting on the CPU; with gsplat a GPU is faster (pip install 'dpc-toolkit[gsplat]'; --device cuda)")
    return "cpu"


def _run_folder(output: str, run: str | None) -> Path:
    if run is not None:
        return Path(run)
    if output == "-":
        raise UsageError("-o -: say with --run FOLDER where checkpoints and previews go")
    return Path(output).with_suffix(".fit")


def _preview_writer(folder: RunFolder, targets: Targets) -> Callable[[Model4D], None]:
    path = folder.file("preview.png")

    def write(model: Model4D) -> None:
        first = not path.exists()
        write_preview(model, targets, path)
        if first:  # before the first step, so that the start can be looked at from all sides
            log.info(f"{path}: a preview from all sides, updated as the fit goes on")

    return write


def _load_prior(supervision: Supervision, targets: Targets, device: str) -> Prior | None:
    """Returns the generative prior, prepared for the video; None where given views or regularizers do the work."""
    if supervision.prior != "zero123":
        return None
    from dpcli.generate4d.priors.sds import ScoreDistillation

    elevation = orbit_of(targets.world_to_camera[targets.reference])[1]
    prior = ScoreDistillation.load(supervision.prior_model, device, reference_elevation=elevation)
    frames = [targets.picture(targets.reference, frame) for frame in range(targets.num_frames)]
    prior.prepare(np.stack([(frame * 255).round().astype(np.uint8) for frame in frames]))
    return prior
