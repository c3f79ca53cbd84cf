"""Records what a command says about itself in the file it writes."""

from __future__ import annotations

import hashlib
import json
import re
import shlex
import sys
from pathlib import Path

from dpcli import __version__
from dpcli.runtime.whole_file import refuse_folder

# Options that change how the work runs but not its result: left out, so that equal work gives equal bytes.
_WRITTEN = {"-o", "--output", "--picture", "--animation", "--turntable", "--ply", "--page", "--run"}
_VALUED = {*_WRITTEN, "--jobs", "--shard", "--dask", "--device"}
_FLAGS = {"--quiet", "--verbose", "--debug", "--force", "--json"}
_SHORT = re.compile(r"-[qv]+|-o.+")  # several letters, or the file, behind one dash


def command_line(argv: list[str] | None = None) -> str:
    """Returns the command as typed, without the options that don't change the result (`-o`, `--jobs`, `-q`, ...)."""
    kept, skip = ["dpc"], False
    for word in sys.argv[1:] if argv is None else argv:
        if skip:
            skip = False
        elif word in _VALUED:
            skip = True
        elif word not in _FLAGS and word.split("=")[0] not in _VALUED and not _SHORT.fullmatch(word):
            kept.append(word)
    return shlex.join(kept)


def file_digest(path: str | Path) -> str:
    """Returns the SHA-256 of a file's bytes, in hexadecimal. Raises DataError for a folder."""
    refuse_folder(Path(path))
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def record(config: dict, seed: int, inputs: dict[str, str | Path] | None = None) -> dict:
    """Returns one provenance entry: command, resolved options, seed, version, and the digest of every input file.

    The options are as a file will have them, tuples as lists, so that the same work run again equals what was stored.
    """
    stored = json.loads(json.dumps(config))
    entry = {"command": command_line(), "config": stored, "seed": int(seed), "version": __version__}
    if inputs:
        entry["inputs"] = {role: file_digest(path) for role, path in inputs.items()}
    return entry
