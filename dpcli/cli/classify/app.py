"""`dpc classify`: train, predict, fuse, profile."""

from __future__ import annotations

from typing import Annotated

import typer

from dpcli.cli.classify import stream as classify_stream
from dpcli.cli.classify.explain import Split
from dpcli.cli.classify.explain import app as explain_app
from dpcli.cli.options import Device, Force, Json, Output, Seed, TrustedBackbone
from dpcli.errors import UsageError

app = typer.Typer(no_args_is_help=True)
app.add_typer(explain_app, name="explain")


@app.command()
def train(
    data: Annotated[str, typer.Argument(help="A clouds file with labels and a split 'train', or - for a pipe.")],
    output: Annotated[str, typer.Option("-o", "--output", help="Folder for checkpoints, logs and curves.")],
    preset: Annotated[
        str, typer.Option(help="thesis, release, quick (a seventh of the operations, fits a CPU) or tiny (demo).")
    ] = "quick",
    backbone: Annotated[
        str | None,
        typer.Option(
            help="Static network: pointnet2 (default), dgcnn, spidercnn, or your own as module:Class (docs/backbones.md)."
        ),
    ] = None,
    pretrain: Annotated[
        bool,
        typer.Option("--pretrain", help="The static stream alone on single clouds (ModelNet40); for --static-from."),
    ] = False,
    frames: Annotated[int | None, typer.Option(help="Frames per clip. Default: the preset's (16; release 32).")] = None,
    points: Annotated[int | None, typer.Option(help="Points drawn per frame. Default: the preset's.")] = None,
    timing: Annotated[
        str, typer.Option(help="clips (consecutive frames) or uniform (frames spread over the video).")
    ] = "clips",
    epochs: Annotated[int | None, typer.Option(help="Epochs of the static stage. Default: the preset's.")] = None,
    epochs_dynamic: Annotated[
        int | None, typer.Option(help="Epochs of the dynamic stage. Default: the preset's.")
    ] = None,
    clips_per_video: Annotated[int, typer.Option(help="Random clips per video and epoch; 0 takes every start.")] = 1,
    drop_short: Annotated[
        bool,
        typer.Option("--drop-short", help="Leave out videos shorter than a clip, as peers do, instead of padding."),
    ] = False,
    validation: Annotated[
        str | None,
        typer.Option(
            help="split: the file's own validation videos; or carved from the training videos: subject, subjects:3,5, fold:3/10"
            " (counted from 0), a fraction; or none. Default: split where the file has one, else subject, or 0.15 without subjects."
        ),
    ] = None,
    batch: Annotated[
        int | None, typer.Option(help="Clips per step, of all processes together. Default: the preset's.")
    ] = None,
    accumulate: Annotated[
        int | None,
        typer.Option(
            help="Compute a batch in so many parts, one after the other: less memory, but batch norm sees one part at a time. Default: 1."
        ),
    ] = None,
    amp: Annotated[
        bool | None,
        typer.Option(
            "--amp/--no-amp", help="Matrix products in bfloat16. Default: on GPUs that have it (Ampere and later)."
        ),
    ] = None,
    lr: Annotated[float | None, typer.Option(help="Adam's learning rate. Default: the preset's.")] = None,
    lr_dynamic: Annotated[
        float | None, typer.Option(help="The same for the dynamic stage. Default: the preset's.")
    ] = None,
    decay: Annotated[str | None, typer.Option(help="cosine, staircase (x0.7 every 200,000 clips) or constant.")] = None,
    label_smoothing: Annotated[
        float | None,
        typer.Option(
            help="Share of each label spread over all classes, 0 to below 1: streams less sure of themselves."
            " Default: the preset's (quick 0.1, others 0)."
        ),
    ] = None,
    augment: Annotated[
        str | None,
        typer.Option(
            help="ours, peers (axis scales from the camera), release or none; then changes, as in ours,speed=0.3: scale, dropout, crop"
            " (shares), turn, tilt (rad), shift, jitter (length units), per_axis (0, 1), speed (0.3: consecutive frames up to"
            " 1.3 times as fast or slow), origin (0, 1: about the camera, else the clip's mean). Default: the preset's."
        ),
    ] = None,
    variant: Annotated[
        str | None, typer.Option(help="thesis or release: where text and published code disagree.")
    ] = None,
    normalize: Annotated[
        str | None,
        typer.Option(
            help="Coordinates of a clip: none; center (its mean at 0); height (and every body equally tall, y upright);"
            " unit (and within radius 1); image (rows, columns, depth of gestures). Default: the preset's."
        ),
    ] = None,
    grouping: Annotated[
        str | None, typer.Option(help="Neighbors in the radius: first, nearest or balanced over frames.")
    ] = None,
    solver: Annotated[str | None, typer.Option(help="Surface fit: inverse (thesis A.1.1) or ridge.")] = None,
    reduction: Annotated[
        float | None, typer.Option(help="Width of the fitted features as a share of the static layer's. Default: 0.5.")
    ] = None,
    group_size: Annotated[int | None, typer.Option(help="Features per fitted surface (d).")] = None,
    temporal_radius: Annotated[
        int | None, typer.Option(help="Frames before and after that count as neighbors.")
    ] = None,
    static_temporal_radius: Annotated[
        int | None,
        typer.Option(
            help="The same for the static stream alone (pointnet2): 0 keeps its neighborhoods within a frame, so that it sees no"
            " motion. Default: 0 with --preset thesis, else as --temporal-radius (one set of neighborhoods for both streams)."
        ),
    ] = None,
    radius: Annotated[
        float | None, typer.Option(help="Spatial radius of stage 1, in the input's unit; stage 2 doubles it.")
    ] = None,
    centroids: Annotated[
        tuple[int, int] | None,
        typer.Option(
            metavar="N N",
            help="Neighborhoods of a clip in the two stages (pointnet2). No weight depends on it: train with few, then go on"
            " by --init with the preset's (thesis 1024 512, quick 256 128).",
        ),
    ] = None,
    neighbors: Annotated[
        int | None,
        typer.Option(
            help="Points of a neighborhood: likewise, but for spidercnn. Default: the preset's (thesis 64, quick 32)."
        ),
    ] = None,
    dropout: Annotated[float | None, typer.Option(help="Dropout before each head's last layer.")] = None,
    no_normals: Annotated[
        bool, typer.Option("--no-normals", help="Ablation v: pool reduced features instead of fitting surfaces.")
    ] = False,
    no_weights: Annotated[bool, typer.Option("--no-weights", help="Ablation vi: every neighbor weighs 1.")] = False,
    static_from: Annotated[
        str | None, typer.Option(help="A trained model whose static stream to start from (ablations ii, iv).")
    ] = None,
    init: Annotated[
        str | None,
        typer.Option(
            help="A trained or shipped model whose both streams to start from, e.g. of another --frames,"
            " or of other classes (the last layers are fresh then)."
        ),
    ] = None,
    draws: Annotated[
        int,
        typer.Option(
            help="Dynamic stage: so many fixed draws of every clip (start, points, augmentation) in turn, their neighbors searched"
            " once and kept in a nameless file of the folder (preset thesis: 0.44 MB a clip and draw, quick 0.03)."
            " 0: a new draw every epoch."
        ),
    ] = 0,
    workers: Annotated[
        int | None,
        typer.Option(
            help="Processes that load clips. Default: 0 on a CPU; with a GPU 4, or as many as there are CPUs."
        ),
    ] = None,
    seed: Seed = 0,
    device: Device = "auto",
    force: Force = False,
) -> None:
    """Train both streams: static, then dynamic on the frozen static weights. Running again continues a stopped run.

    Several GPUs or machines: torchrun --nproc-per-node N -m dpcli classify train ...; the batch is shared among them.
    """
    network = {
        "num_frames": frames,
        "points_per_frame": points,
        "normalize": normalize,
        "grouping": grouping,
        "solver": solver,
        "group_size": group_size,
        "reduction": reduction,
        "temporal_radius": temporal_radius,
        "static_temporal_radius": static_temporal_radius,
        "dropout": dropout,
        "radii": None if radius is None else (radius, 2 * radius),
        "centroids": centroids,
        "neighbors": neighbors,
        "normals": False if no_normals else None,
        "weighting": "none" if no_weights or no_normals else None,
    }
    schedule = {
        "batch": batch,
        "learning_rate": lr,
        "learning_rate_dynamic": lr_dynamic,
        "decay": decay,
        "workers": workers,
        "clips_per_video": clips_per_video,
        "epochs": (epochs, epochs_dynamic),
        "accumulate": accumulate,
        "amp": amp,
        "label_smoothing": label_smoothing,
        "draws": draws or None,
    }
    from dpcli.classify.commands.train import run_training

    run_training(
        data,
        output,
        preset=preset,
        backbone=backbone,
        variant=variant,
        network=network,
        schedule=schedule,
        augment=augment,
        timing=timing,
        drop_short=drop_short,
        validation=validation,
        static_from=static_from,
        init=init,
        pretrain=pretrain,
        seed=seed,
        device=device,
        force=force,
    )


@app.command()
def predict(
    data: Annotated[str, typer.Argument(help="A clouds file, or - for a pipe.")],
    model: Annotated[
        str, typer.Option("--model", help="A .safetensors file, a folder made by train, or a shipped model's name.")
    ],
    output: Annotated[
        str | None,
        typer.Option("-o", "--output", help="File to write, or - for a pipe. With --stream: may be left out."),
    ] = None,
    backbone: TrustedBackbone = None,
    split: Split = "auto",
    clips_per_video: Annotated[int, typer.Option(help="Clips spread evenly over a video; 0 takes every start.")] = 0,
    drop_short: Annotated[
        bool, typer.Option("--drop-short", help="Leave out videos shorter than a clip instead of padding.")
    ] = False,
    batch: Annotated[int, typer.Option(help="Clips at a time.")] = 8,
    stream: classify_stream.Stream = False,
    hop: classify_stream.Hop = None,
    window: classify_stream.Window = None,
    follow: classify_stream.Follow = None,
    seed: Seed = 0,
    device: Device = "auto",
    json_output: classify_stream.JsonLines = False,
    force: Force = False,
) -> None:
    """Class scores of every video: softmax averaged over its clips, for each stream and fused."""
    if stream:
        refused = {
            "split": split != "auto",
            "clips-per-video": clips_per_video != 0,
            "drop-short": drop_short,
            "batch": batch != 8,
        }
        classify_stream.predict_stream(
            data,
            model,
            output,
            refused=refused,
            hop=hop,
            window=window,
            follow=follow,
            seed=seed,
            device=device,
            force=force,
            json_output=json_output,
            backbone=backbone,
        )
        return
    classify_stream.require_stream(hop=hop, window=window, follow=follow, json=json_output)
    if output is None:
        raise UsageError("Missing option '-o' / '--output'.")
    if batch < 1 or clips_per_video < 0:
        raise UsageError("--batch must be at least 1 and --clips-per-video at least 0")
    from dpcli.classify.commands.predict import run_prediction

    run_prediction(
        data,
        model,
        output,
        split=split,
        clips_per_video=clips_per_video or None,
        drop_short=drop_short,
        batch=batch,
        seed=seed,
        device=device,
        force=force,
        backbone=backbone,
    )


@app.command()
def fuse(
    scores: Annotated[
        list[str],
        typer.Argument(
            help="Scores files of the same videos, or one, whose streams are averaged anew; one may be - for a pipe."
        ),
    ],
    output: Output,
    weights: Annotated[
        str | None,
        typer.Option(
            "--weights",
            help="One per file, with commas, as 0.7,0.3; or by name, as static=0.3,dynamic=0.7. Default: all alike.",
        ),
    ] = None,
    weights_from: Annotated[
        str | None,
        typer.Option(
            "--weights-from",
            help="Scores of other, labeled videos by the same models, as many files as are fused, with "
            "commas between: the weights that suit them best (greatest likelihood).",
        ),
    ] = None,
    mean: Annotated[
        str, typer.Option(help="arithmetic (thesis), or geometric: mean of logits, as in the published code.")
    ] = "arithmetic",
    force: Force = False,
) -> None:
    """Average the scores of several models, such as one on points and one on flow; each stays as a stream of its own."""
    from dpcli.classify.commands.fuse import run_fusion

    run_fusion(scores, output, weights=weights, weights_from=weights_from, mean=mean, force=force)


@app.command()
def profile(
    model: Annotated[
        str | None, typer.Option("--model", help="A trained model; else an untrained one of --preset.")
    ] = None,
    preset: Annotated[str, typer.Option(help="thesis, release, quick or tiny.")] = "thesis",
    backbone: Annotated[
        str | None, typer.Option(help="pointnet2 (default), dgcnn, spidercnn or your own as module:Class.")
    ] = None,
    variant: Annotated[str | None, typer.Option(help="thesis or release.")] = None,
    classes: Annotated[int, typer.Option("--classes", help="Number of classes.")] = 20,
    frames: Annotated[int | None, typer.Option(help="Frames per clip. Default: the preset's.")] = None,
    points: Annotated[int | None, typer.Option(help="Points per frame. Default: the preset's.")] = None,
    steps: Annotated[
        bool, typer.Option("--steps", help="Also clips/s of training and inference, and where the time goes.")
    ] = False,
    device: Device = "auto",
    json_output: Json = False,
) -> None:
    """Parameters and operations (true counts, the papers' beside), latency and peak memory."""
    from dpcli.classify.commands.predict import run_profile

    run_profile(
        model,
        preset=preset,
        variant=variant,
        classes=classes,
        frames=frames,
        points=points,
        steps=steps,
        device=device,
        json_output=json_output,
        backbone=backbone,
    )
