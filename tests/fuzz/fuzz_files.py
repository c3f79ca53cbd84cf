"""Damaged files of every format through every command that reads files: each must be answered. `make fuzz`, or

    python -m tests.fuzz.fuzz_files FOLDER [--seed 0] [--inputs 10000] [--minutes 20] [--only "prepare depth"]

makes tiny inputs in FOLDER/seeds (seeds.py), damages copies of them (damage.py), runs each command in a fork of this
process on them (forks.py), and judges what came out (verdict.py): a trace, the sentence that asks for --debug, a signal,
20 s of CPU or 30 on the clock, 200 MB more memory than with the undamaged input, an output half written, an error without a
sentence, frames lost without a word, unprintable characters. One finding of each cause is made smaller (minimize.py)
and written to FOLDER/findings: cmd, in/, said.txt. Prints the seed and the counts; exits with 1 if anything was found.

No library does this: atheris and python-afl run a function in one process, whose C code a damaged file may end; Hypothesis
draws values, not files, and shrinks by drawing again. What is used of the idea is delta debugging, twenty lines.
"""

from __future__ import annotations

import argparse
import gc
import multiprocessing
import os
import random
import re
import resource
import shutil
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

from tests.fuzz.damage import Damage, draw
from tests.fuzz.forks import Ended, Limits, forked
from tests.fuzz.minimize import Budget, differences, edited, minimal
from tests.fuzz.seeds import cases, inputs_of, made_for, write_raw
from tests.fuzz.verdict import cause, faults
from tests.support.commands import exit_code

LIMITS = Limits(seconds=30, cpu=20, memory=3 << 30, file=100 << 20)
SEEDS_LIMITS = Limits(seconds=300)
TRIES, SECONDS = 60, 30  # at most, to make one finding smaller
COLLECTED = "sys.modules"  # file of the names of modules that the undamaged runs loaded


@dataclass(frozen=True)
class Case:
    """A command, the files of its inputs, and its run on them as they are."""

    words: tuple[str, ...]
    files: tuple[str, ...]
    seed: Ended

    @property
    def name(self) -> str:
        """Room and verb, without options and files."""
        return " ".join(self.words[: 2 if self.words[0] != "info" else 1])


@dataclass(frozen=True)
class Finding:
    """A damaged input that was answered badly."""

    case: Case
    damages: tuple[Damage, ...]
    cause: str
    ended: Ended


class Bench:
    """Runs cases on damaged copies of the seeds, in one scratch folder."""

    def __init__(self, seeds: Path, scratch: Path) -> None:
        self.seeds, self.scratch = seeds, scratch

    def lay(self, words: Sequence[str]) -> Path:
        """A fresh folder with in/, a copy of the inputs, and an empty out/."""
        shutil.rmtree(self.scratch, ignore_errors=True)
        (self.scratch / "in").mkdir(parents=True)
        (self.scratch / "out").mkdir()
        for name in inputs_of(list(words)):
            source, target = self.seeds / name, self.scratch / "in" / name
            (shutil.copytree if source.is_dir() else shutil.copyfile)(source, target)
        return self.scratch

    def run(self, words: Sequence[str], limits: Limits = LIMITS) -> Ended:
        """The command in the scratch folder."""
        return forked(lambda: exit_code(*words), limits, self.scratch)

    def judged(self, case: Case, damages: Sequence[Damage]) -> tuple[Ended, list[str]]:
        """The run on a copy with these damages, and the causes of what is wrong with it."""
        self.lay(case.words)
        for one in damages:
            one.apply(self.scratch / "in")
        return self.judged_as_laid(case)

    def judged_as_laid(self, case: Case) -> tuple[Ended, list[str]]:
        """The run on what lies in the scratch folder now, and its causes."""
        ended = self.run(case.words)
        found = list(faults(ended, case.seed, self.scratch))
        if found and ended.said and "--debug" in ended.said:  # once more, for the place
            shutil.rmtree(self.scratch / "out")
            (self.scratch / "out").mkdir()
            ended = replace(ended, said=self.run([*case.words, "--debug"]).said)
        return ended, [cause(one, ended) for one in found]


def make_seeds(folder: Path, chosen: list[list[str]]) -> None:
    """Writes the inputs of these commands, in forks, so that this process loads nothing that starts threads."""
    folder.mkdir(parents=True)
    made = forked(lambda: write_raw(folder) or 0, SEEDS_LIMITS)
    assert made.code == 0, made.said
    for line in made_for(chosen):
        made = forked(lambda line=line: exit_code(*line.split()), SEEDS_LIMITS, folder)
        assert made.code == 0, (line, made.said)
    for name in ("scores", "parts"):
        if (folder / f"{name}.h5").is_file():
            shutil.copyfile(folder / f"{name}.h5", folder / f"{name}2.h5")
    line = "evaluate classification scores.h5 --split all --resamples 0 --json"
    if (folder / "scores.h5").is_file():
        (folder / "result.json").write_text(forked(lambda: exit_code(*line.split()), SEEDS_LIMITS, folder).printed)


def _collecting(words: Sequence[str], modules: Path) -> int:
    code = exit_code(*words)
    with modules.open("w") as file:
        file.writelines(f"{name}\n" for name in list(sys.modules) if name.split(".")[0] not in LEFT_OUT)
    return code


# Not loaded before the forks: it starts threads, or is this program itself.
LEFT_OUT = {"open3d", "tests", "__main__", "__mp_main__"}


def load(modules: Path) -> None:
    """Imports here what a command imported, so that forks have it."""
    for name in modules.read_text().split():
        if name not in sys.modules:
            try:
                import_module(name)
            except Exception:  # a module that its package makes at run time, or one of another system
                pass


def prepared(bench: Bench, chosen: list[list[str]]) -> list[Case]:
    """The cases of these commands, each run once to load its modules and once more to be measured."""
    modules = bench.seeds / COLLECTED
    for words in chosen:
        bench.lay(words)
        ended = forked(lambda words=words: _collecting(words, modules), SEEDS_LIMITS, bench.scratch)
        assert ended.code == 0, (words, ended.said)
        load(modules)
    gc.freeze()  # a fork that collects would copy every page
    return [_measured(bench, words) for words in chosen]


def _measured(bench: Bench, words: list[str]) -> Case:
    folder = bench.lay(words) / "in"
    files = sorted(str(one.relative_to(folder)) for one in folder.rglob("*") if one.is_file())
    ended = bench.run(words)
    assert ended.code == 0, (words, ended.code, ended.said)
    return Case(tuple(words), tuple(files), ended)


def drawn(all_cases: Sequence[Case], seed: int, number: int) -> tuple[Case, list[Damage]]:
    """Input `number` of a seed, whatever was run before it; a command is drawn the oftener the quicker it is."""
    rng = random.Random(f"{seed}:{number}")
    case = rng.choices(all_cases, [1 / max(0.2, round(one.seed.seconds, 1)) for one in all_cases])[0]
    return case, draw(list(case.files), rng)


def fuzz(place: Path, all_cases: Sequence[Case], asked: argparse.Namespace, first: int, send) -> None:
    """Every second input, as (command, exit code, finding or None); None at the end."""
    bench, until = Bench(place / "seeds", place / f"run{first}"), time.monotonic() + 60 * asked.minutes
    for number in range(first, asked.inputs, asked.processes):
        if time.monotonic() > until:
            break
        case, damages = drawn(all_cases, asked.seed, number)
        ended, causes = bench.judged(case, damages)
        send.put((case.name, ended.code, [Finding(case, tuple(damages), one, ended) for one in causes]))
    shutil.rmtree(bench.scratch, ignore_errors=True)
    send.put(None)


def results(place: Path, all_cases: Sequence[Case], asked: argparse.Namespace) -> Iterator[tuple]:
    """What all processes send, as it comes. They are forks, as their runs are."""
    context = multiprocessing.get_context("fork")
    queue = context.SimpleQueue()
    workers = [
        context.Process(target=fuzz, args=(place, all_cases, asked, first, queue)) for first in range(asked.processes)
    ]
    for worker in workers:
        worker.start()
    running = len(workers)
    while running:
        got = queue.get()
        if got is None:
            running -= 1
        else:
            yield got
    for worker in workers:
        worker.join()


def smaller(bench: Bench, finding: Finding) -> Finding | None:
    """The finding with as little damage as has the same cause, laid out in the scratch folder; None if it doesn't recur."""
    budget = Budget(TRIES, SECONDS)

    def recurs(damages: Sequence[Damage]) -> bool:
        return finding.cause in bench.judged(finding.case, damages)[1]

    if not recurs(finding.damages):
        return None
    damages = minimal(finding.damages, budget.limited(recurs))
    recurs(damages)
    for path in dict.fromkeys(one.path for one in damages):
        _fewer_bytes(bench, finding, path, budget)
    return replace(finding, damages=tuple(damages))


def _fewer_bytes(bench: Bench, finding: Finding, path: str, budget: Budget) -> None:
    source, target = bench.seeds / path, bench.scratch / "in" / path
    if not target.is_file() or target.is_symlink():
        return
    old = source.read_bytes()
    edits = differences(old, target.read_bytes())

    def recurs(some: Sequence[tuple[int, int, bytes]]) -> bool:
        target.write_bytes(edited(old, some))
        shutil.rmtree(bench.scratch / "out")
        (bench.scratch / "out").mkdir()
        return finding.cause in bench.judged_as_laid(finding.case)[1]

    recurs(minimal(edits, budget.limited(recurs)))


def write_case(bench: Bench, finding: Finding, number: int, count: int, folder: Path) -> Path:
    """A folder with the command, the input and what came out."""
    place = folder / f"{number:03d}"
    place.mkdir(parents=True)
    shutil.copytree(bench.scratch / "in", place / "in", symlinks=True, ignore=_pipes)
    pipes = [one.relative_to(bench.scratch) for one in (bench.scratch / "in").rglob("*") if one.is_fifo()]
    first = "".join(f"mkfifo '{one}'; " for one in pipes)
    (place / "cmd").write_text(f"{first}dpc {' '.join(finding.case.words)}\n")
    ended = finding.ended
    about = f"{finding.cause}\n{count} inputs; {', '.join(f'{one.kind} {one.path}' for one in finding.damages)}\n"
    about += f"exit {ended.code}, {ended.seconds:.1f} s, {ended.memory >> 20} MB\n\n{ended.printed}\n{ended.said}"
    (place / "said.txt").write_text(about, errors="backslashreplace")
    return place


def _pipes(parent: str, names: list[str]) -> list[str]:
    return [name for name in names if (Path(parent) / name).is_fifo()]


def report(place: Path, asked: argparse.Namespace, all_cases: Sequence[Case]) -> int:
    """Fuzzes, prints the counts, writes a case for each cause; returns how many causes there are."""
    outcomes: dict[str, Counter] = {}
    found: dict[str, list[Finding]] = {}
    for done, (name, code, findings) in enumerate(results(place, all_cases, asked), start=1):
        outcomes.setdefault(name, Counter())["bad" if findings else f"exit {code}"] += 1
        for one in findings:
            if one.cause not in found:
                print(f"after {done} inputs: {one.cause}: {one.case.name}", flush=True)
            found.setdefault(one.cause, []).append(one)
        if done % 1000 == 0:
            print(f"{done} inputs", flush=True)
    for name, counts in sorted(outcomes.items()):
        print(f"{name:28} {sum(counts.values()):6}  " + ", ".join(f"{n} {what}" for what, n in sorted(counts.items())))
    bench = Bench(place / "seeds", place / "smaller")
    for number, (name, findings) in enumerate(sorted(found.items(), key=lambda entry: -len(entry[1]))):
        small = smaller(bench, findings[0]) or replace(findings[0], cause=f"{name} (does not recur)")
        where = write_case(bench, small, number, len(findings), place / "findings")
        print(f"{len(findings):6}  {small.cause}\n        {where}: dpc {' '.join(small.case.words)}", flush=True)
    shutil.rmtree(bench.scratch, ignore_errors=True)
    total = sum(sum(counts.values()) for counts in outcomes.values())
    bad = sum(counts["bad"] for counts in outcomes.values())
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(
        f"seed {asked.seed}: {total} inputs, {bad} bad, {len(found)} causes;"
        f" {used.ru_utime + used.ru_stime:.0f} s of processors, seeds and all"
    )
    return len(found)


def main(words: Sequence[str] | None = None) -> int:
    """Runs it; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--minutes", type=float, default=20, help="no new input after this time")
    parser.add_argument("--only", default="", help="only commands that begin so (a regular expression)")
    parser.add_argument("--processes", type=int, default=2)
    asked = parser.parse_args(words)
    place = asked.folder.absolute()
    for name in ("seeds", "findings"):
        shutil.rmtree(place / name, ignore_errors=True)
    os.environ["OMP_NUM_THREADS"] = "1"
    chosen = [words for words in cases() if re.match(asked.only, " ".join(words))]
    make_seeds(place / "seeds", chosen)
    all_cases = prepared(Bench(place / "seeds", place / "measured"), chosen)
    print(f"{len(all_cases)} commands on {sum(len(one.files) for one in all_cases)} files", flush=True)
    return 1 if report(place, asked, all_cases) else 0


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # what was loaded for the forks has threads that Python would wait for, forever
