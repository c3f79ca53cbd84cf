"""Options that several commands of `dpc segment` have."""

from __future__ import annotations

from typing import Annotated

import typer

TrainingData = Annotated[str, typer.Argument(help="A clouds file of sequences of two frames or more, or - for a pipe.")]
RunOutput = Annotated[
    str, typer.Option("-o", "--output", help="Folder for weights, checkpoints, logs, curves and settings.toml.")
]
