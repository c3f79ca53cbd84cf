"""Clouds that other point-video projects have made already: MeteorNet's and PSTNet's `.npz`."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.prepare.actions import msraction3d, ntu60
from dpcli.prepare.actions.pts_label import FILE as PTS_LABEL
from dpcli.prepare.actions.pts_label import PtsLabel
from dpcli.prepare.decode.folder_listing import files_below, leads_out
from dpcli.prepare.decode.npz_frames import member_names, read_frames
from dpcli.prepare.median import median
from dpcli.prepare.reader import Item, Reader, Sample, require_folder, require_known, sample_of_frames

KEYS = {"msraction3d": "point_clouds", "ntu60": "data"}  # what MeteorNet's and PSTNet's scripts call the array
_NO_SHARE = 0.5  # units of the output of this many and more stored units are 33 m where these are shares of 65535 mm
_SAMPLED = 4096  # points that are looked at
_MSR = re.compile(r"(a(\d{2})_s(\d{2})_e(\d{2}))(?:\D.*)?\.npz", re.IGNORECASE)
_NTU = re.compile(r"(S\d{3}C\d{3}P\d{3}R\d{3}A\d{3})(?:\D.*)?\.npz")
_PLAUSIBLE = (0.05, 100.0)  # median distances in units of the output: some of half a meter, before one depth camera
_STORED = {  # by default, and what other scripts store with the scale that fits (stored units at most, scale, what they are)
    "msraction3d": ("at some hundreds of raw depth units", ((20.0, 1.0, "divided already"),)),
    "ntu60": ("at shares of 65535 mm, below 1", ((20.0, 0.65535, "meters"), (20_000.0, 655.35, "millimeters"))),
}
_FORMS = ("auto", "msraction3d", "ntu60", "pts_label")


def open_preprocessed(
    raw: Path,
    form: str = "auto",
    classes: int = 28,
    lists: Path | None = None,
    protocol: str = "xsub",
    scale: float | None = None,
) -> Reader:
    """Returns the reader for what is in a folder. form: which of the forms, or ``auto`` to tell it by the names
    of the files.

    Raises UsageError when an option is given that the form doesn't have. Raises DataError when the folder holds none
    of them.
    """
    if form not in _FORMS:
        raise UsageError(f"--form {form}: expected one of {', '.join(_FORMS)}")
    form = _detect(raw) if form == "auto" else form
    if form == "pts_label":
        if scale is not None:
            raise UsageError("--scale: pts_label.npy holds pixels, which are kept; leave it out")
        return PtsLabel(raw, classes, lists)
    if lists is not None:
        raise UsageError(f"--lists: the names of {form}'s files give label and split; leave it out")
    return PeerClouds(raw, form, protocol, scale)


def _detect(raw: Path) -> str:
    expected = f"{PTS_LABEL}, aAA_sSS_eEE_sdepth.npz or SsssCcccPpppRrrrAaaa.npz files"
    names = {"pts_label": re.compile(re.escape(PTS_LABEL)), "msraction3d": _MSR, "ntu60": _NTU}
    files = [path.name for path in files_below(require_folder(raw, expected))]
    forms = [form for form, name in names.items() if any(map(name.fullmatch, files))]
    if len(forms) > 1:
        raise DataError(f"{raw}: holds files of several forms ({', '.join(forms)}); --form says which to read")
    if not forms:
        raise DataError(f"{raw}: no {expected} in it or below")
    return forms[0]


@dataclass(frozen=True)
class PeerClouds(Reader):
    """Reads one `.npz` per video. The clouds come out as `prepare msraction3d` or `prepare ntu60` would make them.

    ``scale``: stored units per unit of length in the output. By default 300 for MSR-Action3D, whose files hold raw
    depth units, and 0.01 for NTU, whose files hold 16-bit values / 65535: the factors in the peers' loaders.
    """

    raw: Path
    form: str
    protocol: str = "xsub"
    scale: float | None = None
    fields: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        require_known(self, protocol=ntu60.PUBLISHED)
        if self.scale is not None and not self.scale > 0:
            raise UsageError(f"--scale {self.scale:g}: expected stored units per unit of length, more than 0")

    @property
    def class_names(self) -> list[str]:
        return list(msraction3d.CLASS_NAMES if self.form == "msraction3d" else ntu60.CLASS_NAMES)

    @property
    def length_unit(self) -> str:
        if self.form == "msraction3d":
            return f"{self._scale:g} raw depth units" if self._scale != 1 else "raw depth unit"
        if self._scale >= _NO_SHARE:
            return f"{self._scale:g} stored units"
        return f"{self._scale * 65535:g} mm"

    @property
    def _scale(self) -> float:
        return self.scale or {"msraction3d": 300.0, "ntu60": 0.01}[self.form]

    @property
    def config(self) -> dict[str, Any]:
        protocol = {"protocol": self.protocol} if self.form == "ntu60" else {}
        return {"form": self.form, "scale": self._scale, **protocol}

    def items(self) -> list[Item]:
        root = require_folder(self.raw, f"one .npz per video of {self.form}")
        make: Callable[[Path], Item] = self._msr_item if self.form == "msraction3d" else self._ntu_item
        items: dict[str, Item] = {}
        for path in (path for path in files_below(root) if path.suffix.lower() == ".npz"):
            item = make(path)
            if target := leads_out(path, root):
                item = Item(item.name, path, problem=f"{path}: a link that leads out of the data, to {target}")
            elif item.name in items:
                problem = f"{path}: {item.name} is there twice; {items[item.name].path} is read"
                item = Item(f"{item.name} ({path})", path, problem=problem)
            items[item.name] = item
        if not items:
            raise DataError(f"{root}: no .npz in it or below; expected one per video of {self.form}")
        return [items[name] for name in sorted(items)]

    def _msr_item(self, path: Path) -> Item:
        match = _MSR.fullmatch(path.name)
        if not match:
            return Item(path.name, path, problem=f"{path}: not called aAA_sSS_eEE...npz, so its action is unknown")
        action, subject = int(match[2]), int(match[3])
        problem = "" if 1 <= action <= 20 else f"{path}: action {action} is out of range; expected 1 to 20"
        split = "train" if subject <= 5 else "test"
        return Item(match[1].lower(), path, split, label=action - 1, subject=subject, problem=problem)

    def _ntu_item(self, path: Path) -> Item:
        match = _NTU.fullmatch(path.name)
        if not match:
            reason = "not called SsssCcccPpppRrrrAaaa.npz, so its action is unknown"
            return Item(path.name, path, problem=f"{path}: {reason}")
        return ntu60.video_item(match[1], path, self.protocol)

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        names = member_names(item.path)
        key = next((k for k in (KEYS[self.form], *KEYS.values()) if k in names), None)
        if key is None:
            wanted, found = KEYS[self.form], ", ".join(names) or "none"
            raise DataError(f"{item.path}: no array {wanted!r} in it; found: {found}")
        frames = read_frames(item.path, key)
        counts = np.array([len(frame) for frame in frames], np.int64)
        points = np.concatenate([np.zeros((0, 3), np.float32), *frames]) * np.float32(1 / self._scale)
        return sample_of_frames(item, points, counts, self._doubts(points))

    def _doubts(self, points: np.ndarray) -> dict[str, int]:
        """Returns a note where points f32 (P,3) are, by the usual scale, where no depth camera sees any; it names what may fit."""
        distances = np.linalg.norm(points[:: max(1, len(points) // _SAMPLED)], axis=1)
        typical = float(median(distances)) if len(distances) else _PLAUSIBLE[0]
        if self.scale is not None or _PLAUSIBLE[0] <= typical <= _PLAUSIBLE[1] or not np.isfinite(typical):
            return {}
        expected, others = _STORED[self.form]
        stored = typical * self._scale
        fits = next(
            (f"if they are {what}, give --scale {scale:g}" for most, scale, what in others if stored <= most),
            "see --scale",
        )
        return {f"videos whose points aren't where the scripts of {self.form} put them ({expected}); {fits}": 1}

    def summary(self, items: list[Item]) -> list[str]:
        found = Counter(item.split for item in items if not item.problem)
        published = 567 if self.form == "msraction3d" else ntu60.VIDEOS
        counts = f"{sum(found.values())} of the {published} published videos found"
        return [f"{self.form}: {counts} (train {found['train']}, test {found['test']})"]
