"""PartNet-Mobility (SAPIEN) folders, or any URDF files: articulated objects into short sequences with exact parts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.file_cache import cached_by_file, file_state
from dpcli.path_names import path_inside
from dpcli.prepare.articulated.articulated_object import nothing_moves
from dpcli.prepare.articulated.articulated_sequence import Articulation, Study, draw_sequence, study
from dpcli.prepare.articulated.object_splits import SplitRule, counts_of_splits
from dpcli.prepare.articulated.urdf import load_object, mesh_files, read_skeleton
from dpcli.prepare.articulated.urdf_meshes import is_missing
from dpcli.prepare.decode.folder_listing import walk_folders
from dpcli.prepare.reader import Item, Reader, Sample, describe, natural_key, require_least
from dpcli.runtime.progress import log
from dpcli.text_files import read_json

_OTHERS = ("xacro", "sdf", "xml", "usd", "usda", "usdc", "mjcf")  # of robots that are no URDF
_EXPECTED = "a .urdf file, or a folder of objects, each a folder with a mobility.urdf or another .urdf"


@dataclass(frozen=True)
class FoundObject:
    """Holds one URDF of the raw data; ``category`` is "" when nothing tells it."""

    path: Path
    category: str
    name: str


def find_objects(raw: Path) -> list[FoundObject]:
    """Returns every object below ``raw``, in natural order. A folder's mobility.urdf hides other URDF files beside it.

    The category is ``model_cat`` of the object's meta.json, as the original distribution has it; without that, the
    folder that holds the object's folder (Category/ID/mobility.urdf). Objects may lie in the folders of others.
    """
    if not raw.exists():
        raise DataError(f"{raw}: does not exist; expected {_EXPECTED}")
    files = [raw] if raw.is_file() else _urdf_files(raw)
    if not files:
        others = sorted(file.relative_to(raw).as_posix() for kind in _OTHERS for file in raw.rglob(f"*.{kind}"))
        advice = "xacro FILE > robot.urdf makes one" if others and others[0].endswith("xacro") else "convert it first"
        some = f" ({others[0]} is none; {advice})" if others else ""
        raise DataError(f"{raw}: no URDF found{some}; expected {_EXPECTED}")
    found = [_describe(raw, path) for path in files]
    counts = Counter(f.name for f in found)
    found = [f if counts[f.name] == 1 else replace(f, name=_long_name(raw, f)) for f in found]
    return sorted(found, key=lambda f: (f.category, natural_key(f.name)))


def _urdf_files(raw: Path) -> list[Path]:
    files = []
    for folder, below, names in walk_folders(raw):
        urdf = sorted(name for name in names if name.lower().endswith(".urdf") and not name.startswith("."))
        files += [Path(folder, name) for name in (["mobility.urdf"] if "mobility.urdf" in urdf else urdf)]
        below.sort()
    return files


def _describe(raw: Path, path: Path) -> FoundObject:
    name = path.absolute().parent.name if path.name == "mobility.urdf" else path.stem
    above = () if raw.is_file() else path.relative_to(raw).parts[:-1]
    category = _model_category(path.parent / "meta.json") or (above[-2] if len(above) >= 2 else "")
    return FoundObject(path, category, f"{category}_{name}" if category else name)


def _long_name(raw: Path, found: FoundObject) -> str:
    """Returns a name that tells objects of one category and name apart: the folders on the way to it."""
    place = found.path.relative_to(raw)
    place = place.parent if place.name == "mobility.urdf" else place.with_suffix("")
    return "_".join([found.category, *place.parts] if found.category else place.parts)


def _model_category(meta: Path) -> str:
    try:
        category = read_json(meta)["model_cat"] if meta.is_file() else ""
    except (KeyError, TypeError, IndexError):
        return ""
    except (DataError, OSError) as error:
        log.warn(f"its category is not known: {error}")
        return ""
    return category.strip() if isinstance(category, str) else ""


@cached_by_file(3)
def _studied(path: Path, root: Path | None, options: Articulation, meshes: tuple[Hashable, ...]) -> Study:
    """Studies an object; its meshes are read once for all its sequences, and a process keeps the last few objects.

    meshes: the states of their files, since the object is another one when they change, too.
    """
    return study(load_object(read_skeleton(path, root)), options)


@dataclass(frozen=True)
class Sapien(Reader):
    """Reads URDF objects. ``pairs_per_object``: sequences drawn of every object; ``articulation``: how.

    ``allow_outside``: meshes may lie outside the raw folder, or a raw file's folder; links and ``..`` may lead there.
    """

    raw: Path
    pairs_per_object: int = 8
    articulation: Articulation = Articulation()
    split: SplitRule = SplitRule()
    seed: int = 0
    allow_outside: bool = False
    length_unit: ClassVar[str] = "object diameter"
    fields: ClassVar[tuple[str, ...]] = ("part", "pose", "joint")

    def __post_init__(self) -> None:
        require_least(self, pairs_per_object=1)

    @property
    def root(self) -> Path | None:
        """Returns the folder that all files must lie in; None when they may lie anywhere."""
        if self.allow_outside:
            return None
        return self.raw.parent if self.raw.is_file() else self.raw

    @cached_property
    def _found(self) -> list[FoundObject]:
        return find_objects(self.raw)

    @property
    def class_names(self) -> list[str]:
        return sorted({found.category for found in self._found} - {""})

    @property
    def config(self) -> dict[str, Any]:
        own = {"pairs_per_object": self.pairs_per_object, "seed": self.seed, "split": asdict(self.split)}
        return {**own, **asdict(self.articulation)}

    def items(self) -> list[Item]:
        splits = self.split.assign([f.category for f in self._found], self.seed)
        problems, joints, meshes = zip(*(_inspect(f.path, self.root, self.raw) for f in self._found))
        pad = min(self.articulation.max_parts, 1 + max(joints))
        labels = {name: label for label, name in enumerate(self.class_names)}
        return [
            Item(
                f"{f.name}_{number:03}" if not problem else f.name,
                f.path,
                split=split,
                label=labels[f.category] if f.category else -1,
                extra={"parts": pad, "first": number == 0, "files": own},
                problem=problem,
            )
            for f, split, problem, own in zip(self._found, splits, problems, meshes)
            for number in range(1 if problem else self.pairs_per_object)
        ]

    def read(self, item: Item, rng: np.random.Generator) -> Sample:
        meshes = tuple(map(file_state, item.extra["files"]))
        studied = _studied(item.path, self.root, self.articulation, meshes)
        if not item.extra["first"]:  # what is odd in an object counts once, not once a sequence
            studied = replace(studied, notes=Counter())
        return draw_sequence(item.name, studied, self.articulation, item.extra["parts"], rng, **describe(item))

    def summary(self, items: list[Item]) -> list[str]:
        good = {item.path: item.split for item in items if not item.problem}
        shares = counts_of_splits(good.values())
        names = f" of {counted(len(self.class_names), 'category', 'categories')}" if self.class_names else ""
        return (
            [f"{counted(len(good), 'object')}{names} ({shares}), {counted(self.pairs_per_object, 'sequence')} of each"]
            if good
            else []
        )


def _inspect(path: Path, root: Path | None, given: Path) -> tuple[str, int, list[Path]]:
    """Returns (problem that shows without the meshes' content, number of joints, mesh files). given: what the user named."""
    try:
        if path != given:
            path_inside(root, path.parent, path.name)
    except DataError as error:
        return f"{path}: {error} (--allow-outside opens others)", 0, []
    try:
        skeleton = read_skeleton(path, root)
        meshes = mesh_files(skeleton)
    except DataError as error:
        return str(error), 0, []
    missing = [name for name, file in meshes.items() if not file.is_file()]
    if missing:
        more = f", and {len(missing) - 1} more" if len(missing) > 1 else ""
        return f"{path}: its mesh {is_missing(path, missing[0], root)}{more}", 0, []
    if not skeleton.joints:
        return nothing_moves(path, skeleton.notes), 0, []
    return "", len(skeleton.joints), list(meshes.values())
