"""`dpc prepare`: raw data of many kinds into one kind of file. This module only lists the commands."""

from __future__ import annotations

from dpcli.cli.command_table import Group

SYNTHETIC = Group(
    "dpcli.cli.prepare.synthetic",
    {"": ("gestures", "articulated", "streets", "animal")},
    heading="Synthetic data",
    about="Make data from nothing but a seed, with ground truth: gestures, articulated objects, streets, an animal.",
)
ROOM = Group(
    "dpcli.cli.prepare",
    {
        "Actions and gestures, to clouds": (
            "actions.depth",
            "actions.msraction3d",
            "actions.nvgesture",
            "actions.shrec17",
            "actions.ntu60",
            "actions.preprocessed",
        ),
        "Scans and shapes, to clouds": (
            "scans.clouds",
            "scans.kitti_sf",
            "scans.kitti_det",
            "scans.semantickitti",
            "scans.modelnet40",
        ),
        "Articulated objects, to clouds with parts": (
            "articulated.sapien",
            "articulated.mbs",
            "articulated.ogc:ogc_dr",
            "articulated.ogc:ogc_drsv",
        ),
        "One object filmed, to views": ("views.video", "views.animation", "views.artemis"),
        "Files of clouds": ("files.merge", "files.split"),
    },
    {"synthetic": SYNTHETIC},
)
