"""Options of the commands that evaluate several files in the same way: `dpc evaluate compare` and `dpc evaluate runs`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dpcli.cli.evaluate.options import IgnoreBelow, Split, word_option
from dpcli.evaluate.choices import ALL_PROTOCOLS, parse_metrics

if TYPE_CHECKING:
    from dpcli.evaluate.compare.file_metrics import EvaluationOptions


@dataclass(frozen=True)
class ComparisonOptions:
    """Says how each file is evaluated."""

    truth: Annotated[
        Path | None,
        typer.Option(
            "--truth", help="The truth: a clouds file for parts, a video or views file for videos and scenes."
        ),
    ] = None
    metrics: Annotated[
        str | None,
        typer.Option(
            "--metrics",
            metavar="NAME,...",
            help="Metrics to compare, such as accuracy or miou,ap,epe3d. Default: all that the files allow.",
        ),
    ] = None
    protocol: Annotated[
        str,
        word_option("--protocol", ALL_PROTOCOLS, "How to count: dpc or release for parts, any but release for videos."),
    ] = "dpc"
    ignore_below: IgnoreBelow = 0
    split: Split = None

    def options(self, *, intersect: bool = False) -> EvaluationOptions:
        """Returns the options as the comparison takes them. Raises UsageError where `--metrics` names none."""
        from dpcli.evaluate.compare.file_metrics import EvaluationOptions

        return EvaluationOptions(
            self.truth, parse_metrics(self.metrics), self.protocol, self.split, self.ignore_below, intersect
        )
