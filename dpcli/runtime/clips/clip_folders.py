"""Folders of clips where one clip is wanted: the clips are listed, with the way to take them all."""

from __future__ import annotations

import shlex
from pathlib import Path

from dpcli.errors import DataError
from dpcli.path_names import first_names
from dpcli.runtime.clips.video_frames import VIDEO_SUFFIXES


def clips_in(folder: Path) -> list[str]:
    """Returns the names of videos and animations directly in a folder, sorted."""
    suffixes = (*VIDEO_SUFFIXES, ".gif", ".apng")
    return sorted(path.name for path in folder.iterdir() if path.suffix.lower() in suffixes and path.name[0] != ".")


def refuse_clips(folder: Path, take_all: str, command: str) -> None:
    """Raises DataError that lists the clips in a folder and says how to take them all; none: nothing happens.

    take_all: what the command in a shell's loop over "$clip" does, in words.
    """
    names = clips_in(folder)
    if not names:
        return
    patterns = " ".join(f"{shlex.quote(str(folder))}/*{kind}" for kind in sorted({Path(name).suffix for name in names}))
    count = f"{len(names)} videos" if len(names) > 1 else "a video"
    raise DataError(
        f"{folder}: {count}, one clip is wanted: {first_names(names)}\n"
        f"Name one of them: {folder / names[0]}; or {take_all}: for clip in {patterns}; do {command}; done"
    )
