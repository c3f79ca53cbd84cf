"""`dpc generate4d`: lists its commands."""

from __future__ import annotations

from dpcli.cli.command_table import Group

ROOM = Group("dpcli.cli.generate4d", {"": ("fit", "render", "export", "view", "train_prior")})
