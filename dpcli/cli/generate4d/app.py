"""`dpc generate4d`: fit, render, export, view, train-prior."""

from __future__ import annotations

import typer

from dpcli.cli.generate4d.export import export
from dpcli.cli.generate4d.fit import fit
from dpcli.cli.generate4d.render import render
from dpcli.cli.generate4d.train_prior import train_prior
from dpcli.cli.generate4d.view import view

app = typer.Typer(no_args_is_help=True)
for command in (fit, render, export, view, train_prior):
    app.command()(command)
