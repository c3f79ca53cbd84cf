"""`dpc generate4d`: fit, render, export, view."""

from __future__ import annotations

from typing import Annotated

import typer

from dpcli.cli.generate4d import output as generate4d_output
from dpcli.cli.options import Device, Force, Output, Picture, Seed

app = typer.Typer(no_args_is_help=True)


@app.command()
def fit(
    views: Annotated[
        str, typer.Argument(help="A views file (dpc prepare video | animation | artemis), or - for a pipe.")
    ],
    output: Output,
    preset: Annotated[
        str, typer.Option(help="thesis (appendix C), quick (two CPU cores) or tiny (a trial).")
    ] = "quick",
    prior: Annotated[
        str, typer.Option(help="What is known beside the input view: none, views (role train in the file) or zero123.")
    ] = "none",
    prior_model: Annotated[
        str | None, typer.Option(help="Of --prior zero123: a local folder, or a hub's id, which is then downloaded.")
    ] = None,
    size: Annotated[int | None, typer.Option(help="Longer side of the fitted pictures, pixels.")] = None,
    start: Annotated[
        str | None, typer.Option(help="First Gaussians: sphere, inflate (one silhouette), hull (several), auto.")
    ] = None,
    dense_steps: Annotated[int | None, typer.Option(help="Steps in which every Gaussian moves by itself.")] = None,
    sparse_steps: Annotated[int | None, typer.Option(help="Steps in which control points carry them.")] = None,
    batch: Annotated[int | None, typer.Option(help="Pictures per step.")] = None,
    gaussians: Annotated[int | None, typer.Option(help="Gaussians at the start.")] = None,
    most_gaussians: Annotated[int | None, typer.Option(help="Gaussians at most.")] = None,
    parts: Annotated[int | None, typer.Option(help="Rigid parts at most.")] = None,
    control_points: Annotated[int | None, typer.Option(help="Control points at most.")] = None,
    neighbors: Annotated[int | None, typer.Option(help="Control points that move one Gaussian.")] = None,
    partition: Annotated[str | None, typer.Option(help="static: a point keeps its part; time: it may change.")] = None,
    temporal_weight: Annotated[float | None, typer.Option(help="lambda_temporal of eq. 5.3.")] = None,
    spatial_weight: Annotated[float | None, typer.Option(help="lambda_spatial of eq. 5.4.")] = None,
    no_rigid: Annotated[bool, typer.Option("--no-rigid", help="Non-rigid motion only (row a of Table 5.2).")] = False,
    no_temporal: Annotated[bool, typer.Option("--no-temporal", help="Without eq. 5.3 (row b).")] = False,
    no_spatial: Annotated[bool, typer.Option("--no-spatial", help="Without eq. 5.4.")] = False,
    no_fusion: Annotated[
        bool,
        typer.Option("--no-fusion", help="Rigid and non-rigid motion added (eq. 5.5) instead of weighed (rows b, c)."),
    ] = False,
    no_sparse: Annotated[bool, typer.Option("--no-sparse", help="Dense to the end (rows a to d).")] = False,
    no_regularize: Annotated[
        bool, typer.Option("--no-regularize", help="Without the losses that keep one view's object from going flat.")
    ] = False,
    run: Annotated[
        str | None, typer.Option("--run", help="Folder for checkpoints, log and previews. Default: OUTPUT with .fit")
    ] = None,
    picture: Picture = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
) -> None:
    """Fit a 4D scene to the pictures of a views file. Running again continues; SIGTERM saves first (exit 75)."""
    from dpcli.generate4d.commands.fit import run_fit

    changes = {
        "size": size,
        "start": start,
        "dense_steps": dense_steps,
        "sparse_steps": sparse_steps,
        "batch": batch,
        "gaussians": gaussians,
        "most_gaussians": most_gaussians,
        "parts": parts,
        "control_points": control_points,
        "neighbors": neighbors,
        "partition": partition,
        "temporal_weight": temporal_weight,
        "spatial_weight": spatial_weight,
    }
    switches = {
        "rigid": no_rigid,
        "temporal": no_temporal,
        "spatial": no_spatial,
        "fusion": no_fusion,
        "sparse": no_sparse,
    }
    changes |= {name: False for name, off in switches.items() if off}
    run_fit(
        views,
        output,
        preset_name=preset,
        changes=changes,
        prior=prior,
        prior_model=prior_model,
        regularize=not no_regularize,
        run=run,
        picture=picture,
        seed=seed,
        device=device,
        force=force,
    )


app.command("render")(generate4d_output.render)
app.command("export")(generate4d_output.export)
app.command("view")(generate4d_output.view)
