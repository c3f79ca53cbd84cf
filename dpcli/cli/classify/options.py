"""Options that several commands of `dpc classify` share."""

from __future__ import annotations

from typing import Annotated

import typer

Data = Annotated[str, typer.Argument(help="A clouds file, or - for a pipe.")]
Model = Annotated[
    str, typer.Option("--model", help="A .safetensors file, a folder made by train, or a shipped model's name.")
]
Split = Annotated[
    str,
    typer.Option(
        "--split",
        help="Which samples: a split's name, all, auto (test where there is one), or validation: the training videos that"
        " the model's training held out.",
    ),
]
Stream = Annotated[
    str | None,
    typer.Option(
        "--stream", help="One or more of static, dynamic, fused, with commas between. Default: those that were trained."
    ),
]
RejectBelow = Annotated[
    str | None,
    typer.Option(
        "--reject-below",
        help="Confidence below which nothing counts as recognized: a number, or auto, the model's own. Default: auto with --stream and"
        " --segments where the model has one; otherwise nothing is rejected.",
    ),
]
