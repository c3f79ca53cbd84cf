"""`dpc evaluate`: gathers the commands, each of a module of its own."""

from __future__ import annotations

import typer

from dpcli.cli.evaluate.classification import classification
from dpcli.cli.evaluate.compare import compare
from dpcli.cli.evaluate.motion import motion
from dpcli.cli.evaluate.report import report
from dpcli.cli.evaluate.runs import runs
from dpcli.cli.evaluate.segmentation import segmentation
from dpcli.cli.evaluate.video import video
from dpcli.cli.evaluate.weights import app as weights

app = typer.Typer(no_args_is_help=True)
for _command in (classification, segmentation, motion, video, compare, runs, report):
    app.command()(_command)
app.add_typer(weights, name="weights")
