"""`dpc evaluate segmentation`."""

from __future__ import annotations

from dpcli.cli.evaluate.options import (
    IgnoreBelow,
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
def segmentation(
    parts: Parts,
    truth: PartsTruth = None,
    *,
    protocol: PartsProtocol = "dpc",
    ignore_below: IgnoreBelow = 0,
    split: Split = None,
    intersect: Intersect = False,
    intervals: IntervalOptions,
    keep: KeepOptions,
    spread: SpreadOptions,
    form: PictureOptions,
) -> None:
    """Evaluate the parts of a parts file: average precision, PQ, F1, precision and recall at IoU 0.5, mIoU, Rand index."""
    from dpcli.evaluate.commands.segmentation import run_segmentation

    result = run_segmentation(
        parts,
        truth,
        protocol=protocol,
        ignore_below=ignore_below,
        split=split,
        intersect=intersect,
        resampling=intervals.resampling,
        picture=form.picture,
        keeping=keep.keeping(spread),
    )
    print_result(result, form)
