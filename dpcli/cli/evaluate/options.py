"""Options that several commands of `dpc evaluate` take, each written once."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dpcli.cli.options import Force, Json, Picture, Seed, completion
from dpcli.cli.spread_options import SpreadOptions
from dpcli.errors import UsageError
from dpcli.evaluate.choices import PARTS_PROTOCOLS

if TYPE_CHECKING:
    from dpcli.evaluate.bootstrap import Resampling
    from dpcli.evaluate.segmentation.sequence_pass import Keeping


def word_option(option: str, words: Sequence[str], help: str) -> Any:
    """Returns an option that takes one of some words, which `--help` lists; another word ends with the nearest legal one."""
    return typer.Option(
        option,
        parser=_word_parser(option, words),
        metavar=f"[{'|'.join(words)}]",
        help=help,
        autocompletion=completion(words),
    )


def _word_parser(option: str, words: Sequence[str]) -> Callable[[str], str]:
    def read(text: str) -> str:
        if text in words:
            return text
        near = difflib.get_close_matches(text, words, 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise UsageError(f"{option} {text}: expected {', '.join(words[:-1])} or {words[-1]}{hint}")

    return read


Parts = Annotated[
    str,
    typer.Argument(help="Parts file that `dpc segment predict` wrote, or - for a pipe; or statistics kept with -o."),
]
PartsTruth = Annotated[
    Path | None,
    typer.Option("--truth", help="Clouds file with the true parts, and with poses or scene flow for the true motion."),
]
Split = Annotated[
    str | None,
    typer.Option(
        "--split",
        help="Evaluate this split only, such as test or train, or all samples. Default: test where there is one, else all.",
    ),
]
PartsProtocol = Annotated[
    str,
    word_option(
        "--protocol",
        PARTS_PROTOCOLS,
        "How to count: dpc, or release, which repeats the published code, mistakes included.",
    ),
]
IgnoreBelow = Annotated[
    int,
    typer.Option("--ignore-below", min=0, help="Ignore true parts of fewer points than this, and predictions on them."),
]
Intersect = Annotated[
    bool,
    typer.Option(
        "--intersect", help="Compare what both sides have and list the rest, instead of ending with an error."
    ),
]
Confidence = Annotated[float, typer.Option("--confidence", help="Confidence level of the intervals, between 0 and 1.")]


@dataclass(frozen=True)
class IntervalOptions:
    """Says how bootstrap intervals are found."""

    confidence: Confidence = 0.95
    resamples: Annotated[
        int,
        typer.Option(
            "--resamples",
            min=0,
            max=1_000_000,
            help="Bootstrap resamples for the intervals, 100 or more; 0: no intervals.",
        ),
    ] = 2000
    seed: Seed = 0

    @property
    def resampling(self) -> Resampling:
        """Returns the settings of the bootstrap. Raises UsageError where they make no interval."""
        from dpcli.evaluate.bootstrap import Resampling

        return Resampling(self.resamples, self.confidence, self.seed)


@dataclass(frozen=True)
class KeepOptions:
    """Says where what was counted of each sequence is kept."""

    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            help="Keep each sequence's statistics in this file, so that a stopped run continues and shards can be merged.",
        ),
    ] = None
    force: Force = False

    def keeping(self, spread: SpreadOptions) -> Keeping:
        """Returns the choice as the commands take it. Raises UsageError for a shard without a file."""
        from dpcli.evaluate.segmentation.sequence_pass import Keeping

        return Keeping(self.output, spread.spread, self.force)


@dataclass(frozen=True)
class FormOptions:
    """Says in which form a result is printed. Raises UsageError for two forms at once."""

    as_markdown: Annotated[bool, typer.Option("--markdown", help="Print the tables as markdown.")] = False
    as_object: Json = False

    def __post_init__(self) -> None:
        if self.as_object and self.as_markdown:
            raise UsageError("--json and --markdown: choose one form of output")


@dataclass(frozen=True)
class PictureOptions(FormOptions):
    """Says in which form a result is printed, and where its picture goes. Raises before the work where it can't be written."""

    picture: Picture = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.picture is not None:
            from dpcli.runtime.whole_file import FIGURES, check_target

            check_target(self.picture, "--picture", FIGURES)
