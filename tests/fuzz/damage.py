"""A damaged input as a list of damages, each of a path and a number, so that it can be made again and made smaller."""

from __future__ import annotations

import os
import random
import shutil
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.container_mutators import structured
from tests.fuzz.mutators import NAMES, raw

KINDS = ("structured",) * 11 + ("raw",) * 7 + ("tree",) * 2


@dataclass(frozen=True)
class Damage:
    """One change to a file below the folder of inputs; `number` seeds its generator."""

    path: str
    kind: str
    number: int

    def apply(self, folder: Path) -> None:
        """Changes the file, if an earlier damage has left it there."""
        path, rng = folder / self.path, random.Random(self.number)
        if not path.is_file() or path.is_symlink():
            return
        if self.kind == "tree":
            _in_tree(path, rng)
            return
        data = path.read_bytes()
        try:
            made = (structured if self.kind == "structured" else raw)(data, rng)
        except Exception:  # the bytes are no longer of their kind, after an earlier damage; or a field isn't there
            made = raw(data, rng)
        path.write_bytes(made)


def draw(files: list[str], rng: random.Random) -> list[Damage]:
    """One damage for most inputs, up to three for some, all to the same few files."""
    chosen = rng.choices(files, k=2)
    count = rng.choice((1, 1, 1, 2, 3))
    return [Damage(rng.choice(chosen), rng.choice(KINDS), rng.getrandbits(48)) for _ in range(count)]


def _in_tree(path: Path, rng: random.Random) -> None:
    """The file empty, gone, a folder, a pipe, a link to nowhere or to itself, or under another name."""
    change = rng.randrange(8)
    if change == 0:
        path.write_bytes(b"")
        return
    if change == 1:
        name = rng.choice(NAMES).replace("/", "_").split("\0")[0].encode("utf-8", "surrogatepass")[:200]
        if name not in (b"", b".", b".."):
            os.rename(path, os.path.join(os.fsencode(path.parent), name + os.fsencode(path.suffix)))
        return
    if change == 2:
        other = rng.choice(sorted(one for one in path.parent.iterdir() if one.is_file()))
        shutil.copyfile(other, path) if other != path else path.unlink()
        return
    path.unlink()
    if change == 4:
        path.mkdir()
    elif change == 5:
        os.mkfifo(path)
    elif change == 6:
        path.symlink_to("nowhere")
    elif change == 7:
        path.symlink_to(path.name)
