"""`pts_label.npy`, the processed gestures of PointLSTM and Kinet: one integer array of clouds per gesture."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.npy_files import map_npy
from dpcli.prepare.actions import nvgesture
from dpcli.prepare.actions.shrec17_lists import (
    FINGERS,
    GESTURES,
    IMAGE_UNIT,
    Entry,
    ListFile,
    entries,
    find_lists,
    gesture_names,
)
from dpcli.prepare.decode.folder_listing import files_below, leads_out
from dpcli.prepare.reader import Item, Reader, Sample, natural_key, require_folder, require_known, sample_of_frames

FILE = "pts_label.npy"
_SHREC = re.compile(r"(?:.*/)?(gesture_(\d+)/finger_(\d+)/subject_(\d+)/essai_\d+)")
_NVGESTURE = re.compile(r"(?:.*/)?(class_(\d+)/subject(\d+)_r\d+)")


def read_array(path: Path) -> np.ndarray:
    """Reads the array (T,N,C) of a pts_label.npy, C >= 3: row, column, depth, then what isn't used. Raises DataError."""
    array = map_npy(path)
    if array.ndim != 3 or array.shape[2] < 3 or 0 in array.shape or array.dtype.kind not in "iuf":
        raise DataError(
            f"{path}: array of shape {array.shape}, {array.dtype}; expected numbers (frames, points, 8): "
            "row, column, depth, ..."
        )
    array = array[..., :3]
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise DataError(f"{path}: holds NaN or infinity; expected finite coordinates")
    return array


@dataclass(frozen=True)
class PtsLabel(Reader):
    """Reads pts_label.npy files in folders gesture_G/finger_F/subject_S/essai_E, or class_C/subjectS_rR.

    ``lists``: the folder of SHREC'17's train_gestures.txt and test_gestures.txt; by default they are looked for in
    ``raw``. Without lists there is no split, and the 28 labels are those of (gesture, finger) in their order.
    """

    raw: Path
    classes: int = 28
    lists: Path | None = None
    fields: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        require_known(self, classes=(14, 28))

    @property
    def class_names(self) -> list[str]:
        if self._is_nvgesture():
            return list(nvgesture.CLASS_NAMES)
        found = self._list_files()
        if found:
            return gesture_names(found, self.classes)
        return list(GESTURES) if self.classes == 14 else [f"{g}, {f}" for g in GESTURES for f in FINGERS]

    @property
    def length_unit(self) -> str:
        return nvgesture.IMAGE_UNIT if self._is_nvgesture() else IMAGE_UNIT

    @property
    def config(self) -> dict[str, Any]:
        return {"classes": self.classes}

    def _list_files(self) -> list[ListFile]:
        if self.lists is not None:
            return find_lists(self.lists)
        try:
            return find_lists(self.raw)
        except DataError:
            return []

    def _is_nvgesture(self) -> bool:
        files = (path for path in files_below(self.raw) if path.name == FILE)
        folders = [path.parent.relative_to(self.raw).as_posix() for path in files]
        return any(map(_NVGESTURE.fullmatch, folders)) and not any(map(_SHREC.fullmatch, folders))

    def items(self) -> list[Item]:
        root = require_folder(self.raw, f"{FILE} files in folders such as gesture_1/finger_1/subject_1/essai_1")
        lists = self._list_files()
        alone = self._is_nvgesture()
        listed = {e.folder: (s, e) for s, _, e in entries(lists) if isinstance(e, Entry)}
        items: dict[str, Item] = {}
        for path in [path for path in files_below(root) if path.name == FILE]:
            item = self._item(path, root, listed, alone)
            if item.name in items:
                problem = f"{path}: {item.name} is there twice; {items[item.name].path} is read"
                item = Item(f"{item.name} ({path})", path, problem=problem)
            items[item.name] = item
        if not items:
            raise DataError(f"{root}: no {FILE} in it or below")
        for item in self._absent(lists, items):
            items[item.name] = item
        return sorted(items.values(), key=lambda item: natural_key(item.name))

    def _absent(self, lists: list[ListFile], items: dict[str, Item]) -> Iterator[Item]:
        """Yields items for what the lists name and the folder lacks, and for lines that can't be understood."""
        for split, where, entry in entries(lists):
            if isinstance(entry, str):
                yield Item(where, self.raw, split, problem=entry)
            elif entry.folder not in items:
                problem = f"{self.raw}: {where} names {entry.folder}, which has no {FILE}"
                yield Item(entry.folder, self.raw, split, problem=problem)

    def _item(self, path: Path, root: Path, listed: dict[str, tuple[str, Entry]], alone: bool) -> Item:
        relative = path.parent.relative_to(root).as_posix()
        if target := leads_out(path, root):
            return Item(relative, path, problem=f"{path}: a link that leads out of the data, to {target}")
        if match := _NVGESTURE.fullmatch(relative):
            label, subject = int(match[2]) - 1, int(match[3])
            known = 0 <= label < nvgesture.CLASSES
            problem = "" if known else f"{path}: class {label + 1} is out of range; expected 1 to {nvgesture.CLASSES}"
            if not alone:
                problem = f"{path}: of NvGesture, among SHREC'17, whose classes are others; convert it by itself"
            return Item(match[1], path, label=label, subject=subject, problem=problem)
        if match := _SHREC.fullmatch(relative):
            return self._gesture(match, path, listed)
        reason = "not in a folder gesture_G/finger_F/subject_S/essai_E or class_C/subjectS_rR, so its label is unknown"
        return Item(relative, path, problem=f"{path}: {reason}")

    def _gesture(self, match: re.Match, path: Path, listed: dict[str, tuple[str, Entry]]) -> Item:
        gesture, finger, subject = (int(match[k]) for k in (2, 3, 4))
        if listed:
            if match[1] not in listed:
                return Item(match[1], path, problem=f"{path}: in neither list file, so its split is unknown")
            split, entry = listed[match[1]]
            return Item(match[1], path, split, label=entry.label(self.classes), subject=subject)
        if not (1 <= gesture <= len(GESTURES) and 1 <= finger <= len(FINGERS)):
            problem = f"{path}: gesture {gesture}, finger {finger} are out of range; expected 1 to 14 and 1 to 2"
            return Item(match[1], path, problem=problem)
        label = gesture - 1 if self.classes == 14 else (gesture - 1) * len(FINGERS) + finger - 1
        return Item(match[1], path, label=label, subject=subject)

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        array = read_array(item.path)
        # a frame in which nothing was found was filled with points of depth 0
        seen = array[..., 2] > 0
        counts = seen.sum(1).astype(np.int64)
        notes = {"points of depth 0 dropped": int((~seen)[counts > 0].sum())}
        return sample_of_frames(item, array[seen].astype(np.float32), counts, notes)

    def summary(self, items: list[Item]) -> list[str]:
        found = Counter(item.split for item in items if not item.problem)
        lines = [f"{counted(sum(found.values()), 'gesture')} found (train {found['train']}, test {found['test']})"]
        if found[""]:
            lines.append(f"{found['']} without a split: no train_gestures.txt and test_gestures.txt found (--lists)")
        return lines
