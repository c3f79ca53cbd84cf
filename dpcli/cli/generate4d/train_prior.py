"""`dpc generate4d train-prior`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.options import Device, Force, Seed
from dpcli.cli.settings_options import options_of
from dpcli.generate4d.shape.training.settings import CATALOG, PRESETS, ShapeTraining
from dpcli.runtime.settings.catalog import Given

EVERYDAY = ("held_out", "init", "steps", "size")


@options_of(CATALOG, EVERYDAY, presets=PRESETS, preset="release")
def train_prior(
    output: Annotated[str, typer.Option("-o", "--output", help="Folder for weights, checkpoints, log and curves.")],
    given: Given,
    meshes: Annotated[
        list[Path] | None,
        typer.Argument(help="Models (.glb, .gltf) or folders of them; none: made-up creatures and things alone."),
    ] = None,
    seed: Seed = 0,
    jobs: Annotated[
        int,
        typer.Option(
            "--jobs", min=1, max=1024, help="Processes that make pictures; 1: made in this process, between the steps."
        ),
    ] = 2,
    device: Device = "auto",
    force: Force = False,
) -> None:
    """Train the shape network of `fit` on pictures of models, moving and still, and of made-up creatures and things.

    Running again continues.
    """
    settings = ShapeTraining(**CATALOG.resolve(PRESETS[str(given.preset)], given))
    from dpcli.generate4d.commands.train_prior import check_sizes, train_shape_prior
    from dpcli.generate4d.shape.training.rounds import Sources
    from dpcli.prepare.synthetic.shape_pictures import find_meshes, picture_sources
    from dpcli.prepare.views.views_pipeline import digest_of

    check_sizes(settings)
    learned, held = find_meshes(meshes or [], settings.data.held_out)
    shares = {key: getattr(settings.data, key) for key in ("made", "moving", "views", "warp")}
    sources = picture_sources(learned, held, settings.schedule.size, seed, **shares)
    models = {"models": len(learned), "held_out": sorted(file.path.name for file in held)}
    if learned or held:
        models["models_digest"] = digest_of(file.path for file in [*learned, *held])
    best = train_shape_prior(
        output,
        settings,
        Sources(*(source.make for source in sources)),
        models,
        seed=seed,
        jobs=jobs,
        force=force,
        device=device,
    )
    typer.echo(best)
