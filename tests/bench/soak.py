"""Long runs, watched: speed at the end beside speed at the beginning, memory and open files. `make soak`, or

    python -m tests.bench.soak FOLDER [--minutes 60] [--samples 60000] [--shards 256] [--only stream]

predicts a stream of 30 frames a second for so many minutes, converts so many samples of 3 frames and 8 points, and merges
so many shards. Prints a line for each and exits with 1 where speed fell by more than 5 % or memory or open files grew by
more than a tenth between the second tenth of the run and the last (the first loads libraries and fills caches).
"""

from __future__ import annotations

import argparse
import io
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil

from dpcli.runtime.machines.shards import Shard, describe_shard
from dpcli.runtime.provenance import record
from dpcli.store import CloudSequence, CloudsWriter

FPS, POINTS = 30, 256


@dataclass(frozen=True)
class Look:
    """One look at a run: seconds since its begin, things done, resident bytes and open files, of all its processes."""

    seconds: float
    done: int
    memory: int
    files: int


def dpc(*words: object) -> list[str]:
    """The command as words for a process."""
    return [sys.executable, "-m", "dpcli", *map(str, words)]


def look(process: psutil.Process, began: float, done: int) -> Look:
    """One look at a process and those below it."""
    family = [process, *process.children(recursive=True)]
    memory = files = 0
    for one in family:
        try:
            memory += one.memory_info().rss
            files += one.num_fds()
        except psutil.NoSuchProcess:
            continue
    return Look(time.monotonic() - began, done, memory, files)


def watch(process: subprocess.Popen, done: Callable[[], int], every: float) -> list[Look]:
    """Looks until the process ends; raises where it failed."""
    began, looks, watched = time.monotonic(), [], psutil.Process(process.pid)
    while process.poll() is None:
        try:
            looks.append(look(watched, began, done()))
        except psutil.Error:
            break
        time.sleep(every)
    assert process.wait() == 0, process.args
    return looks


def rate(looks: list[Look]) -> float:
    """Things a second between the first look and the last."""
    return (looks[-1].done - looks[0].done) / (looks[-1].seconds - looks[0].seconds)


def told(name: str, looks: list[Look]) -> bool:
    """Prints a line about a run; says whether it was flat."""
    looks = [one for one in looks if one.done > 0]
    looks = looks[: 1 + max(range(len(looks)), key=lambda place: looks[place].done)]  # then it closes its files
    tenth = max(len(looks) // 10, 2)
    early, late = looks[tenth : 2 * tenth + 1], looks[-tenth - 1 :]
    speed = rate(late) / rate(early)
    memory, files = (
        np.mean([getattr(one, key) for one in late]) / np.mean([getattr(one, key) for one in early])
        for key in ("memory", "files")
    )
    flat = speed >= 0.95 and memory <= 1.1 and files <= 1.1
    print(
        f"{name}: {looks[-1].done} in {looks[-1].seconds:.0f} s, {rate(early):.1f} a second early and {rate(late):.1f} late"
        f" ({speed:.3f}); memory {early[-1].memory / 1e6:.0f} to {late[-1].memory / 1e6:.0f} MB ({memory:.3f});"
        f" open files {early[-1].files} to {late[-1].files}{'' if flat else '  NOT FLAT'}",
        flush=True,
    )
    return flat


def feed(pipe, frames: int) -> None:
    """Writes random clouds, FPS a second, never faster."""
    rng, began = np.random.default_rng(0), time.monotonic()
    for frame in range(frames):
        whole = io.BytesIO()
        np.save(whole, rng.normal(size=(POINTS, 3)).astype(np.float32))
        pipe.write(whole.getvalue())
        pipe.flush()
        time.sleep(max(0.0, began + frame / FPS - time.monotonic()))
    pipe.close()


def stream(folder: Path, asked: argparse.Namespace) -> bool:
    """Predicts while frames arrive, and keeps what its page shows."""
    shown = ("--json", "--page", "live.html", "--force")
    words = dpc("classify", "predict", "-", "--stream", "--model", "msraction3d-24", "--hop", 8, *shown)
    process = subprocess.Popen(
        words, cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    lines: list[bytes] = []
    threads = [
        threading.Thread(target=feed, args=(process.stdin, int(60 * FPS * asked.minutes))),
        threading.Thread(target=lambda: lines.extend(process.stdout)),
    ]
    for one in threads:
        one.start()
    return told("stream, predictions", watch(process, lambda: len(lines), max(asked.minutes * 0.2, 0.2)))


def samples(folder: Path, asked: argparse.Namespace) -> bool:
    """Converts many tiny samples; what is done is read from the size of the unfinished file's journal."""
    raw = folder / "raw"
    if not raw.is_dir():
        _write_samples(raw, asked.samples)
    (folder / "many.h5").unlink(missing_ok=True)
    words = dpc("prepare", "clouds", raw, "-o", "many.h5", "--jobs", os.cpu_count() or 1, "--force")
    process = subprocess.Popen(words, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    looks = watch(process, lambda: _journaled(folder / ".many.h5.part"), 0.5)
    return told(f"prepare, {asked.samples} samples, bytes of the journal", looks)


def _journaled(journal: Path) -> int:
    return journal.stat().st_size if journal.exists() else 0


def _write_samples(raw: Path, count: int) -> None:
    rng = np.random.default_rng(0)
    for sample in range(count):
        (raw / f"s{sample:06d}").mkdir(parents=True)
        for frame in range(3):
            np.save(raw / f"s{sample:06d}" / f"{frame}.npy", rng.random((8, 3), np.float32))


def shards(folder: Path, asked: argparse.Namespace) -> bool:
    """Merges many shards of one conversion."""
    rng, paths = np.random.default_rng(0), []
    entry = record({"items": asked.samples}, 0)
    for index in range(asked.shards):
        shard = Shard(index, asked.shards)
        paths.append(folder / f"shard{index:03d}.h5")
        provenance = [describe_shard(entry, shard)]
        with CloudsWriter(paths[-1], class_names=["a"], provenance=provenance, force=True) as writer:
            places = shard.places(asked.samples)
            for sample in places:
                frames = [rng.random((8, 3), np.float32) for _ in range(3)]
                writer.write(CloudSequence.from_frames(f"s{sample:06d}", frames, label=0))
            writer.positions = (list(places), [])
    words = dpc("prepare", "merge", *paths, "-o", "merged.h5", "--force")
    process = subprocess.Popen(words, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return told(
        f"merge, {asked.shards} shards, bytes of the journal",
        watch(process, lambda: _journaled(folder / ".merged.h5.part"), 0.2),
    )


def main() -> int:
    """Runs what is asked for; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--samples", type=int, default=60_000)
    parser.add_argument("--shards", type=int, default=256)
    parser.add_argument("--only", choices=["stream", "samples", "shards"])
    asked = parser.parse_args()
    folder = asked.folder.absolute()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    os.environ["PYTHONPATH"] = str(Path(__file__).parents[2])
    runs = {"samples": samples, "shards": shards, "stream": stream}
    flat = [run(folder, asked) for name, run in runs.items() if asked.only in (None, name)]
    return 0 if all(flat) else 1


if __name__ == "__main__":
    sys.exit(main())
