"""The HDF5 contract: what a file holds, writing it whole, reading only what is needed, moving it through pipes.

`CloudsWriter` / `CloudsReader` for point cloud sequences, `PartsWriter` / `PartsReader` for what a segmenter says,
`ScoresWriter` / `ScoresReader` for what a classifier says, `ViewsWriter` / `ViewsReader` for an object in pictures,
`input_file` / `output_file` for paths and `-`. Nothing here knows where samples come from or what they are for.
Names resolve on first use: a process that only makes `CloudSequence`s needs no HDF5.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dpcli.store.file import file_kind
    from dpcli.store.parts import PartsReader, PartsSample, PartsWriter
    from dpcli.store.pipes import input_file, output_file
    from dpcli.store.reader import CloudsReader
    from dpcli.store.scores import ScoresReader, ScoresWriter
    from dpcli.store.sequence import CloudSequence
    from dpcli.store.views import ViewsHeader, ViewsReader, ViewsWriter
    from dpcli.store.writer import CloudsWriter

_HOME = {
    "file": ("file_kind",),
    "parts": ("PartsReader", "PartsSample", "PartsWriter"),
    "pipes": ("input_file", "output_file"),
    "reader": ("CloudsReader",),
    "scores": ("ScoresReader", "ScoresWriter"),
    "sequence": ("CloudSequence",),
    "views": ("ViewsHeader", "ViewsReader", "ViewsWriter"),
    "writer": ("CloudsWriter",),
}

__all__ = [
    "CloudSequence", "CloudsReader", "CloudsWriter", "PartsReader", "PartsSample", "PartsWriter", "ScoresReader", "ScoresWriter",
    "ViewsHeader", "ViewsReader", "ViewsWriter", "file_kind", "input_file", "output_file",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    for module, names in _HOME.items():
        if name in names:
            value = globals()[name] = getattr(import_module(f"{__name__}.{module}"), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
