"""The options that every command that applies a trained model has."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ModelTask:
    """Names the data, the model and the output of a command, and how it computes.

    data: a file, or `-` for stdin. model: a file, a training folder or a shipped name. output: a file, `-` for stdout, or
    None where nothing is written. backbone: the user's own that the model may load. split: which samples.
    """

    data: str
    model: str
    output: str | None
    backbone: str | None = None
    split: str = "auto"
    seed: int = 0
    device: str = "auto"
    force: bool = False

    @property
    def source(self) -> str:
        """Returns the name of the data as files record it."""
        return "stdin" if self.data == "-" else Path(self.data).name
