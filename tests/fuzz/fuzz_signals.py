"""Every command gets every stop signal at many moments: one sentence and the exit code of the table, or it was done.

    python -m tests.fuzz.fuzz_signals FOLDER [--waits 0,0.05,0.1,0.2,0.5,1,2] [--only WORD]

makes small data in FOLDER (as fuzz_kills), and counts the seconds from the first line of `dpc` on: what Python answers
while it starts itself is Python's. Prints what ended otherwise, and exits with 1 if anything did.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from tests.cli.test_signals import CODES, STARTED
from tests.fuzz.fuzz_kills import COMMANDS, ROOT, make_data

LONGEST = 60  # seconds from the signal to the end
MORE = """
help: --help
info: info gestures.h5
split: prepare split part-0.h5 --fractions 0.5,0.25,0.25 -o OUT
animal: prepare synthetic animal --size 128 -o OUT.h5
evaluate classification: evaluate classification scores.h5 --split all
train-prior: generate4d train-prior -o OUT --steps 50
"""


def signal_once(folder: Path, words: list[str], number: signal.Signals, wait: float) -> str:
    """Runs a command, signals it after so many seconds, and returns what is wrong with its end, "" for nothing."""
    process = subprocess.Popen(
        [sys.executable, "-c", STARTED, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    process.stdout.read(1)
    time.sleep(wait)
    process.send_signal(number)
    try:
        said = process.communicate(timeout=LONGEST)[1].decode(errors="replace")
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return f"still there after {LONGEST} s"
    if any(word in said for word in ("Traceback", "a bug", "Exception")):
        return f"said {said[-300:]!r}"
    wrong = process.returncode not in (0, 2, 3) and process.returncode != CODES[number]
    # a command that was done, or had refused its input, before the signal came has its own end
    silent = process.returncode == CODES[number] and said.count("dpc: error:") != 1
    return f"ended with {process.returncode}: {said[-300:]!r}" if wrong or silent else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--waits", default="0,0.05,0.1,0.2,0.5,1,2")
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a shell's background jobs; commands would inherit it
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:  # as under nohup
        signal.signal(signal.SIGHUP, lambda number, frame: None)
    folder, faults, count = given.folder.resolve(), 0, 0
    if not (folder / "scores.h5").exists():
        make_data(folder)
    for line in (COMMANDS + MORE).strip().splitlines():
        name, _, words = line.partition(": ")
        for number in CODES if name and given.only in name else ():
            for wait in map(float, given.waits.split(",")):
                out = folder / "signaled"
                shutil.rmtree(out, ignore_errors=True)
                out.mkdir()
                chosen = [f"signaled/{word}" if word.startswith("OUT") else word for word in shlex.split(words)]
                wrong = signal_once(folder, chosen, number, wait)
                count, faults = count + 1, faults + bool(wrong)
                if wrong:
                    print(f"FAULT {name}, {number.name} after {wait} s: {wrong}", flush=True)
    print(f"{count} signals, {faults} faults")
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
