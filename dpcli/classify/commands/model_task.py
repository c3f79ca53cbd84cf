"""The task of a command that applies a trained model: its options, its record of the model, its messages about videos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dpcli.classify.data.clips import ClipSource
from dpcli.classify.data.likeness import tell_unlike_file
from dpcli.classify.data.videos import report_backward, report_gaps, report_short
from dpcli.classify.network.model_file import ModelInfo, find_model
from dpcli.runtime import provenance
from dpcli.store import CloudsReader


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

    def model_record(self, info: ModelInfo) -> dict[str, Any]:
        """Returns what the provenance of an output says of the model."""
        return {"model": info.notes, "weights": provenance.file_digest(find_model(self.model))}

    def clips(
        self, reader: CloudsReader, sequences: list[int], info: ModelInfo, *, drop_short: bool = False
    ) -> ClipSource:
        """Returns the clips of some videos as the model takes them; messages tell what is odd about these videos."""
        options = {"timing": info.timing, "drop_short": drop_short, "seed": self.seed}
        source = ClipSource(reader, sequences, info.config, **options)
        report_short(source)
        report_backward(reader, source.sequences)
        report_gaps(reader, source.sequences)
        tell_unlike_file(reader, source.sequences, info, self.model)
        return source
