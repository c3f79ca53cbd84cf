"""The cost of shards: what 8 shards of `dpc segment predict` and their merge take beyond one run, and how it grows.

`python -m tests.bench.bench_spread [FOLDER]` makes files of repeated sequences (4 frames of 512 points), predicts each whole
and in 8 shards one after the other, merges, and prints processor seconds (of the command and all its processes, as
other work on the machine doesn't count there) and the peak memory. The method is the fastest there is, so that the
overhead shows; the last table sets it against the default method's own time for a sequence.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from dpcli.store import CloudsWriter
from tests.support.drawers import drawer

SHARDS, FRAMES, POINTS = 8, 4, 512
COUNTS = tuple(map(int, os.environ.get("COUNTS", "500,1000,2000").split(",")))
FAST = ("--method", "ward", "--flow", "nearest", "--points", "32", "--set", "icp=0")
TARGET = 100_000


def write_sequences(path: Path, count: int) -> Path:
    """Writes `count` sequences, ten different ones again and again under new names."""
    some = [drawer("s", seed, frames=FRAMES, points=POINTS, label=0) for seed in range(10)]
    with CloudsWriter(path, class_names=["drawer"], fields=["part", "pose"], force=True) as writer:
        for number in range(count):
            writer.write(replace(some[number % 10], name=f"sequence-{number:09d}"))
    return path


def cost(*words: object) -> tuple[float, float]:
    """Returns the processor seconds and the peak memory, MiB, of a command and its processes."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "dpcli", *map(str, words), "-q", "--force"]
    measured = f"import resource, subprocess, sys; subprocess.run({command!r}, check=True, stdout=subprocess.DEVNULL); "
    measured += "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024)"
    peak = subprocess.run([sys.executable, "-c", measured], check=True, capture_output=True, text=True).stdout
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, float(peak)


def measure(folder: Path, count: int) -> list[float]:
    """Returns the seconds of the whole, of the shards and of the merge, and the peak memory of these."""
    data = write_sequences(folder / "data.h5", count)
    whole, peak_whole = cost("segment", "predict", data, "-o", folder / "whole.h5", *FAST)
    shards = [folder / f"part-{k}.h5" for k in range(SHARDS)]
    spent = [
        cost("segment", "predict", data, "-o", path, "--shard", f"{k}/{SHARDS}", *FAST) for k, path in enumerate(shards)
    ]
    merge, peak_merge = cost("prepare", "merge", *shards, "-o", folder / "all.h5")
    assert (folder / "all.h5").read_bytes() == (folder / "whole.h5").read_bytes(), "the merged file differs"
    return [whole, sum(one for one, _ in spent), merge, peak_whole, max(peak for _, peak in spent), peak_merge]


def main() -> None:
    given = Path(sys.argv[1]) if len(sys.argv) > 1 else None
    with tempfile.TemporaryDirectory(dir=given) as name:
        folder, rows = Path(name), []
        print(f"{'sequences':>10} {'whole s':>8} {'shards s':>9} {'merge s':>8}   peak MiB: whole, a shard, merge")
        for count in COUNTS:
            rows.append(measure(folder, count))
            whole, shards, merge, *peaks = rows[-1]
            print(
                f"{count:10d} {whole:8.1f} {shards:9.1f} {merge:8.1f}  ",
                *(f"{peak:6.0f}" for peak in peaks),
                flush=True,
            )
        extra = np.array([shards + merge - whole for whole, shards, merge, *_ in rows])
        slope, fixed = np.polyfit(COUNTS, extra, 1)
        off = np.abs(np.polyval([slope, fixed], COUNTS) - extra).max()
        print(f"overhead = {fixed:.1f} s + {1000 * slope:.2f} ms a sequence (worst residual {off:.1f} s)")
        few = write_sequences(folder / "few.h5", 10), write_sequences(folder / "more.h5", 60)
        own = [cost("segment", "predict", data, "-o", folder / "own.h5")[0] for data in few]
        each = (own[1] - own[0]) / 50
        total = fixed + slope * TARGET
        print(f"the default method takes {1000 * each:.0f} ms a sequence: of {TARGET} sequences the overhead is")
        print(f"{total:.0f} s of {each * TARGET:.0f} s, {100 * total / (each * TARGET):.2f} %")


if __name__ == "__main__":
    main()
