"""`dpc evaluate`: metrics of predictions against the truth. This module only gathers the commands."""

from __future__ import annotations

import typer

from dpcli.cli.evaluate.classification import classification
from dpcli.cli.evaluate.compare import compare
from dpcli.cli.evaluate.joints import joints
from dpcli.cli.evaluate.motion import motion
from dpcli.cli.evaluate.report import report
from dpcli.cli.evaluate.runs import runs
from dpcli.cli.evaluate.segmentation import segmentation
from dpcli.cli.evaluate.segments import segments
from dpcli.cli.evaluate.video import video
from dpcli.cli.evaluate.weights import app as weights
from dpcli.cli.help_groups import SectionedGroup

SECTIONS = {
    "One prediction against the truth": (classification, segments, segmentation, motion, joints, video),
    "Several predictions or results": (compare, runs, report),
}  # heading in `dpc evaluate --help` -> its commands

app = typer.Typer(no_args_is_help=True, cls=SectionedGroup)
for _heading, _commands in SECTIONS.items():
    for _command in _commands:
        app.command(rich_help_panel=_heading)(_command)
app.add_typer(weights, name="weights", rich_help_panel="Networks of the learned metrics")
