"""Indices of a clip or an ARTEMIS animal for `--check`: they find beyond the recipe what lacks, and open no picture
wholly.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.path_names import path_inside
from dpcli.prepare.decode.color_frames import Frames, image_size, open_frames
from dpcli.prepare.reader import Item, require_folder
from dpcli.prepare.views.artemis_files import Motion, declared_frames, find_motion, read_rig
from dpcli.prepare.views.transforms_json import is_transforms, transforms_config
from dpcli.prepare.views.video import VideoOptions, clip_name, find_given_views, find_masks, spread_frames, warn_gaps

_PICTURE = re.compile(r"img_(\d{4})(_alpha)?\.(jpg|png)")


@dataclass(frozen=True)
class ArtemisIndex:
    """Lists the motions of an animal, or only `motion`, each with what it lacks."""

    animal: Path
    motion: str = ""

    def items(self) -> list[Item]:
        """Returns one item a motion that is there or in the file `sequences`.

        Raises DataError when cameras are unknown.
        """
        cameras = len(read_rig(self.animal).poses)
        images, declared = require_folder(self.animal / "img", "MOTION/FRAME/"), declared_frames(self.animal)
        there = {path.name for path in images.iterdir() if path.is_dir()}
        names = [self.motion] if self.motion else sorted(there | declared.keys())
        return [
            Item(name, images / name, problem=self._problem(name, declared.get(name, 0), cameras)) for name in names
        ]

    def summary(self, items: list[Item]) -> list[str]:
        """Returns lines for the log about what the index holds and lacks."""
        return []

    def _problem(self, name: str, declared: int, cameras: int) -> str:
        try:
            folder = path_inside(self.animal / "img", self.animal / "img", name)
        except DataError as error:
            return f"{self.animal / 'sequences'}: {error}"
        if not folder.is_dir():
            return f"img/{name}: missing" + (f"; sequences gives it {counted(declared, 'frame')}" if declared else "")
        try:
            motion = find_motion(self.animal, name)
        except DataError as error:
            return str(error)
        count = len(motion.folders)
        faults = [f"{count} of the {declared} frames are there"] if count < declared else []
        lacking = [*_lacking_pictures(motion, cameras), *self._lacking_bones(motion)]
        if lacking:
            faults.append(f"{counted(len(lacking), 'file')} missing, the first: {lacking[0]}")
        return "; ".join(faults)

    def _lacking_bones(self, motion: Motion) -> Iterator[str]:
        """Yields the files of bones that are missing. An animal may lack the whole folder bones/, and has no true tracks
        then; it may not have some of them alone.
        """
        if (self.animal / "bones").is_dir():
            for frame in motion.folders:
                name = f"bones/{motion.name}/Bones_{frame:04d}.inf"
                if not (self.animal / name).is_file():
                    yield name


def _lacking_pictures(motion: Motion, cameras: int) -> Iterator[str]:
    """Yields the pictures and masks that a frame lacks of the cameras that any frame shows."""
    found = {frame: _pictures(folder) for frame, folder in motion.folders.items()}
    used = sorted({camera for own in found.values() for camera, _ in own if camera < cameras}) or range(cameras)
    for frame, own in found.items():
        for camera in used:
            for mask, ending in ((False, ".jpg"), (True, "_alpha.png")):
                if (camera, mask) not in own:
                    yield f"img/{motion.name}/{frame}/img_{camera:04d}{ending}"


def _pictures(folder: Path) -> set[tuple[int, bool]]:
    """Returns (camera, is it the mask) of each file; a folder listing instead of 72 questions."""
    matches = (_PICTURE.fullmatch(name) for name in os.listdir(folder))
    return {(int(one[1]), bool(one[2])) for one in matches if one and (one[2] is None or one[3] == "png")}


@dataclass(frozen=True)
class ClipIndex:
    """Lists the frames of a clip, and whether its masks and further views are there for them."""

    clip: Path
    options: VideoOptions

    def items(self) -> list[Item]:
        """Returns one item a frame; of pictures only the head is read.

        Raises DataError when masks or views lack frames.
        """
        if is_transforms(self.clip):
            transforms_config(self.clip, self.options, quiet=False)  # finds every picture that the lists name
            return [Item(clip_name(self.clip), self.clip)]
        frames = open_frames(self.clip, self.options.pattern)
        if self.options.mask:
            find_masks(frames, self.options.mask)
        find_given_views(frames, spread_frames(len(frames), self.options.frames), self.options)
        warn_gaps(frames)
        if not self.clip.is_dir():
            return [Item(name, self.clip) for name in frames.names]
        return list(_frame_items(frames))

    def summary(self, items: list[Item]) -> list[str]:
        """Returns lines for the log about what the index holds and lacks."""
        return []


def _frame_items(frames: Frames) -> Iterator[Item]:
    first: tuple[str, str] | None = None
    for name, path in zip(frames.names, frames.files, strict=True):
        try:
            size = "{}x{}".format(*image_size(path))
        except DataError:
            yield Item(name, path, problem="not a readable image; export this frame again")
            continue
        first = first or (name, size)
        same = size == first[1]
        yield Item(
            name, path, problem="" if same else f"{size}, {first[0]} is {first[1]}; export all frames at one size"
        )
