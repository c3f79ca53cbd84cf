"""The HDF5 contract: what a file holds, writing it whole, reading only what is needed, moving it through pipes.

`CloudsWriter` / `CloudsReader` for point cloud sequences, `PartsWriter` / `PartsReader` for the output of segmentation,
`ScoresWriter` / `ScoresReader` for the output of a classifier, `ViewsWriter` / `ViewsReader` for an object in pictures,
`input_file` / `output_file` for paths and `-`. Nothing here knows where samples come from or what they are for.
Names resolve on first use: a process that only makes `CloudSequence`s needs no HDF5.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOME = {
    "CloudSequence": "sequence",
    "CloudsReader": "clouds_reader",
    "CloudsWriter": "clouds_writer",
    "PartsReader": "parts",
    "PartsSample": "parts",
    "PartsWriter": "parts",
    "ScoresReader": "scores",
    "ScoresWriter": "scores",
    "ViewsHeader": "views",
    "ViewsReader": "views",
    "ViewsWriter": "views",
    "file_kind": "file",
    "input_file": "pipes",
    "output_file": "pipes",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    return value


def __dir__() -> list[str]:
    return __all__
