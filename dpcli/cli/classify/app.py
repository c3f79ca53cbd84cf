"""`dpc classify`: gathers its commands."""

from __future__ import annotations

import typer

from dpcli.cli.classify.baseline import baseline
from dpcli.cli.classify.explain import app as explain
from dpcli.cli.classify.fuse import fuse
from dpcli.cli.classify.predict import predict
from dpcli.cli.classify.profile import profile
from dpcli.cli.classify.train import train

app = typer.Typer(no_args_is_help=True)
for command in (train, predict, baseline, fuse, profile):
    app.command()(command)
app.add_typer(explain, name="explain")
