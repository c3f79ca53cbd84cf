"""`dpc classify`: lists its commands."""

from __future__ import annotations

from dpcli.cli.command_table import Group

EXPLAIN = Group(
    "dpcli.cli.classify",
    {"": ("explain:pac", "explain:tsne")},
    about="Look into a model: activations of points (pac), maps of videos (tsne).",
)
ROOM = Group("dpcli.cli.classify", {"": ("train", "predict", "baseline", "fuse", "profile")}, {"explain": EXPLAIN})
