"""`dpc segment`: train, flow, estimate-flow, predict, profile."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from dpcli.cli.options import Device, Force, Json, Output, Picture, Seed
from dpcli.errors import UsageError

app = typer.Typer(no_args_is_help=True)

Amp = Annotated[
    bool | None,
    typer.Option(
        "--amp/--no-amp",
        help="Products in bfloat16, geometry in float32. Default: on GPUs that have it (Ampere and later).",
    ),
]
_FLOW = "First flow: icp (rigid pieces), nearest (point), or a trained estimator's file or folder (dpc segment flow)."


@app.command()
def train(
    data: Annotated[str, typer.Argument(help="A clouds file of sequences of two frames or more, or - for a pipe.")],
    output: Annotated[str, typer.Option("-o", "--output", help="Folder for checkpoints, logs and curves.")],
    config: Annotated[
        str, typer.Option(help="compact (under 0.25 M parameters) or release (1.43 M, as published).")
    ] = "compact",
    supervised: Annotated[
        bool, typer.Option("--supervised", help="Learn from part ids and poses (or scene flow) instead.")
    ] = False,
    flow: Annotated[str, typer.Option(help=_FLOW)] = "icp",
    flow_decay: Annotated[
        float, typer.Option(help="alpha of eq. 4.6: 1 keeps the first flow (past), 0 takes the newest (current).")
    ] = 0.9,
    consensus: Annotated[
        str, typer.Option(help="Weights from the motion head: thesis (eq. 4.7), release (squared, gated) or none.")
    ] = "thesis",
    tau: Annotated[float, typer.Option(help="Sharpness of the consensus, per object diameter.")] = 20.0,
    loss: Annotated[str, typer.Option(help="blended (as released) or per-part (eq. 4.8 as written).")] = "blended",
    group: Annotated[
        str | None, typer.Option(help="icosahedral, or trivial: no equivariance (ablation). Default: icosahedral.")
    ] = None,
    pooling: Annotated[
        str | None,
        typer.Option(
            help="point: each point chooses its rotations; global: the cloud does (ablation). Default: point."
        ),
    ] = None,
    no_motion_head: Annotated[bool, typer.Option("--no-motion-head", help="Leave the motion head out.")] = False,
    smooth: Annotated[float, typer.Option(help="Weight of the smoothness of masks.")] = 0.1,
    invariance: Annotated[float, typer.Option(help="Weight of agreement between two turned copies.")] = 0.0,
    cold_start: Annotated[
        float, typer.Option(help="Weight, in the first part of the training, of the bodies that the flow alone shows.")
    ] = 1.0,
    cold_until: Annotated[float, typer.Option(help="Fraction of the training after which that ends.")] = 1.0,
    motion_after: Annotated[float, typer.Option(help="Fraction of the training before the motion head learns.")] = 0.3,
    update_after: Annotated[float, typer.Option(help="Fraction before flows are corrected.")] = 0.4,
    consensus_after: Annotated[float, typer.Option(help="Fraction before consensus weighs.")] = 0.5,
    epochs: Annotated[int, typer.Option(help="Passes of --pairs-per-epoch pairs.")] = 10,
    pairs_per_epoch: Annotated[int, typer.Option(min=0, help="Pairs drawn per epoch; 0 takes all.")] = 1000,
    batch: Annotated[int, typer.Option(help="Pairs per step.")] = 8,
    lr: Annotated[float, typer.Option(help="Adam's learning rate (cosine to zero).")] = 1e-3,
    points: Annotated[int | None, typer.Option(min=32, help="Points per frame. Default: the configuration's.")] = None,
    slots: Annotated[int | None, typer.Option(min=2, help="Most parts. Default: the configuration's (8).")] = None,
    no_augment: Annotated[bool, typer.Option("--no-augment", help="Don't turn pairs at random.")] = False,
    validation: Annotated[
        str | None,
        typer.Option(
            help="Held out from training: a fraction, class names with commas, or none. Default: split 'validation'."
        ),
    ] = None,
    start_from: Annotated[
        str | None, typer.Option(help="A trained part network to start from: file, folder or shipped name.")
    ] = None,
    flows_of: Annotated[
        Path | None, typer.Option(help="Folder of a run on the same pairs, whose first flows are taken over.")
    ] = None,
    amp: Amp = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
) -> None:
    """Train a part network on pairs of frames; no labels are read unless --supervised. Running again continues."""
    from dpcli.segment.commands.predict import run_training

    network: dict[str, Any] = {"group": group, "pooling": pooling, "slots": slots}
    if no_motion_head:
        network["motion_width"] = 0
    schedule = {
        "epochs": epochs,
        "pairs_per_epoch": pairs_per_epoch or None,
        "batch": batch,
        "learning_rate": lr,
        "augment": not no_augment,
    }
    objective = {
        "form": loss,
        "smooth": smooth,
        "invariance": invariance,
        "supervised": supervised,
        "cold_start": cold_start,
        "cold_until": cold_until,
        "consensus": consensus,
        "tau": tau,
        "flow_decay": flow_decay,
        "motion_after": motion_after,
        "update_after": update_after,
        "consensus_after": consensus_after,
    }
    run_training(
        data,
        output,
        config=config,
        network=network,
        schedule=schedule,
        objective=objective,
        flow=flow,
        points=points,
        validation=validation,
        start_from=start_from,
        flows_of=flows_of,
        seed=seed,
        device=device,
        force=force,
        amp=amp,
    )


@app.command()
def predict(
    data: Annotated[str, typer.Argument(help="A clouds file, or - for a pipe.")],
    output: Output,
    model: Annotated[
        str | None,
        typer.Option(
            "--model", help="A trained part network: file, training folder or shipped name. Default: the shipped one."
        ),
    ] = None,
    method: Annotated[
        str | None, typer.Option(help="A classical method instead: dbscan, ward, ssc or trajaffn.")
    ] = None,
    method_option: Annotated[
        list[str] | None, typer.Option("--method-option", help="NAME=VALUE for --method; may be repeated.")
    ] = None,
    parts: Annotated[
        int | None, typer.Option("--parts", min=1, help="Number of parts for --method. Default: found.")
    ] = None,
    flow: Annotated[str, typer.Option(help=_FLOW)] = "icp",
    pairs: Annotated[str, typer.Option(help="Motions between adjacent frames, or all pairs.")] = "adjacent",
    icp: Annotated[int, typer.Option(min=0, help="Steps of object-aware ICP that refine the motions.")] = 20,
    points: Annotated[
        int, typer.Option(min=32, help="Points of a frame the segmenter sees; its answer is carried back to all.")
    ] = 512,
    no_vote: Annotated[bool, typer.Option("--no-vote", help="Don't blend masks of neighboring frames.")] = False,
    no_split: Annotated[
        bool, typer.Option("--no-split", help="Keep a part whole even if its points move as several bodies.")
    ] = False,
    smallest: Annotated[float, typer.Option(min=0, help="Parts below this share of the points are given up.")] = 0.03,
    split: Annotated[str, typer.Option("--split", help="Sequences of this split, or all.")] = "all",
    picture: Picture = None,
    turntable: Annotated[
        Path | None, typer.Option("--turntable", help="Write an animation (.gif) to this file.")
    ] = None,
    ply: Annotated[
        Path | None, typer.Option("--ply", help="Write every frame as a colored .ply into this folder.")
    ] = None,
    amp: Amp = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
) -> None:
    """Parts of every point, the same through all frames, and each part's rigid motion and the flow between frames."""
    from dpcli.segment.commands.predict import default_model, run_prediction

    if pairs not in ("adjacent", "all"):
        raise UsageError(f"--pairs {pairs}: expected adjacent or all")
    if method is None and (parts is not None or method_option):
        raise UsageError("--parts and --method-option belong to --method; the network finds its own number of parts")
    if method is not None and model is not None:
        raise UsageError(f"--model {model}: --method {method} uses no network; give one of both")
    options = dict(word.split("=", 1) if "=" in word else (word, "") for word in method_option or [])
    divide = not no_split and method is None
    refinement = {
        "points": points,
        "pairs": pairs,
        "icp": icp,
        "vote": not no_vote,
        "split": divide,
        "smallest": smallest,
    }
    run_prediction(
        data,
        model or ("" if method else default_model()),
        output,
        method=method,
        method_options=options,
        num_parts=parts,
        flow=flow,
        refinement=refinement,
        split=split,
        seed=seed,
        device=device,
        force=force,
        picture=picture,
        ply=ply,
        turntable=turntable,
        amp=amp,
    )


@app.command()
def flow(
    data: Annotated[str, typer.Argument(help="A clouds file of sequences of two frames or more, or - for a pipe.")],
    output: Annotated[str, typer.Option("-o", "--output", help="Folder for checkpoints, logs and curves.")],
    config: Annotated[str, typer.Option(help="compact or release (FlowStep3D's widths).")] = "compact",
    steps: Annotated[int, typer.Option(min=1, help="Optimizer steps.")] = 2000,
    batch: Annotated[int, typer.Option(min=1, help="Pairs per step.")] = 8,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
) -> None:
    """Train a scene-flow estimator without labels (Chamfer distance and smoothness), for --flow of train and predict."""
    from dpcli.segment.commands.flow import run_flow_training

    run_flow_training(data, output, config=config, steps=steps, batch=batch, seed=seed, device=device, force=force)


@app.command("estimate-flow")
def estimate_flow(
    data: Annotated[str, typer.Argument(help="A clouds file, or - for a pipe.")],
    output: Output,
    flow: Annotated[
        str,
        typer.Option(
            help="icp (rigid pieces), nearest (point), or a trained estimator's file or folder (dpc segment flow)."
        ),
    ] = "icp",
    points: Annotated[
        int, typer.Option(min=0, help="Points drawn from each frame; 0 takes all. Smaller frames are kept whole.")
    ] = 512,
    as_points: Annotated[
        bool,
        typer.Option(
            "--as-points",
            help="Write the flow as the points themselves, for a second classifier; scaled, one factor a sequence, so that "
            "its norms' 99th percentile is that of the points' distances from their mean.",
        ),
    ] = False,
    split: Annotated[str, typer.Option("--split", help="Sequences of this split, or all.")] = "all",
    seed: Seed = 0,
    device: Device = "auto",
    jobs: Annotated[
        int | None,
        typer.Option("--jobs", min=1, help="Processes. Default: for icp the CPUs this process may use, else 1."),
    ] = None,
    force: Force = False,
) -> None:
    """Scene flow of every frame to the next, as the field scene_flow of a clouds file (last frame: to the one before)."""
    from dpcli.segment.commands.estimate_flow import run_flow_estimate

    run_flow_estimate(
        data,
        output,
        flow=flow,
        points=points,
        as_points=as_points,
        split=split,
        seed=seed,
        device=device,
        jobs=jobs,
        force=force,
    )


@app.command()
def profile(
    config: Annotated[str, typer.Option(help="compact or release.")] = "compact",
    group: Annotated[str | None, typer.Option(help="icosahedral or trivial.")] = None,
    points: Annotated[int | None, typer.Option(min=32, help="Points per frame. Default: the configuration's.")] = None,
    as_object: Json = False,
    device: Device = "auto",
) -> None:
    """True parameters and multiply-adds of a part network, the paper's way of counting beside, latency and memory."""
    from dpcli.segment.cost import run_profile

    run_profile(config, group, points, as_object, device)
