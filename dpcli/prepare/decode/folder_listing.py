"""Files of a folder, and links: one that leads out of the data is an error, because the file may not be what it seems."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path

from dpcli.errors import DataError
from dpcli.path_names import as_utf8
from dpcli.prepare.series import is_hidden
from dpcli.regular_files import why_unreadable

_OF_CAMERAS = (".json", ".txt", ".csv", ".yaml", ".yml", ".xml", ".ini", ".npy", ".pincam")  # suffixes of calibrations
_CAMERA = re.compile(
    r"intrinsic|calib|(^|[^a-z])cam(era)?s?[-_ ]?(matri|info|param|intr)|(^|[-_.])(k|cameras?)$", re.IGNORECASE
)
_POSE = re.compile(r"(^|[^a-z])(poses?|traj(ectory)?|odom(etry)?|ground[-_ ]?truth)([^a-z]|$)", re.IGNORECASE)
_SCALE = re.compile(r"depth[-_ ]?(map)?[-_ ]?(scal(e|ing)|units?|factor)|^(scale|units?)$", re.IGNORECASE)
_OF_OTHERS = re.compile("extrin|colou?r|rgb", re.IGNORECASE)  # that no depth is made points of
_POSES = re.compile(r"^poses?$", re.IGNORECASE)
_CAMERAS = re.compile(r"intrinsics?$|^cameras?$|^calib", re.IGNORECASE)  # folders of them


def leads_out(path: Path, root: Path) -> str:
    """Returns where a link takes ``path`` outside ``root``, "" when it stays inside or is no link at all."""
    target = os.path.realpath(path)
    inside = os.path.realpath(root)
    return "" if target == inside or target.startswith(inside.rstrip(os.sep) + os.sep) else target


def walk_folders(root: Path) -> Iterator[tuple[str, list[str], list[str]]]:
    """Yields what `os.walk` does: of all folders below ``root`` that aren't hidden, those that links name too, but for links
    to a folder above. Whoever takes a name from the list of folders keeps it from being entered.
    """
    for folder, below, names in os.walk(root, followlinks=True):
        below[:] = [name for name in below if not is_hidden(name) and not _leads_above(os.path.join(folder, name))]
        yield folder, below, names


def count_suffixes(names: Iterable[str], suffixes: tuple[str, ...]) -> Counter[str]:
    """Returns how many of a folder's names, but for hidden ones, end in each of the suffixes, which are lower case.

    >>> count_suffixes(["a.BAG", "._a.bag", "b.bag", "c.txt"], (".bag", ".mcap"))
    Counter({'.bag': 2})
    """
    lower = (name.lower() for name in names if not is_hidden(name))
    return Counter(os.path.splitext(name)[1] for name in lower if name.endswith(suffixes))


def stores(folders: Iterable[str]) -> list[str]:
    """Returns those of the names of folders that are arrays of Zarr, each a folder of its own."""
    return [name for name in folders if name.lower().endswith(".zarr")]


def files_below(root: Path) -> list[Path]:
    """Returns all files below ``root`` that aren't hidden, sorted; those in folders that links name too."""
    return sorted(
        Path(folder, name) for folder, _, names in walk_folders(root) for name in names if not is_hidden(name)
    )


def named_below(root: Path, paths: Sequence[Path], kind: str) -> dict[str, Path]:
    """Returns some files below a folder by their paths from there without the suffix. Raises DataError where two of them differ
    in that alone; kind: what they are called.
    """
    named = {as_utf8(path.relative_to(root).with_suffix("").as_posix()): path for path in paths}
    if len(named) < len(paths):
        shown = {*named.values()}
        twin = next(path for path in paths if path not in shown)
        raise DataError(f"{twin}: there is a {kind} of the same name in another format; keep one of them")
    return named


def calibrations_below(root: Path) -> list[str]:
    """Returns the files that by their names describe a camera, below a folder, or beside one that holds none: one of each folder."""
    return _named_alike(root, _OF_CAMERAS, _CAMERA, _CAMERAS)


def poses_below(root: Path) -> list[str]:
    """Returns the files that by their names tell how a camera moved, as `calibrations_below` does."""
    return _named_alike(root, (*_OF_CAMERAS, ".log", ".npz"), _POSE, _POSES)


def scales_below(root: Path) -> list[str]:
    """Returns the files that by their names tell the unit of depth, as `calibrations_below` does."""
    return _named_alike(root, (".txt", ".json", ".csv", ".yaml", ".yml", ".npy"), _SCALE, re.compile("$^"))


def _named_alike(root: Path, suffixes: tuple[str, ...], names: re.Pattern[str], folders: re.Pattern[str]) -> list[str]:
    """Returns one file of each folder that itself or whose folder is called so."""
    places = [(folder, own) for folder, _, own in walk_folders(root)] if root.is_dir() else []
    if above := next((own for own in os.walk(root.absolute().parent)), None):
        places.append((above[0], above[2]))
    found: dict[str, list[str]] = {}
    for folder, own in places:
        known = folders.search(os.path.basename(folder)) is not None
        for name in own:
            stem, suffix = os.path.splitext(name)
            if suffix.lower() in suffixes and not is_hidden(name) and (known or names.search(stem)):
                found.setdefault(folder, []).append(name)
    chosen = {
        folder: min(own, key=lambda name: (_OF_OTHERS.search(name) is not None, "depth" not in name.lower(), name))
        for folder, own in found.items()
    }
    return [os.path.relpath(os.path.join(*one), root.absolute().parent) for one in sorted(chosen.items())]


def _leads_above(path: str) -> bool:
    """Returns whether a folder is a link to one that holds it, on the way by which it was reached or in truth."""
    if not os.path.islink(path):
        return False
    target = os.path.realpath(path)
    above = [os.path.realpath(one) for one in Path(os.path.abspath(path)).parents]
    return any(one == target or one.startswith(target.rstrip(os.sep) + os.sep) for one in above)


def folder_files(folder: Path, root: Path, suffix: str) -> Iterator[tuple[str, Path]]:
    """Yields (name, path) of the files in a folder that end in ``suffix`` and aren't hidden, in no order.

    Raises DataError at a link out of ``root``.
    """
    with os.scandir(folder) as entries:
        for entry in entries:
            if not entry.name.lower().endswith(suffix) or is_hidden(entry.name):
                continue
            if entry.is_symlink() and (target := leads_out(Path(entry.path), root)):
                raise DataError(f"{entry.path}: a link that leads out of the data, to {target}; copy the file here")
            yield entry.name, Path(entry.path)


def unreadable_entries(root: Path, taken: Collection[Path]) -> list[tuple[Path, str]]:
    """Returns (path, reason), sorted, of all that lies below a folder and can't be data: what `why_unreadable` refuses,
    folders that may not be entered, links to a folder above, and folders named like the files in ``taken``.

    taken: the paths that are listed as samples already; they are left to those who read them. Hidden names are passed over.
    """
    found: list[tuple[Path, str]] = []
    suffixes = {path.suffix.lower() for path in taken if path.suffix and path.is_file()}
    waiting = [root]
    while waiting:
        folder = waiting.pop()
        try:
            entries = [entry for entry in os.scandir(folder) if not is_hidden(entry.name)]
        except OSError as error:
            found.append((folder, f"cannot be listed ({error.strerror})"))
            continue
        for entry in entries:
            if entry.is_file(follow_symlinks=False):  # nearly all; the listing knows it, nothing else is asked
                continue
            path = Path(entry.path)
            if not is_folder(entry):
                found += [(path, reason)] if (reason := why_unreadable(path)) else []
                continue
            if above := _leads_above(entry.path):
                found.append((path, "a link to a folder above it"))
            elif path.suffix.lower() in suffixes and not any(path == one or path in one.parents for one in taken):
                found.append((path, "a folder, though named like a file of data"))
            if not above:
                waiting.append(path)
    return sorted((path, reason) for path, reason in found if path not in taken)


def is_folder(entry: os.DirEntry[str]) -> bool:
    """Returns whether an entry is a folder, or a link to one; a link in a circle is none."""
    try:
        return entry.is_dir()
    except OSError:
        return False
