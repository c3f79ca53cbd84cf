"""`dpc segment`: lists its commands."""

from __future__ import annotations

from dpcli.cli.command_table import Group

ROOM = Group("dpcli.cli.segment", {"": ("train", "predict", "joints", "flow", "estimate_flow", "profile")})
