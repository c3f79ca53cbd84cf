"""`dpc prepare shrec17 | ntu60 | preprocessed | modelnet40`: gestures, actions and shapes to classify."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer


def register(app: typer.Typer, reads: Callable[..., Callable]) -> None:
    """Add the commands to `dpc prepare`; ``reads`` gives them the options that every reader shares."""
    reads(app)(shrec17)
    reads(app)(ntu60)
    reads(app)(preprocessed)
    reads(app)(modelnet40)


def shrec17(
    raw: Annotated[Path, typer.Argument(help="Folder of train_gestures.txt, test_gestures.txt and gesture_1/ ...")],
    labels: Annotated[int, typer.Option("--labels", help="28 (gesture and fingers) or 14 (gesture).")] = 28,
    bbox: Annotated[
        bool, typer.Option("--bbox/--no-bbox", help="Only the hand's region in general_informations.txt, or the frame.")
    ] = True,
    foreground: Annotated[
        str, typer.Option("--foreground", help="component (the largest one, as the peers) or none.")
    ] = "component",
    median: Annotated[int, typer.Option("--median", help="Side of the median blur, pixels: 3, 5, or 0 for none.")] = 3,
    close: Annotated[int, typer.Option("--close", min=0, help="Side of the closing, pixels; 0 for none.")] = 7,
    coordinates: Annotated[
        str, typer.Option("--coordinates", help="image: row, column, depth. camera: pinhole, mm.")
    ] = "image",
) -> Any:
    """SHREC'17 Track: 14 hand gestures, by one finger or the whole hand, 2,800 sequences of 28 subjects."""
    from dpcli.prepare.actions.shrec17 import Shrec17

    return Shrec17(raw, labels, bbox, foreground, median, close, coordinates)


def ntu60(
    inputs: Annotated[
        list[Path], typer.Argument(help="Folders of nturgb+d_depth_masked, or ZIPs as downloaded (read in place).")
    ],
    protocol: Annotated[
        str, typer.Option("--protocol", help="Which videos are split train: xsub (by subject) or xview (by camera).")
    ] = "xsub",
    intrinsics: Annotated[
        str, typer.Option("--intrinsics", help="peers (focal 280), kinect2, or a JSON with fx fy cx cy, pixels.")
    ] = "peers",
    scale: Annotated[
        float, typer.Option("--scale", help="Millimeters per unit of length in the output; 1000: meters.")
    ] = 655.35,
) -> Any:
    """NTU RGB+D 60: 60 actions in masked Kinect v2 depth, 56,880 videos of 40 subjects."""
    from dpcli.prepare.actions.ntu60 import NTU60, named_intrinsics

    return NTU60(tuple(inputs), protocol, named_intrinsics(intrinsics), scale)


def preprocessed(
    raw: Annotated[
        Path, typer.Argument(help="Folder of pts_label.npy, or of .npz by MeteorNet's or PSTNet's scripts.")
    ],
    form: Annotated[
        str, typer.Option("--form", help="auto, msraction3d or ntu60 (.npz per video), pts_label (gestures).")
    ] = "auto",
    labels: Annotated[int, typer.Option("--labels", help="Of SHREC'17: 28 or 14.")] = 28,
    lists: Annotated[
        Path | None, typer.Option("--lists", help="Folder of SHREC'17's two list files. Default: RAW.")
    ] = None,
    protocol: Annotated[str, typer.Option("--protocol", help="Of NTU: xsub or xview.")] = "xsub",
    scale: Annotated[
        float | None,
        typer.Option("--scale", help="Stored units per unit of length in the output. Default: the peers' loaders'."),
    ] = None,
) -> Any:
    """Clouds others have made: pts_label.npy (PointLSTM, Kinet), .npz (MeteorNet, PSTNet and its followers)."""
    from dpcli.prepare.actions.preprocessed import open_preprocessed

    return open_preprocessed(raw, form, labels, lists, protocol, scale)


def modelnet40(
    raw: Annotated[Path, typer.Argument(help="Folder modelnet40_ply_hdf5_2048: ply_data_train0.h5 ... and the lists.")],
) -> Any:
    """ModelNet40: 12,308 shapes of 40 kinds, one frame each, to pretrain a static stream with."""
    from dpcli.prepare.scans.modelnet40 import ModelNet40

    return ModelNet40(raw)
