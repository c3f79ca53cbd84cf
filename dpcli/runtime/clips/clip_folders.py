"""Folders of clips where one clip is wanted: the clips are listed, with the way to take them all."""

from __future__ import annotations

import shlex
from pathlib import Path

from dpcli.errors import DataError
from dpcli.runtime.clips.video_frames import VIDEO_SUFFIXES

_LISTED = 6  # files at most in a message


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
        f"{folder}: {count}, one clip is wanted: {listed(names)}\n"
        f"Name one of them: {folder / names[0]}; or {take_all}: for clip in {patterns}; do {command}; done"
    )


def listed(names: list[str]) -> str:
    """Returns the first names of many, with a word on the others.

    >>> listed(["a.mp4", "b.mp4"])
    'a.mp4, b.mp4'
    """
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return f"{', '.join(names[:_LISTED])}{more}"
