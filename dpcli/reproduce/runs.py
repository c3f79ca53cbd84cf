"""The common parts of the tables' programs: `dpc` commands one after the other, cells done once, markdown.

A cell is one trained and scored network in a folder of its own. A stopped cell continues, a finished one is passed
over as long as it would be made from the same data by the same words.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from statistics import mean, stdev

from dpcli.evaluate.report.thesis_tables import thesis_tables
from dpcli.runtime.provenance import file_digest
from dpcli.runtime.signals import answering
from dpcli.runtime.whole_file import write_whole

Dpc = Callable[..., str]
STOPPED = (75, 130, 143)  # exit codes of a command that was asked to stop
DASH = "–"
_FORWARDED = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2, signal.SIGHUP)
_command = [sys.executable, "-m", "dpcli"]
_running: set[subprocess.Popen] = set()


def dpc(*words: object, threads: int | None = None) -> str:
    """Returns a command's stdout; ends this program with its exit code when it fails (75: stopped, run again).

    A signal to this program goes on to the command, which saves its work before it ends.
    """
    limits = {} if threads is None else {"OMP_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)}
    process = subprocess.Popen(
        [*_command, *map(str, words)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **limits},
        start_new_session=True,
    )
    _running.add(process)
    with answering(_FORWARDED, _forward):
        out, _ = process.communicate()
    _running.discard(process)
    if process.returncode:
        code = process.returncode if process.returncode > 0 else 128 - process.returncode
        print(f"dpc {' '.join(map(str, words))}: exit {code}", file=sys.stderr)
        sys.exit(code)
    return out


def _forward(number: int) -> None:
    for process in tuple(_running):
        process.send_signal(number)


def side_by_side(work: Mapping[str, Sequence[Callable[[], dict]]], jobs: int) -> dict[str, list[dict]]:
    """Returns what the calls of each row find, `jobs` of them at a time in threads.

    A signal goes on to every command that runs. After it, or once a call ends the program, no other call begins.
    """
    ended = threading.Event()

    def call(one: Callable[[], dict]) -> dict:
        if ended.is_set():
            sys.exit(STOPPED[0])
        try:
            return one()
        except BaseException:
            ended.set()
            raise

    def stop(number: int) -> None:
        ended.set()
        _forward(number)

    with answering(_FORWARDED, stop), ThreadPoolExecutor(jobs) as pool:
        running = {row: [pool.submit(call, one) for one in calls] for row, calls in work.items()}
        return {row: [job.result() for job in own] for row, own in running.items()}


def attempt(work: Callable[[], object], what: str) -> str:
    """Calls what may fail and returns why it failed, or nothing. Being asked to stop is no failure."""
    try:
        work()
    except SystemExit as ended:
        if ended.code in STOPPED:
            raise
        return f"{what} ended with exit code {ended.code}"
    return ""


def write_text(path: Path, text: str) -> None:
    """Writes a text file whole, in a folder that is made if need be; two jobs may write it at once."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, text.encode())


def write_json(path: Path, value: object) -> None:
    """Writes a value as JSON, whole."""
    write_text(path, json.dumps(value, indent=1) + "\n")


def kept(path: Path, key: list) -> dict | None:
    """Returns what `once` found before by the same key; None when it found nothing, or by another key."""
    try:
        before = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return before["found"] if before.get("key") == json.loads(json.dumps(key)) else None


def once(path: Path, key: list, work: Callable[[], dict]) -> dict:
    """Returns what `work` finds, from the JSON file `path` when it was found there before by the same key."""
    found = kept(path, key)
    if found is None:
        found = work()
        write_json(path, {"key": key, "found": found})
    return found


@lru_cache(maxsize=8)
def _digest(path: Path, size: int, changed: int) -> str:
    return file_digest(path)


def digest(path: Path) -> str:
    """Returns the digest of a file's bytes; read once a program. Ends the program with a sentence when it isn't there."""
    if not path.is_file():
        print(f"{path}: no such file", file=sys.stderr)
        sys.exit(3)
    told = path.stat()
    return _digest(path, told.st_size, told.st_mtime_ns)


def counted(run: Dpc, scores: Path, split: str = "test") -> dict:
    """Returns {"samples": n, "correct": {stream: n}} of a scores file; `fused` is its final score."""
    told = json.loads(run("evaluate", "classification", scores, "--split", split, "--resamples", 0, "--json"))
    return {"samples": told["denominators"]["samples"], "correct": told["denominators"]["correct"]}


class Cell:
    """Trains and scores one network: trained by `train` words on `clouds`, scored by `predict` words.

    What is found is kept in `folder`/result.json.
    """

    def __init__(self, folder: Path, clouds: Path, train: Sequence[object], predict: Sequence[object] = ()) -> None:
        self.folder, self.clouds = folder, clouds
        self.train, self.predict = [str(word) for word in train], [str(word) for word in predict]
        self.model, self.scores, self.result = folder / "model", folder / "scores.h5", folder / "result.json"
        self.trains = True

    def scored_again(self, name: str, *words: str) -> Cell:
        """Returns the same network, trained by now, scored with more words; files are called `name`."""
        other = Cell(self.folder, self.clouds, self.train, [*self.predict, *words])
        other.scores, other.result = self.folder / f"scores-{name}.h5", self.folder / f"result-{name}.json"
        other.trains = False
        return other

    @property
    def key(self) -> list:
        """Returns the data and the words, which must be equal for a result to stand."""
        return [digest(self.clouds), self.train, self.predict]

    def known(self) -> dict | None:
        """Returns what was found before, without doing anything."""
        return kept(self.result, self.key) if self.result.exists() else None

    def run(self, run: Dpc) -> dict:
        """Trains, predicts and counts, each only as far as it isn't done."""
        return once(self.result, self.key, lambda: self._work(run))

    def _work(self, run: Dpc) -> dict:
        print(f"tables: {self.scores}", file=sys.stderr)
        if self.trains:
            run("classify", "train", self.clouds, "-o", self.model, *self.train)
        words = ("--model", self.model, "-o", self.scores, "--split", "test", *self.predict)
        run("classify", "predict", self.clouds, *words)
        return counted(run, self.scores)


def override(words: Sequence[str], more: Sequence[str]) -> list[str]:
    """Returns the words of `dpc classify train` followed by `more`, without a `--set` that `more` gives again.

    >>> override(["--set", "draws=8", "--lr", "0.1"], ["--set", "draws=0"])
    ['--lr', '0.1', '--set', 'draws=0']
    """
    again = {name for name, _ in _settings(more)}
    left_out = {at + step for name, at in _settings(words) if name in again for step in (0, 1)}
    return [str(word) for at, word in enumerate(words) if at not in left_out] + [str(word) for word in more]


def _settings(words: Sequence[str]) -> list[tuple[str, int]]:
    """Returns the name of each setting that follows a `--set`, and the place of that `--set`."""
    pairs = enumerate(zip(words, words[1:]))
    return [(str(value).partition("=")[0], at) for at, (word, value) in pairs if word == "--set"]


def cut(argv: Sequence[str] | None) -> tuple[list[str], list[str]]:
    """Returns a program's own words, and those after `--`, which go to the `dpc` command that it runs."""
    words = list(sys.argv[1:] if argv is None else argv)
    where = words.index("--") if "--" in words else len(words)
    return words[:where], words[where + 1 :]


def refuse_unknown(
    parser: argparse.ArgumentParser, option: str, kind: str, words: Iterable[str], known: Collection[str]
) -> None:
    """Ends the program with a sentence where an option has a word, the name of a `kind`, that isn't known."""
    for word in words:
        if word not in known:
            parser.error(f"{option}: no {kind} {word!r}; there are {', '.join(known)}")


def numbers(text: str) -> list[int]:
    """Returns `0,1,2` as whole numbers; ends the program with a sentence otherwise."""
    try:
        return [int(word) for word in text.replace(" ", ",").split(",") if word]
    except ValueError:
        print(f"{text!r}: expected whole numbers such as 0,1,2", file=sys.stderr)
        sys.exit(2)


def sweeps(options: Sequence[str], known: Iterable[str], least: int = 0) -> dict[str, tuple[float, ...]]:
    """Returns the numbers, `least` or more, of options such as `group_size=2,4`; ends the program with a sentence for others."""
    values = {}
    for option in options:
        name, _, text = option.partition("=")
        try:
            values[name] = tuple(float(word) for word in text.split(",") if word)
        except ValueError:
            name = ""
        if name not in known or len(values[name]) < least:
            print(f"--sweep {option}: expected NAME=1,2,... with one of {', '.join(known)}", file=sys.stderr)
            sys.exit(2)
    return values


def shares(found: Sequence[dict], stream: str) -> list[float]:
    """Returns percent right of each run that has the stream."""
    return [100 * one["correct"][stream] / one["samples"] for one in found if stream in one["correct"]]


def spread(values: Sequence[float], digits: int = 2) -> str:
    """Returns `mean ± sd` over runs, n - 1 in the denominator; the value alone for one run, a dash for none."""
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return DASH
    middle = f"{mean(known):.{digits}f}"
    return f"{middle} ± {stdev(known):.{digits}f}" if len(known) > 1 else middle


def beside(theirs: float | None, ours: Sequence[float]) -> str:
    """Returns `thesis / ours`."""
    return f"{DASH if theirs is None else f'{theirs:.2f}'} / {spread(ours)}"


def samples(found: Sequence[dict]) -> str:
    """Returns the denominator of all runs: one number, or the several that occur."""
    return ", ".join(str(n) for n in sorted({one["samples"] for one in found})) or DASH


def thesis_rows(number: str) -> tuple[dict, ...]:
    """Returns the rows of a table of the thesis: method, setting, values, own."""
    return next(table.rows for table in thesis_tables() if table.number == number)


def thesis_numbers(number: str, ending: str = "") -> dict[str, list]:
    """Returns the values that a table of the thesis has for each method, by method and supervision: `network, unsupervised`.

    ending: of the settings that count; what follows the supervision in a setting, such as a data set, is left out.
    """
    rows = [row for row in thesis_rows(number) if row["setting"].endswith(ending)]
    names = ("network" if row.get("own") else row["method"] for row in rows)
    return {f"{name}, {row['setting'].partition(',')[0]}": row["values"] for name, row in zip(names, rows)}


def markdown(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Returns a markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)
