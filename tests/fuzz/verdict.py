"""The judgment of a run on a damaged input: was it answered as the documents promise?"""

from __future__ import annotations

import os
import re
import signal
import struct
from collections.abc import Iterator
from pathlib import Path

import h5py

from tests.fuzz.forks import UNEXPECTED, Ended

PROMISED = (0, 1, 2, 3, 75)
MORE_MEMORY = 200 << 20  # than the run on the undamaged input
_LOSS = re.compile(
    r"(?<!\b0 )skipped|(?<!\b0 )dropped|left out|warning|instead of|lost|fewer|claims|says", re.IGNORECASE
)
_BAR = re.compile(r" eta [\dhms]+\s*$")
_MOVING = 15  # seconds: a bar writes a line every 5, so one that wrote later than this before the end was still moving
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f\x9b\u202e]")


def faults(ended: Ended, seed: Ended, folder: Path) -> Iterator[str]:
    """The names of what is wrong with a run in this folder; none where all is as promised."""
    if ended.code in (-signal.SIGALRM, -signal.SIGXCPU):
        if not (_BAR.search(ended.said) and ended.quiet < _MOVING):  # else it does the work that a setting asks for
            yield "hang"
    elif ended.code < 0:
        yield f"signal {signal.Signals(-ended.code).name}"
    elif ended.code == UNEXPECTED or "Traceback (most recent call last)" in ended.said:
        yield "traceback"
    elif "a bug, or" in ended.said:
        yield "bug"
    elif "not enough memory" in ended.said:
        yield "believed a size"
    elif ended.code not in PROMISED:
        yield f"exit {ended.code}"
    elif ended.code and "error" not in ended.said.lower():
        yield f"unexplained exit {ended.code}"
    if ended.code >= 0 and ended.memory > seed.memory + MORE_MEMORY:
        yield "memory"
    if _CONTROL.search(ended.said + ended.printed) and not _CONTROL.search(seed.said + seed.printed):
        yield "unprintable"
    yield from _output_faults(ended, folder)


def _output_faults(ended: Ended, folder: Path) -> Iterator[str]:
    written = folder / "out" / "o.h5"
    if ended.code and written.is_file():
        yield "half-written"
    elif ended.code == 0 and written.is_file():
        try:
            with h5py.File(written) as file:
                kept = _kept(file)
        except OSError:
            yield "half-written"
            return
        there = promised(folder / "in")
        if kept is not None and there is not None and kept < there and not _LOSS.search(ended.said + ended.printed):
            yield "silent loss"


def _kept(file: h5py.File) -> int | None:
    """Frames of a file of clouds, or None."""
    return len(file["frame_offsets"]) - 1 if "frame_offsets" in file else None


def promised(folder: Path) -> int | None:
    """Frames that the containers below the folder claim in their own headers; None where one has no such claim."""
    total = 0
    for parent, _, names in os.walk(folder):
        for name in (one for one in names if not one.startswith(".")):
            claim = _claim(Path(parent) / name)
            if claim is None:
                return None
            total += claim
    return total


def _claim(path: Path) -> int | None:
    if not path.is_file():
        return 1  # a link or a pipe named like a frame
    data = path.read_bytes()
    if path.suffix == ".npy" and "depth" in str(path):
        found = re.match(rb"\x93NUMPY.{4}[^\n]*'shape': \((\d+), \d+, \d+\)", data, re.DOTALL)
        return int(found[1]) if found else None
    if data[8:16] == b"AVI LIST" and data[24:28] == b"avih" and len(data) > 52:
        frames = struct.unpack_from("<I", data, 48)[0]
        return frames if frames < len(data) else None  # a damaged number: the file never had as many
    return 1 if path.suffix in (".ply", ".pcd", ".xyz", ".las", ".laz", ".png", ".bin") else None


def cause(fault: str, ended: Ended) -> str:
    """One name for all findings of a cause: the fault and the innermost frame of the project, or the sentence without names."""
    frames = re.findall(r'File "[^"]*/(dpcli/[^"]*)", line (\d+), in (\w+)', ended.said)
    lines = [line for line in ended.said.strip().splitlines() if line.strip()] or [""]
    if frames:
        kind = re.match(r"[\w.]*", lines[-1])[0]
        return f"{fault}: {kind} in {frames[-1][0]} {frames[-1][2]}"
    sentence = next((line for line in lines if "a bug" in line or "error" in line), lines[-1])
    sentence = re.sub(r"'[^']*'|\"[^\"]*\"|\S*/\S*|[-+]?\d[\d.e+]*", "…", sentence.split(":", 2)[-1])
    return f"{fault}: {sentence.strip()[:100]}"
