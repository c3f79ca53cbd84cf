"""`dpc prepare`: raw data of many kinds into one kind of file. This module only gathers the commands."""

from __future__ import annotations

import typer

from dpcli.cli.help_groups import SectionedGroup
from dpcli.cli.option_groups import with_option_groups
from dpcli.cli.prepare.actions.depth import depth
from dpcli.cli.prepare.actions.msraction3d import msraction3d
from dpcli.cli.prepare.actions.ntu60 import ntu60
from dpcli.cli.prepare.actions.nvgesture import nvgesture
from dpcli.cli.prepare.actions.preprocessed import preprocessed
from dpcli.cli.prepare.actions.shrec17 import shrec17
from dpcli.cli.prepare.articulated.mbs import mbs
from dpcli.cli.prepare.articulated.ogc import ogc_dr, ogc_drsv
from dpcli.cli.prepare.articulated.sapien import sapien
from dpcli.cli.prepare.files.merge import merge
from dpcli.cli.prepare.files.split import split
from dpcli.cli.prepare.scans.clouds import clouds
from dpcli.cli.prepare.scans.kitti_det import kitti_det
from dpcli.cli.prepare.scans.kitti_sf import kitti_sf
from dpcli.cli.prepare.scans.modelnet40 import modelnet40
from dpcli.cli.prepare.scans.semantickitti import semantickitti
from dpcli.cli.prepare.synthetic.animal import animal
from dpcli.cli.prepare.synthetic.articulated import articulated
from dpcli.cli.prepare.synthetic.gestures import gestures
from dpcli.cli.prepare.synthetic.streets import streets
from dpcli.cli.prepare.views.animation import animation
from dpcli.cli.prepare.views.artemis import artemis
from dpcli.cli.prepare.views.video import video

SECTIONS = {
    "Actions and gestures, to clouds": (depth, msraction3d, nvgesture, shrec17, ntu60, preprocessed),
    "Scans and shapes, to clouds": (clouds, kitti_sf, kitti_det, semantickitti, modelnet40),
    "Articulated objects, to clouds with parts": (sapien, mbs, ogc_dr, ogc_drsv),
    "One object filmed, to views": (video, animation, artemis),
    "Files of clouds": (merge, split),
}  # heading in `dpc prepare --help` -> its commands
MADE = (gestures, articulated, streets, animal)

app = typer.Typer(no_args_is_help=True, cls=SectionedGroup)
synthetic = typer.Typer(no_args_is_help=True, cls=SectionedGroup)
for heading, commands in SECTIONS.items():
    for command in commands:
        app.command(rich_help_panel=heading)(with_option_groups(command))
for command in MADE:
    synthetic.command()(with_option_groups(command))
app.add_typer(
    synthetic,
    name="synthetic",
    help="Make data from nothing but a seed, with ground truth: gestures, articulated objects, streets, an animal.",
    rich_help_panel="Synthetic data",
)
