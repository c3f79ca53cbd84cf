"""NTU RGB+D 60 (Shahroudy et al. 2016): 60 actions in masked Kinect v2 depth, in folders or in the official ZIPs."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.prepare.decode import zip_folders
from dpcli.prepare.decode.calibration import read_calibration
from dpcli.prepare.decode.folder_listing import folder_files, is_folder, leads_out
from dpcli.prepare.decode.pinhole_camera import Intrinsics, back_project
from dpcli.prepare.decode.png import decode_depth_png
from dpcli.prepare.reader import Item, Reader, Sample, require_known, sample_of_frames
from dpcli.prepare.series import is_hidden

CLASS_NAMES = (
    "drink water",
    "eat meal",
    "brush teeth",
    "brush hair",
    "drop",
    "pick up",
    "throw",
    "sit down",
    "stand up",
    "clapping",
    "reading",
    "writing",
    "tear up paper",
    "put on jacket",
    "take off jacket",
    "put on a shoe",
    "take off a shoe",
    "put on glasses",
    "take off glasses",
    "put on a hat",
    "take off a hat",
    "cheer up",
    "hand waving",
    "kicking something",
    "reach into pocket",
    "hopping",
    "jump up",
    "phone call",
    "play with phone",
    "type on a keyboard",
    "point to something",
    "taking a selfie",
    "check time",
    "rub two hands",
    "nod head",
    "shake head",
    "wipe face",
    "salute",
    "put palms together",
    "cross hands in front",
    "sneeze or cough",
    "staggering",
    "falling down",
    "headache",
    "chest pain",
    "back pain",
    "neck pain",
    "nausea",
    "fan self",
    "punch",
    "kick other",
    "push other",
    "pat on back",
    "point finger",
    "hugging",
    "give object",
    "touch pocket",
    "shaking hands",
    "walk toward",
    "walk apart",
)
NAME = re.compile(r"S(\d{3})C(\d{3})P(\d{3})R(\d{3})A(\d{3})")
FRAME = re.compile(r"MDepth-(\d{8})\.png", re.IGNORECASE)
WIDTH, HEIGHT, FPS = 512, 424, 30.0
TRAIN_SUBJECTS = (1, 2, 4, 5, 8, 9, 13, 14, 15, 16, 17, 18, 19, 25, 27, 28, 31, 34, 35, 38)
TRAIN_CAMERAS = (2, 3)
PUBLISHED = {"xsub": {"train": 40320, "test": 16560}, "xview": {"train": 37920, "test": 18960}}
VIDEOS = 56880
# what the point-cloud papers use (PSTNet and its followers), and the calibration that 3DV gives for the Kinect v2
INTRINSICS = {
    "peers": Intrinsics(280.0, 280.0, WIDTH / 2, HEIGHT / 2),
    "kinect2": Intrinsics(365.481, 365.481, 257.346, 210.347),
}
_RANGES = {"setup": (1, 17), "camera": (1, 3), "person": (1, 40), "repetition": (1, 2), "action": (1, 60)}


def named_intrinsics(text: str) -> Intrinsics:
    """Returns the intrinsics called ``peers`` or ``kinect2``, or those of a JSON file with fx fy cx cy."""
    if text in INTRINSICS:
        return INTRINSICS[text]
    if not Path(text).suffix:
        raise UsageError(f"--intrinsics {text}: expected {', '.join(INTRINSICS)} or a .json with fx fy cx cy")
    return read_calibration(Path(text)).of_pictures(WIDTH, HEIGHT)


def cross_subject_split(subject: int) -> str:
    """Returns ``train`` or ``test`` of a video under the cross-subject protocol (xsub): 20 of the 40 subjects train.

    >>> cross_subject_split(1), cross_subject_split(3)
    ('train', 'test')
    """
    return "train" if subject in TRAIN_SUBJECTS else "test"


def cross_view_split(camera: int) -> str:
    """Returns ``train`` or ``test`` of a video under the cross-view protocol (xview): cameras 2 and 3 train.

    >>> [cross_view_split(camera) for camera in (1, 2, 3)]
    ['test', 'train', 'train']
    """
    return "train" if camera in TRAIN_CAMERAS else "test"


def video_item(name: str, path: Path, protocol: str, **extra: Any) -> Item:
    """Returns the item of a video called SsssCcccPpppRrrrAaaa; a number out of range becomes its problem."""
    numbers = [int(v) for v in NAME.fullmatch(name).groups()]
    wrong = [
        f"{what} {number} in the name is out of range; NTU RGB+D 60 has {low} to {high}"
        for (what, (low, high)), number in zip(_RANGES.items(), numbers, strict=True)
        if not low <= number <= high
    ]
    _, camera, subject, _, action = numbers
    return Item(
        name,
        path,
        split=cross_subject_split(subject) if protocol == "xsub" else cross_view_split(camera),
        label=action - 1,
        subject=subject,
        camera=camera,
        extra=extra,
        problem=f"{path}: {wrong[0]}" if wrong else "",
    )


@dataclass(frozen=True)
class NTU60(Reader):
    """Reads NTU RGB+D 60; defaults are the published point-cloud preprocessing. ``scale``: mm per unit of length."""

    inputs: tuple[Path, ...]
    protocol: str = "xsub"
    intrinsics: Intrinsics = INTRINSICS["peers"]
    scale: float = 655.35
    class_names: ClassVar[tuple[str, ...]] = CLASS_NAMES
    fields: ClassVar[tuple[str, ...]] = ("time",)

    def __post_init__(self) -> None:
        require_known(self, protocol=PUBLISHED)
        if not self.scale > 0:
            raise UsageError(f"--scale {self.scale:g}: expected millimeters per unit of length, more than 0")

    @property
    def length_unit(self) -> str:
        return {1.0: "mm", 1000.0: "m"}.get(self.scale, f"{self.scale:g} mm")

    def items(self) -> list[Item]:
        found: dict[str, Item] = {}
        for given in self.inputs:
            for item in self._search(given):
                first = found.get(item.name)
                if first:
                    problem = item.problem or f"{item.path}: is there twice; {first.path} is read"
                    item = Item(f"{item.name} ({item.path})", item.path, item.split, problem=problem)
                found[item.name] = item
        if not any(not item.problem for item in found.values()):
            reason = next((f"; {item.problem}" for item in found.values()), "")
            names = ", ".join(str(path) for path in self.inputs)
            raise DataError(f"{names}: no masked depth videos, folders or ZIPs of SsssCcccPpppRrrrAaaa{reason}")
        return [found[name] for name in sorted(found)]

    def _search(self, given: Path) -> Iterator[Item]:
        if given.is_dir():
            if NAME.fullmatch(given.name):
                yield video_item(given.name, given, self.protocol, root=given)
            else:
                yield from self._folder(given, given)
        elif given.is_file():
            yield from self._archive(given)
        else:
            raise DataError(f"{given}: does not exist; expected a folder of nturgb+d_depth_masked, or its ZIPs")

    def _folder(self, folder: Path, root: Path) -> Iterator[Item]:
        """Yields the videos below a folder, without a look into them: 56,880 folders take a second, their frames
        minutes.
        """
        with os.scandir(folder) as entries:
            ordered = sorted((one for one in entries if not is_hidden(one.name)), key=lambda entry: entry.name)
        strange = ""
        for entry in ordered:
            path = Path(entry.path)
            is_zip = entry.name.lower().endswith(".zip")
            if entry.is_symlink() and (is_folder(entry) or is_zip):
                yield self._link(path, root)
            elif is_folder(entry):
                if NAME.fullmatch(entry.name):
                    yield video_item(entry.name, path, self.protocol, root=root)
                else:
                    yield from self._folder(path, root)
            elif is_zip:
                yield from self._archive(path)
            elif not strange and FRAME.fullmatch(entry.name):
                strange = entry.name
        if strange:
            yield Item(str(folder), folder, problem=_strange_name(folder, strange))

    def _link(self, path: Path, root: Path) -> Item:
        target = leads_out(path, root)
        reason = (
            f"leads out of the data, to {target}; name that as another input" if target else "is read at its target"
        )
        return Item(str(path), path, problem=f"{path}: a link, {reason}")

    def _archive(self, path: Path) -> Iterator[Item]:
        try:
            folders = zip_folders.list_folders(path)
        except (DataError, OSError) as error:
            yield Item(str(path), path, problem=str(error))
            return
        videos = {name: files for name, files in folders.items() if NAME.fullmatch(name.rpartition("/")[2])}
        for name, files in videos.items():
            yield video_item(name.rpartition("/")[2], path, self.protocol, entries=files)
        if not videos:
            inside = ", ".join(sorted(folders)[:3])
            yield Item(
                str(path), path, problem=f"{path}: no folder SsssCcccPpppRrrrAaaa in it; found {inside or 'none'}"
            )
        for name in sorted(folders.keys() - videos.keys()) if videos else ():
            first = next((n for n in folders[name].names if FRAME.fullmatch(n)), "")
            if first:
                yield Item(f"{path}/{name}", path, problem=_strange_name(path / name, first))

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        where = item.path if "root" in item.extra else item.path / item.name
        frames, others = self._frames(item, where)
        numbers = np.array([number for number, _ in frames])
        if len(set(numbers)) < len(numbers):
            raise DataError(f"{where}: a frame occurs twice; expected one MDepth-00000001.png per number")
        clouds = []
        for number, data in frames:
            data = data.read_bytes() if isinstance(data, Path) else data
            depth = decode_depth_png(data, f"{where}/MDepth-{number:08}.png", (WIDTH, HEIGHT))
            clouds.append(back_project(depth[None], self.intrinsics)[0])
        counts = np.array([len(cloud) for cloud in clouds], np.int64)
        points = np.concatenate(clouds)
        points *= np.float32(1 / self.scale)
        notes = {
            "frames missing in the numbering from 1": int(numbers[-1] - np.count_nonzero(numbers)),
            "pictures left out, whose name is not MDepth-NUMBER.png": len(others),
        }
        return sample_of_frames(item, points, counts, notes, time=(numbers - numbers[0]) / FPS, where=where)

    def _frames(self, item: Item, where: Path) -> tuple[list[tuple[int, Path | bytes]], list[str]]:
        """Returns (number, file or content) of the frames of a video, sorted, and the names of other pictures beside them."""
        if "root" in item.extra:
            files: Iterator = folder_files(item.path, item.extra["root"], ".png")
        else:
            files = zip_folders.read_files(item.path, item.extra["entries"])
        frames, others = [], []
        for name, data in files:
            if match := FRAME.fullmatch(name):
                frames.append((int(match[1]), data))
            else:
                others.append(name)
        if not frames:
            found = f"found {others[-1]}; the masked depth maps are needed" if others else "it holds no pictures"
            raise DataError(f"{where}: no MDepth-00000001.png ...; {found}")
        return sorted(frames), others

    def summary(self, items: list[Item]) -> list[str]:
        good = [item for item in items if not item.problem]
        setups, splits = Counter(item.name[:4] for item in good), Counter(item.split for item in good)
        lines = [f"{len(good)} of the {VIDEOS} published videos found, {len(items) - len(good)} unusable"]
        lines.append(
            f"{self.protocol}: "
            + ", ".join(f"{split} {splits[split]}/{count}" for split, count in PUBLISHED[self.protocol].items())
        )
        if len(good) < VIDEOS:
            lines.append("by setup " + ", ".join(f"{setup}: {count}" for setup, count in sorted(setups.items())))
        return lines


def _strange_name(folder: Path, frame: str) -> str:
    return f"{folder}: holds {frame}, but is not called SsssCcccPpppRrrrAaaa, so its action is unknown"
