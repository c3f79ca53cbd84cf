"""Leads from a clip to a `views` file: pictures are made and written one after the other."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.runtime.progress import Progress
from dpcli.runtime.provenance import file_digest, record
from dpcli.runtime.signals import stop_requested
from dpcli.store.views import ViewsHeader, ViewsReader, ViewsWriter
from dpcli.store.writing.already_made import already_made


@dataclass
class Clip:
    """Holds the header of a clip, and a function that yields (view, frame, rgba) of every picture.

    rgba: u8 (H,W,4), straight alpha. track, part: ground truth as ViewsWriter takes it.
    """

    header: ViewsHeader
    pictures: Callable[[], Iterator[tuple[int, int, np.ndarray]]]
    track: np.ndarray | None = None
    part: np.ndarray | None = None


def convert_clip(
    make_clip: Callable[[], Clip],
    output: Path,
    *,
    config: dict[str, Any],
    source: str,
    task: str,
    seed: int = 0,
    force: bool = False,
) -> ViewsHeader:
    """Writes a clip to `output` and returns its header; a finished file of the same configuration is left as it is.

    config: everything that decides the content, digests of the inputs among them. Raises UsageError when `output` was
    made another way and `force` is off; Stopped after a stop signal (a clip is short, so a part of one isn't kept).
    """
    provenance = record({"reader": source, **config}, seed)
    if not force and already_made(output, provenance, ViewsReader):
        with ViewsReader(output) as reader:
            return reader.header
    clip = make_clip()
    header = clip.header
    with (
        stop_requested() as stop,
        ViewsWriter(
            output,
            header,
            seed=seed,
            source=source,
            provenance=provenance,
            track=clip.track,
            part=clip.part,
            force=force,
        ) as writer,
        Progress(task, total=header.num_views * header.num_frames, unit="picture") as bar,
    ):
        for view, frame, rgba in clip.pictures():
            writer.add(view, frame, rgba)
            bar.advance()
            stop.check("the unfinished file was removed", again="to start over")
    return header


def digest_of(paths: Iterable[Path]) -> str:
    """Returns one short digest of many files' bytes, in their order; one that can't be opened counts as it is named.

    Whoever reads it says what is wrong with it, or leaves it out.
    """
    digest = hashlib.sha256()
    for path in paths:
        try:
            digest.update(file_digest(path).encode())
        except (OSError, DataError):
            digest.update(path.name.encode(errors="surrogateescape"))
    return digest.hexdigest()[:16]
