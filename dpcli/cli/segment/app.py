"""`dpc segment`: train, flow, estimate-flow, predict, joints, profile. Each command has a module of its own."""

from __future__ import annotations

import typer

from dpcli.cli.segment.estimate_flow import estimate_flow
from dpcli.cli.segment.flow import flow
from dpcli.cli.segment.joints import joints
from dpcli.cli.segment.predict import predict
from dpcli.cli.segment.profile import profile
from dpcli.cli.segment.train import train

app = typer.Typer(no_args_is_help=True)
app.command()(train)
app.command()(predict)
app.command()(joints)
app.command()(flow)
app.command("estimate-flow")(estimate_flow)
app.command()(profile)
