"""The checks that both explanations make before they work: of the streams asked for, and of the files to write."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dpcli.classify.network.model_file import ModelInfo
from dpcli.errors import UsageError
from dpcli.runtime.whole_file import check_target, refuse_existing


def chosen_streams(text: str | None, info: ModelInfo) -> tuple[str, ...]:
    """Returns the streams that a text names, each once; without a text those that were trained. Raises UsageError on others."""
    possible = (*info.streams, "fused") if len(info.streams) > 1 else info.streams
    if text is None:
        return info.streams
    chosen = tuple(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))
    if not chosen or not set(chosen) <= set(possible):
        raise UsageError(
            f"--stream {text}: this model has {', '.join(possible)}; name one or more, with commas between"
        )
    return chosen


def check_targets(output: str, force: bool, *pictures: tuple[Path | None, str, Sequence[str]]) -> None:
    """Raises UsageError before the work for all that would fail after it: pictures of an unknown kind, an output that exists.

    pictures: file, option and legal suffixes of each.
    """
    for path, option, kinds in pictures:
        if path is not None:
            check_target(path, option, kinds)
    if output != "-":
        refuse_existing(output, force)
