"""Weights of the learned metrics: the list of files, the folder they lie in, and whether they are whole.

`weights_fetch.py` downloads them, `state_dicts.py` reads them.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from dpcli.errors import DataError, UsageError
from dpcli.regular_files import why_unreadable
from dpcli.runtime.provenance import file_digest
from dpcli.text_files import read_toml

LIST = Path(__file__).with_name("weights.toml")
FOLDER_VARIABLE = "DPC_WEIGHTS"
_WHOLE = 64  # hexadecimal digits of a SHA-256


@dataclass(frozen=True)
class Weights:
    """Describes one published file of weights.

    file: path inside the weights folder. size: bytes; about = True: rounded, so not compared. sha256: the whole digest,
    its first 8 digits where only those are published (torchvision puts them in the file's name), or "" for none.
    by_hand: `url` is a page to click through, not the file. script: a TorchScript archive. beside: files it needs.
    """

    name: str
    file: str
    url: str
    size: int
    license: str
    sha256: str
    used_by: str
    note: str = ""
    about: bool = False
    by_hand: bool = False
    script: bool = False
    beside: tuple[Weights, ...] = ()

    @property
    def files(self) -> tuple[Weights, ...]:
        """Returns this file and those it needs beside it."""
        return (self, *self.beside)


@dataclass(frozen=True)
class Checked:
    """Says what `check_file` found. state: present, absent or damaged. digest: the file's own, "" if it wasn't computed."""

    state: str
    digest: str
    finding: str


@cache
def known_weights() -> dict[str, Weights]:
    """Returns the weights that learned metrics can use, by name, from weights.toml."""
    return {name: _entry(name, dict(fields)) for name, fields in read_toml(LIST).items()}


def _entry(name: str, fields: dict[str, Any]) -> Weights:
    shared = {key: fields[key] for key in ("license", "used_by")}
    beside = tuple(Weights(name=name, **shared, **more) for more in fields.pop("beside", []))
    return Weights(name=name, beside=beside, **fields)


def weights_named(name: str) -> Weights:
    """Returns one entry of the list, by its name or its file's. Raises UsageError for another name."""
    for weights in known_weights().values():
        if name in (weights.name, weights.file):
            return weights
    raise UsageError(f"no weights named {name!r}; there are {', '.join(known_weights())}")


def weights_folder(given: Path | None = None) -> Path:
    """Returns the folder of weights: the one given, else that of DPC_WEIGHTS, else `dpc/weights` in the user's cache.

    It need not exist, unless it was given: DataError.
    """
    if given is not None:
        if not given.is_dir():
            what = why_unreadable(given) or ("a file, expected a folder" if given.exists() else "no such folder")
            raise DataError(f"--weights {given}: {what}")
        return given
    if os.environ.get(FOLDER_VARIABLE):
        return Path(os.environ[FOLDER_VARIABLE]).expanduser()
    cache_folder = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(cache_folder) if os.path.isabs(cache_folder) else Path.home() / ".cache") / "dpc" / "weights"


def find_weights(name: str, folder: Path) -> Path:
    """Returns where the weights `name` lie. DataError, one line, that says what to download and where to put it."""
    weights = weights_named(name)
    for each in weights.files:
        if not (folder / each.file).is_file():
            raise DataError(f"{folder / each.file}: no such weights; {how_to_get(weights, each, folder)}")
    return folder / weights.file


def how_to_get(weights: Weights, missing: Weights, folder: Path) -> str:
    """Returns what to do about a missing file, in half a line."""
    by_hand = f"download {missing.url} ({bytes_text(missing.size, missing.about)}) to {folder / missing.file}"
    if weights.by_hand:
        return f"{by_hand} (from that page, by hand)"
    return f"run `dpc evaluate weights fetch {weights.name}`, or {by_hand}"


def bytes_text(count: int, about: bool = False) -> str:
    """Returns a number of bytes in decimal units, as downloads are counted.

    >>> bytes_text(244408911), bytes_text(4970, about=True)
    ('244 MB', 'about 4.97 kB')
    """
    unit, per = next(((u, p) for u, p in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)) if count >= p), ("B", 1))
    return f"{'about ' if about else ''}{count / per:.3g} {unit}"


def check_file(path: Path, weights: Weights, digest: bool = True) -> Checked:
    """Compares a file with its entry: size, and (unless digest is False) as much of the SHA-256 as is published."""
    if not path.is_file():
        return Checked("absent", "", f"no file {path}")
    size = path.stat().st_size
    if not weights.about and size != weights.size:
        return Checked("damaged", "", f"{size} bytes, expected {weights.size}")
    if size == 0:
        return Checked("damaged", "", "an empty file")
    if not digest:
        return Checked("present", "", "size not published" if weights.about else "size checked")
    return _check_digest(file_digest(path), weights)


def _check_digest(found: str, weights: Weights) -> Checked:
    if not found.startswith(weights.sha256):
        expected = weights.sha256 + ("…" if len(weights.sha256) < _WHOLE else "")
        return Checked("damaged", found, f"SHA-256 {found}, expected {expected}")
    if not weights.sha256:
        return Checked("present", found, f"no published digest; SHA-256 is {found}")
    whole = len(weights.sha256) == _WHOLE
    return Checked(
        "present", found, "whole SHA-256 checked" if whole else f"first 8 digits of SHA-256 checked: {found}"
    )


def whole_weights(name: str, folder: Path, *, digest: bool = False) -> Path:
    """Returns where the weights `name` lie, after their size, and with `digest` their SHA-256, was compared.

    Raises DataError when they are absent, as `find_weights`, or damaged.
    """
    path = find_weights(name, folder)
    found = check_file(path, weights_named(name), digest)
    if found.state != "present":
        raise DataError(f"{path}: damaged weights ({found.finding}); delete it and fetch it again")
    return path


def check_weights(weights: Weights, folder: Path, digest: bool = True) -> Checked:
    """Checks an entry with all its files; the state is that of the first one that isn't present."""
    found = [check_file(folder / each.file, each, digest) for each in weights.files]
    return next((each for each in found if each.state != "present"), found[0])
