"""Commands killed with -9 at random moments and run again: whatever was killed, the end is that of one plain run.

    make kills [KILLS=100] [SEED=1] [ONLY=word]
    python -m tests.fuzz.fuzz_kills FOLDER [--kills 100] [--seed 1] [--only WORD]

makes small data in FOLDER, runs each command once, then again and again: killed one to three times (the whole group, the
command alone, or one of its workers), then to its end. Counts it as a fault when a file under the final name is not that of
the plain run, when a run has lost samples that the run before it had kept, when the last run fails or says of a bug, when
its result is another, and when it leaves files beside. Prints a table and the faults; exits with 1 if there are any.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from tests.generate4d.test_fit import toy_views
from tests.support.sessions import members, workers_of

ROOT = Path(__file__).resolve().parents[2]
LONGEST = 300  # seconds of a run
DATA = """
prepare synthetic gestures -o gestures.h5 --videos-per-class 2 --subjects 2 --frames 18 --points 200
prepare synthetic articulated -o objects.h5 --objects 6 --sequences-per-object 2
prepare synthetic gestures -o part-0.h5 --videos-per-class 20 --frames 10 --size 64 --shard 0/2
prepare synthetic gestures -o part-1.h5 --videos-per-class 20 --frames 10 --size 64 --shard 1/2
classify train gestures.h5 -o model --preset tiny --epochs 1 --set epochs_dynamic=1
segment predict objects.h5 -o parts.h5 --method network --flow nearest
classify predict gestures.h5 --model model -o scores.h5 --clips-per-video 1
"""
COMMANDS = """
prepare: prepare synthetic gestures -o OUT.h5 --videos-per-class 10 --frames 12 --size 64 --jobs 2
merge: prepare merge part-1.h5 part-0.h5 -o OUT.h5
classify train: classify train gestures.h5 -o OUT --preset tiny --epochs 2 --set epochs_dynamic=2
segment train: segment train objects.h5 -o OUT --flow nearest --points 48 --batch 2 --epochs 4 --set pairs_per_epoch=8
classify predict: classify predict gestures.h5 --model model -o OUT.h5 --split all --jobs 2
segment predict: segment predict objects.h5 -o OUT.h5 --method network --flow nearest --jobs 2
estimate-flow: segment estimate-flow objects.h5 -o OUT.h5 --jobs 2 --points 200
fit: generate4d fit views.h5 -o OUT.h5 --preset tiny --size 16 --set dense_steps=300 --set sparse_steps=300
evaluate: evaluate segmentation parts.h5 --truth objects.h5 --split all -o OUT.h5 --jobs 2
report: evaluate report parts.h5 scores.h5 --truth objects.h5 --split all -o OUT.html
"""


@dataclass
class Tally:
    """Counts what happened to one command; `faults` says what must not happen."""

    kills: Counter = field(default_factory=Counter)
    continued: int = 0
    faults: list[str] = field(default_factory=list)


def start(folder: Path, words: list[str]) -> subprocess.Popen:
    """Starts a command in a session of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "dpcli", *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
        text=True,
    )


def run(folder: Path, words: list[str]) -> tuple[int, str, float]:
    """Runs a command to its end; returns its exit code, what it said, and how long it took."""
    began, process = time.monotonic(), start(folder, words)
    try:
        _, said = process.communicate(timeout=LONGEST)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        _, said = process.communicate()
        said += f"\n(ran into {LONGEST} s)"
    return process.returncode, said, time.monotonic() - began


def fingerprint(path: Path) -> str:
    """Returns a digest of a result: a file's bytes; of a scene, which tells how long it took, the data sets; of a folder the weights."""
    if path.is_dir():
        names = sorted(path.glob("*.safetensors"))
        return hashlib.sha256(b"".join(tensors(name) for name in names)).hexdigest()
    if path.suffix == ".h5":
        with h5py.File(path) as file:
            if file.attrs["dpc_kind"] == "gaussians":
                sets = sorted(name for name in file if name != "provenance" and isinstance(file[name], h5py.Dataset))
                return hashlib.sha256(b"".join(np.asarray(file[name][()]).tobytes() for name in sets)).hexdigest()
    return hashlib.sha256(path.read_bytes()).hexdigest()


def tensors(path: Path) -> bytes:
    from safetensors.numpy import load_file

    return b"".join(name.encode() + array.tobytes() for name, array in sorted(load_file(path).items()))


def leftovers(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name.startswith("."))


def kill(process: subprocess.Popen, how: str, rng: np.random.Generator) -> bool:
    """Kills a session's whole group, the command alone, or one of its workers; returns whether anything was there to kill."""
    if process.poll() is not None:
        return False
    workers = workers_of(process.pid)
    if how == "worker" and not workers:
        how = "group"
    if how == "group":
        os.killpg(process.pid, signal.SIGKILL)
    else:
        os.kill(int(rng.choice(workers)) if how == "worker" else process.pid, signal.SIGKILL)
    return True


def killed_run(folder: Path, words: list[str], after: float, how: str, rng: np.random.Generator) -> tuple[bool, str]:
    """Starts a command and kills it after some seconds; returns whether it was there to be killed, and what it said."""
    process = start(folder, words)
    try:
        _, said = process.communicate(timeout=after)
        return False, said
    except subprocess.TimeoutExpired:
        hit = kill(process, how, rng)
    try:  # one that lost a worker goes on to its end
        _, said = process.communicate(timeout=LONGEST)
    except subprocess.TimeoutExpired:
        said = ""
    end = time.monotonic() + 20
    while members(process.pid) and time.monotonic() < end:
        time.sleep(0.02)
    return hit, said


class Round:
    """Kills one command some times in a fresh folder, and runs it to its end."""

    def __init__(self, data: Path, name: str, words: list[str], whole: str, seconds: float, tally: Tally) -> None:
        self.name, self.whole, self.seconds, self.tally = name, whole, seconds, tally
        self.folder = data / "round"
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir()
        self.out = self.folder / next(word for word in words if word.startswith("OUT"))
        self.words = [str(self.out) if word.startswith("OUT") else word for word in words]
        self.kept = 0

    def fault(self, what: str) -> None:
        self.tally.faults.append(f"{self.name}: {what}")
        print(f"  FAULT {self.tally.faults[-1]}", flush=True)

    def run(self, kills: int, rng: np.random.Generator) -> None:
        """Kills so many times at most, then lets it end."""
        for _ in range(kills):
            how = str(rng.choice(["group", "command", "worker"]))
            hit, said = killed_run(self.folder.parent, self.words, rng.uniform(0.2, 1.05) * self.seconds, how, rng)
            self.tally.kills[how] += hit
            self.look(said)
            if self.finished():
                break
        self.end()

    def finished(self) -> bool:
        return self.out.exists() and not self.out.is_dir()

    def look(self, said: str) -> None:
        """Checks what lies under the final name, and that nothing kept before is lost."""
        if self.finished() and fingerprint(self.out) != self.whole:
            self.fault("a file under the final name is not that of a plain run")
        told = re.search(r"continuing: (\d+) of", said)
        if told:
            self.tally.continued += 1
            if int(told[1]) < self.kept:
                self.fault(f"had kept {self.kept} samples, then {told[1]}")
            self.kept = int(told[1])
        if "a bug" in said or "Traceback" in said:
            self.fault(f"said {said[-300:]!r}")

    def end(self) -> None:
        """Runs it to its end, and compares that with the plain run."""
        if not (self.finished() and self.out.suffix == ".html"):  # a page that is there is not written again
            code, said, _ = run(self.folder.parent, self.words)
            self.look(said)
            if code:
                self.fault(f"ended with {code}: {said[-300:]!r}")
                return
        if fingerprint(self.out) != self.whole:
            self.fault("its result is not that of a plain run")
        if leftovers(self.folder):
            self.fault(f"left {', '.join(leftovers(self.folder))}")


def make_data(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "views.h5").exists():
        toy_views(folder / "views.h5", train=1)
    for line in DATA.strip().splitlines():
        code, said, _ = run(folder, [*shlex.split(line)])
        if code:
            sys.exit(f"{line}: {said}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    folder, rng = given.folder.resolve(), np.random.default_rng(given.seed)
    make_data(folder)
    commands = dict(line.split(": ", 1) for line in COMMANDS.strip().splitlines())
    chosen = {name: shlex.split(line) for name, line in commands.items() if given.only in name}
    plain: dict[str, tuple[str, float]] = {}
    tallies = {name: Tally() for name in chosen}
    while sum(sum(tally.kills.values()) for tally in tallies.values()) < given.kills:
        for name, words in chosen.items():
            if name not in plain:
                plain[name] = plain_run(folder, name, words)
            Round(folder, name, words, *plain[name], tallies[name]).run(int(rng.integers(1, 4)), rng)
        print(f"{sum(sum(tally.kills.values()) for tally in tallies.values())} kills", flush=True)
    sys.exit(print_table(tallies, given.seed))


def plain_run(folder: Path, name: str, words: list[str]) -> tuple[str, float]:
    """Runs a command once without a kill; returns the digest of its result and how long it took."""
    out = folder / f"plain-{name.replace(' ', '-')}{Path(next(w for w in words if w.startswith('OUT'))).suffix}"
    if out.is_dir():
        shutil.rmtree(out)
    out.unlink(missing_ok=True)
    code, said, seconds = run(folder, [str(out) if word.startswith("OUT") else word for word in words])
    if code:
        sys.exit(f"{name}: {said}")
    return fingerprint(out), seconds


def print_table(tallies: dict[str, Tally], seed: int) -> int:
    """Prints what happened to each command; returns the exit code."""
    print(
        f"\nseed {seed}\n{'command':18} {'kills':>6} {'group':>6} {'alone':>6} {'worker':>7} {'continued':>10} {'faults':>7}"
    )
    for name, tally in tallies.items():
        by = [tally.kills[how] for how in ("group", "command", "worker")]
        print(f"{name:18} {sum(by):6} {by[0]:6} {by[1]:6} {by[2]:7} {tally.continued:10} {len(tally.faults):7}")
    faults = [fault for tally in tallies.values() for fault in tally.faults]
    print(
        f"{sum(sum(tally.kills.values()) for tally in tallies.values())} kills, {len(faults)} faults",
        *faults,
        sep="\n  ",
    )
    return bool(faults)


if __name__ == "__main__":
    main()
