"""`dpc evaluate`: metrics of predictions against the truth. This module only lists the commands."""

from __future__ import annotations

from dpcli.cli.command_table import Group

WEIGHTS = Group(
    "dpcli.cli.evaluate",
    {"": ("weights:list_command", "weights:check_command", "weights:fetch_command")},
    heading="Networks of the learned metrics",
    about="List, check and fetch the weights of the networks that learned metrics need.",
)
ROOM = Group(
    "dpcli.cli.evaluate",
    {
        "One prediction against the truth": ("classification", "segments", "segmentation", "motion", "joints", "video"),
        "Several predictions or results": ("compare", "runs", "report"),
    },
    {"weights": WEIGHTS},
)
