"""Every option of the commands below with odd values: none may end as a bug. `make fuzz`, or

    python -m tests.fuzz.fuzz_options FOLDER [--only WORD]

makes small data in FOLDER, then runs each command again and again in processes of their own, with 14 GB and a minute at
most. Prints what ended by a trace, a signal, for want of memory, or with the sentence that asks for --debug, and exits
with 1 if anything did. A command that runs into its minute did what it was asked for (10^11 steps).
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import typer

from dpcli.cli import app as cli
from dpcli.reproduce.runs import override
from dpcli.runtime.settings.value_types import words_of
from tests.fuzz.forks import Ended, Limits, forked
from tests.generate4d.test_fit import toy_views
from tests.support.commands import exit_code

LIMITS = Limits()
ODD = {
    "int": ("-1", "0", "1", "99999999999"),
    "float": ("nan", "inf", "-1", "0", "1e300"),
    "": ("", "foo", "nan", "-1", "0", ","),
}
LEFT_OUT = ("--help", "--output", "--force", "--json", "--set", "--config", "--help-all")
SETTINGS = {  # commands with settings -> where their catalog is
    "classify train": ("dpcli.classify.settings", "TRAINING"),
    "classify profile": ("dpcli.classify.settings", "NETWORK"),
    "classify explain pac": ("dpcli.classify.explain.pac_settings", "PAC"),
    "segment train": ("dpcli.segment.training.settings", "CATALOG"),
    "segment flow": ("dpcli.segment.flow.config", "CATALOG"),
    "segment predict": ("dpcli.segment.prediction_settings", "CATALOG"),
    "generate4d fit": ("dpcli.generate4d.config", "CATALOG"),
    "generate4d render": ("dpcli.generate4d.render_settings", "CATALOG"),
    "generate4d train-prior": ("dpcli.generate4d.shape.training.settings", "CATALOG"),
}
DATA = """
prepare synthetic gestures -o gestures.h5 --videos-per-class 2 --subjects 2 --frames 18 --points 200
prepare synthetic articulated -o objects.h5 --objects 2 --sequences-per-object 1
classify train gestures.h5 -o model --preset tiny --epochs 1 --set epochs_dynamic=1
classify predict gestures.h5 --model model -o scores.h5 --clips-per-video 1
classify predict gestures.h5 --model model -o others.h5 --clips-per-video 1 --seed 1
segment predict objects.h5 -o parts.h5 --fast --flow nearest --split all
generate4d fit views.h5 -o scene.h5 --preset tiny --size 16 --set dense_steps=1 --set sparse_steps=1
"""
COMMANDS = """
info gestures.h5
prepare synthetic gestures -o out/g.h5 --videos-per-class 1 --subjects 2 --frames 4 --size 40 --jobs 1
prepare synthetic articulated -o out/a.h5 --objects 1 --sequences-per-object 1 --jobs 1
prepare synthetic animal -o out/an.h5 --size 32 --frames 3 --train-azimuths 90 --azimuths 45
prepare depth depth.npy -o out/d.h5 --fov 60 --jobs 1
prepare clouds clouds -o out/c.h5 --jobs 1
prepare split gestures.h5 -o out/s.h5
prepare merge gestures.h5 -o out/m.h5
classify train gestures.h5 -o out/model --preset tiny --epochs 1 --set epochs_dynamic=1
classify predict gestures.h5 --model model -o out/p.h5 --clips-per-video 1
classify fuse scores.h5 -o out/f.h5
classify profile --preset tiny
classify explain pac gestures.h5 --model model -o out/pac.h5
classify explain tsne gestures.h5 --model model -o out/tsne.h5 --clips-per-video 1
segment train objects.h5 -o out/parts --flow nearest --points 48 --batch 2 --epochs 1 --set pairs_per_epoch=2
segment predict objects.h5 -o out/parts.h5 --fast --flow nearest
segment flow objects.h5 -o out/flow --steps 1 --batch 1
segment estimate-flow objects.h5 -o out/ef.h5 --flow nearest
segment profile
generate4d fit views.h5 -o out/scene.h5 --preset tiny --size 16 --set dense_steps=1 --set sparse_steps=1
generate4d render scene.h5 -o out/r.png
generate4d export scene.h5 --as ply -o out/ply
generate4d view scene.h5 -o out/v.html
evaluate classification scores.h5
evaluate segmentation parts.h5 --truth objects.h5
evaluate motion parts.h5 --truth objects.h5
evaluate video scene.h5 --truth views.h5
evaluate compare scores.h5 scores.h5
evaluate runs scores.h5 others.h5
"""


def ended(words: Sequence[str]) -> Ended:
    return forked(lambda: exit_code(*words), LIMITS)


def options_of(words: Sequence[str]) -> list[Any]:
    """Those with two dashes, of the command that the words begin with."""
    command, depth = typer.main.get_command(cli.application()), 0
    while getattr(command, "commands", None):
        command, depth = command.commands[words[depth]], depth + 1
    return [one for one in command.params if one.opts[-1].startswith("--")]


def odd(words: Sequence[str]) -> Iterator[list[str]]:
    """The command with each option in turn at each odd value."""
    for one in options_of(words):
        if one.opts[-1] in LEFT_OUT or getattr(one, "is_flag", False):
            continue
        kind = next(kind for kind in ODD if kind in str(one.type_descriptor.annotation))
        name, width = one.opts[-1], max(one.nargs, 1)
        rest = list(words)
        while name in rest:
            at = rest.index(name)
            del rest[at : at + 1 + width]
        for value in ODD[kind]:
            yield [*rest, name, *[value] * width]


def odd_settings(words: Sequence[str]) -> Iterator[list[str]]:
    """The command with each of its settings in turn at each odd value."""
    line = " ".join(words)
    for module, name in (place for begin, place in SETTINGS.items() if line.startswith(begin)):
        for setting in getattr(import_module(module), name).settings.values():
            kind = "float" if setting.hint is float else "int" if setting.hint is int else ""
            for value in (*ODD[kind], *words_of(setting.hint)):
                yield override(words, ["--set", f"{setting.name}={value}"])


def is_bug(code: int, said: str) -> bool:
    found = ("a bug, or", "Traceback", "not enough memory")
    return any(one in said for one in found) or (code < 0 and code != -signal.SIGALRM)


def forced(line: str) -> list[str]:
    words = line.split()
    return [*words, "--force"] if any(one.opts[-1] == "--force" for one in options_of(words)) else words


def make_data(folder: Path) -> None:
    (folder / "out").mkdir(parents=True, exist_ok=True)
    (folder / "clouds").mkdir(exist_ok=True)
    os.chdir(folder)
    rng = np.random.default_rng(0)
    np.save("depth.npy", rng.integers(1000, 2000, (5, 24, 32)).astype(np.uint16))
    for frame in range(3):
        np.save(f"clouds/{frame}.npy", rng.random((50, 3), np.float32))
    forked(lambda: bool(toy_views(Path("views.h5"), train=1)) - 1, LIMITS)
    for line in DATA.strip().splitlines():
        made = ended(forced(line))
        assert made.code == 0, (line, made.said)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="only commands that begin so")
    asked = parser.parse_args()
    make_data(asked.folder)
    calls = bugs = 0
    for line in COMMANDS.strip().splitlines():
        if not line.startswith(asked.only):
            continue
        made = ended(forced(line))
        assert made.code == 0, (line, made.said)
        for words in (*odd(forced(line)), *odd_settings(forced(line))):
            one = ended(words)
            calls += 1
            if is_bug(one.code, one.said):
                bugs += 1
                print(f"{' '.join(words)}\n    {one.code}: {one.said.strip().splitlines()[-1]}", flush=True)
        print(f"{calls} calls, {bugs} bugs after: {line}", flush=True)
    return 1 if bugs else 0


if __name__ == "__main__":
    sys.exit(main())
