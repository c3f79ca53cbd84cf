"""`dpc evaluate motion`."""

from __future__ import annotations

from dpcli.cli.evaluate.options import (
    Intersect,
    IntervalOptions,
    KeepOptions,
    Parts,
    PartsProtocol,
    PartsTruth,
    PictureOptions,
    Split,
)
from dpcli.cli.evaluate.output import print_result
from dpcli.cli.option_groups import with_option_groups
from dpcli.cli.spread_options import SpreadOptions


@with_option_groups
def motion(
    parts: Parts,
    truth: PartsTruth = None,
    *,
    protocol: PartsProtocol = "dpc",
    split: Split = None,
    intersect: Intersect = False,
    intervals: IntervalOptions,
    keep: KeepOptions,
    spread: SpreadOptions,
    form: PictureOptions,
) -> None:
    """Evaluate the motion in a parts file: end-point error (EPE3D), AccS, AccR, Outlier, and the errors of part motions."""
    from dpcli.evaluate.commands.motion import run_motion

    result = run_motion(
        parts,
        truth,
        protocol=protocol,
        split=split,
        intersect=intersect,
        resampling=intervals.resampling,
        picture=form.picture,
        keeping=keep.keeping(spread),
    )
    print_result(result, form)
