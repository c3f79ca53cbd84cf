"""Figure 3.5 of the thesis: four settings of the dynamic stream, each swept with the others at the thesis's choice.

    python -m dpcli.reproduce.figure_3_5 nvgesture|msraction3d RAW FOLDER [--folds 10] [--sweep group_size=2,4] [-- words]
                                                                   [--only 0,1]: these folds now, a job each or several

N-fold cross-validation over the training videos; accuracy is the dynamic stream's alone, after its last epoch. A fold's
static stream is trained once for all settings that leave it as it is (both radii change its neighborhoods). Results:
FOLDER/table.md and results.json after every network, figure.png at the end. Stopped, it goes on where it was. Jobs may
share FOLDER once it is prepared, each with folds of its own; what a job writes shows all folds known to it.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dpcli.classify.presets import PRESETS
from dpcli.draw.sheet import new_figure, save_figure
from dpcli.reproduce.accuracy_tables import add_data, clouds_of
from dpcli.reproduce.runs import (
    DASH,
    Dpc,
    cut,
    digest,
    dpc,
    kept,
    markdown,
    numbers,
    once,
    override,
    sweeps,
    write_json,
    write_text,
)
from dpcli.reproduce.table_3_1 import DATA


@dataclass(frozen=True)
class Sweep:
    """Holds a setting of `dpc classify train`, its values, the thesis's choice. static: the static stream depends on it."""

    setting: str
    title: str
    values: tuple[float, ...]
    chosen: float
    static: bool = False


SWEEPS = {
    "reduction": Sweep("reduction", "(a) reduction ratio", (0.125, 0.25, 0.5, 1.0), 0.5),
    "group_size": Sweep("group_size", "(b) group size", (2, 4, 8, 16, 32), 4),
    "temporal_radius": Sweep("temporal_radius", "(c) temporal radius, frames", (0, 1, 2, 3, 4, 5), 1, True),
    "radius": Sweep("radius", "(d) spatial radius", (0.125, 0.25, 0.5, 1.0, 2.0), 0.5, True),
}


@dataclass(frozen=True)
class Point:
    """Holds one choice of the four settings, in the order of SWEEPS."""

    values: tuple[float, ...]

    def words(self, static: bool = False) -> list[str]:
        """Returns the words of `train`; for the static stream only those that it depends on."""
        return [word for name, value in self._pairs(static) for word in ("--set", f"{name}={_written(name, value)}")]

    def name(self, static: bool = False) -> str:
        """Returns the name of the folder of this choice's networks."""
        return "-".join(f"{name}-{value:g}" for name, value in self._pairs(static))

    def _pairs(self, static: bool) -> list[tuple[str, float]]:
        return [(s.setting, value) for s, value in zip(SWEEPS.values(), self.values) if s.static or not static]


def _written(name: str, value: float) -> str:
    """Returns a setting's value in words; the spatial radius doubles in the second stage."""
    return f"{value:g},{2 * value:g}" if name == "radius" else f"{value:g}"


def point(changed: str = "", value: float = 0) -> Point:
    """Returns the thesis's choice, with one setting changed."""
    return Point(tuple(value if key == changed else sweep.chosen for key, sweep in SWEEPS.items()))


def last_accuracy(folder: Path, stage: str) -> dict:
    """Returns the validation accuracy of a training folder's stage after its last epoch, and the best of all epochs."""
    rows = [row for row in json.loads((folder / "log.json").read_text()) if row["stage"] == stage]
    known = [row["validation_accuracy"] for row in rows if row["validation_accuracy"] is not None]
    return {"last": known[-1], "best": max(known), "epochs": len(rows)}


@dataclass(frozen=True)
class Fold:
    """Trains networks of one fold. which: from 0; of: how many folds there are."""

    which: int
    of: int
    clouds: Path
    folder: Path
    words: tuple[str, ...]  # preset, budget, clips

    def train(self, run: Dpc, out: Path, *words: str) -> None:
        """Trains a network of the fold by the words after the common ones."""
        held_out = ("--validation", f"fold:{self.which}/{self.of}")
        run("classify", "train", self.clouds, "-o", out, *override(self.words, words), *held_out)

    def _key(self, words: Sequence[str]) -> list:
        return [digest(self.clouds), self.words, words]

    def _once(self, run: Dpc, out: Path, stage: str, *words: str) -> dict:
        def work() -> dict:
            """Trains the network; returns its accuracy."""
            print(f"figure 3.5: {out}", file=sys.stderr)
            self.train(run, out, *words)
            return last_accuracy(out, stage)

        return once(out / "result.json", self._key(words), work)

    def _places(self, at: Point) -> tuple[Path, Path, list[str]]:
        """Returns the folders of the static and of the dynamic stream, and the latter's words."""
        place = self.folder / f"fold{self.which}-of-{self.of}"
        static = place / f"static-{at.name(static=True)}"
        return (
            static,
            place / at.name(),
            [*at.words(), "--epochs", "0", "--set", f"static_from={static / 'last.safetensors'}"],
        )

    def known(self, at: Point) -> dict | None:
        """Returns what `accuracy` found before, without doing anything."""
        _, out, words = self._places(at)
        return kept(out / "result.json", self._key(words))

    def accuracy(self, run: Dpc, at: Point) -> dict:
        """Returns the dynamic stream's accuracy at one choice of settings, trained where it isn't, on the fold's static stream."""
        static, out, words = self._places(at)
        self._once(run, static, "static", *at.words(static=True), "--set", "epochs_dynamic=0")
        return self._once(run, out, "dynamic", *words)


def quartiles(values: Sequence[float]) -> list[float]:
    """Returns lowest, first quartile, median, third quartile, highest.

    >>> quartiles([3, 1, 2, 5, 4])
    [1.0, 2.0, 3.0, 4.0, 5.0]
    """
    return np.percentile(values, (0, 25, 50, 75, 100)).tolist()


Found = Mapping[str, Mapping[float, Sequence[float]]]  # sweep -> value -> percent right of each fold


def table(found: Found, about: str) -> str:
    """Returns markdown: the boxes of the figure as numbers."""
    header = (
        "setting",
        "value",
        "folds",
        "lowest",
        "first quartile",
        "median",
        "third quartile",
        "highest",
        "thesis's choice",
    )
    lines = []
    for key, columns in found.items():
        for value, accuracies in columns.items():
            box = [f"{one:.2f}" for one in quartiles(accuracies)] if accuracies else [DASH] * 5
            mark = "yes" if value == SWEEPS[key].chosen else ""
            lines.append((SWEEPS[key].title, f"{value:g}", len(accuracies) or DASH, *box, mark))
    said = "Accuracy of the dynamic stream alone, percent of a fold's videos. The thesis draws its numbers and prints none: it "
    said += "chooses 50 %, 4, 1 and 0.5 as the values beyond which nothing is gained."
    return "\n\n".join(["# Figure 3.5: settings of the dynamic stream", said, markdown(header, lines), about]) + "\n"


def picture(found: Found, path: Path) -> None:
    """Draws four panels of boxes over folds, the thesis's choice filled."""

    figure = new_figure(11, 7)
    for panel, (key, columns) in enumerate(found.items()):
        axes = figure.add_subplot(2, 2, panel + 1)
        known = {value: accuracies for value, accuracies in columns.items() if accuracies}
        if known:
            boxes = axes.boxplot(list(known.values()), patch_artist=True, medianprops={"color": "black"})
            for box, value in zip(boxes["boxes"], known):
                box.set_facecolor("tab:orange" if value == SWEEPS[key].chosen else "white")
        words = [f"{100 * value:g} %" if key == "reduction" else f"{value:g}" for value in known]
        axes.set_xticks(range(1, len(known) + 1), words)
        axes.set(title=SWEEPS[key].title, ylabel="dynamic stream, accuracy (%)")
        axes.grid(axis="y", color="0.9")
    figure.suptitle("Orange: the thesis's choice")
    save_figure(figure, path, 120)


def make(
    clouds: Path,
    folder: Path,
    words: Sequence[str],
    values: Mapping[str, Sequence[float]],
    folds: int,
    only: Sequence[int],
    run: Dpc = dpc,
    note: str = "",
) -> dict[str, dict[float, list[float]]]:
    """Trains every value of the folds `only`, a fold after the other; writes a table after each network.

    words: preset, budget. Shown and returned are the other folds' networks, too, as far as another job has finished them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    everyone = [Fold(which, folds, clouds, folder, tuple(words)) for which in range(folds)]
    about = f"Ours: `dpc classify train {' '.join(words)}`, {folds} folds of the training videos, one seed, the last epoch.{note}"

    def look() -> dict[str, dict[float, list[float]]]:
        """Returns what is known so far, in percent by sweep and value."""
        known = {
            key: {one: [fold.known(point(key, one)) for fold in everyone] for one in own} for key, own in values.items()
        }
        return {
            key: {value: [100 * one["last"] for one in folds if one is not None] for value, folds in columns.items()}
            for key, columns in known.items()
        }

    try:
        for fold in (everyone[which] for which in only):
            for key, value in ((key, value) for key, own in values.items() for value in own):
                fold.accuracy(run, point(key, value))
                found = look()
                write_json(folder / "results.json", {"figure": "3.5", "about": about, "accuracy": found})
                write_text(folder / "table.md", table(found, about))
    finally:  # of what is there when stopped, too
        picture(look(), folder / "figure.png")
    return look()


def swept(options: Sequence[str]) -> dict[str, tuple[float, ...]]:
    """Returns the values of each sweep: `group_size=2,4` replaces a sweep's own, `group_size=` leaves it out."""
    values = {key: sweep.values for key, sweep in SWEEPS.items()} | sweeps(options, SWEEPS)
    return {key: own for key, own in values.items() if own}


def possible(values: Mapping[str, Sequence[float]], preset: str) -> tuple[dict[str, tuple[float, ...]], str]:
    """Returns the values that a preset's network can have, and a sentence about those left out."""
    config = PRESETS[preset]["network"]
    if not config.xyz_group:
        return dict(values), ""
    kept = {key: tuple(one for one in own if key != "group_size" or one >= 3) for key, own in values.items()}
    left = [one for one in values.get("group_size", ()) if one < 3]
    told = f" Group size {', '.join(f'{one:g}' for one in left)} is left out: preset {preset} fits one group to the coordinates, "
    return {key: own for key, own in kept.items() if own}, told + "which are three." if left else ""


def main(argv: Sequence[str] | None = None, run: Dpc = dpc) -> None:
    """Runs the program by its words; `run` does the commands."""
    own, budget = cut(argv)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", choices=list(DATA))
    add_data(parser)
    parser.add_argument("--folds", type=int, default=10)
    parser.add_argument("--only", default="", help="some of the folds, from 0: 0,1,2")
    parser.add_argument("--sweep", action="append", default=[], help="NAME=values; NAME= leaves a sweep out; repeat")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(own)
    experiment, setting = DATA[given.data]
    values = swept(given.sweep)
    only = numbers(given.only) if given.only else range(given.folds)
    if not set(only) <= set(range(given.folds)):
        parser.error(
            f"--only {given.only}: expected folds from 0 to {given.folds - 1} (--folds {given.folds}), such as 0,1"
        )
    clouds = clouds_of(given, experiment, run)
    words = ["--preset", given.preset, *setting.words, *budget, "--seed", str(given.seed)]
    values, note = possible(values, given.preset)
    make(clouds, given.folder, words, values, given.folds, only, run, note)
    sys.stdout.write((given.folder / "table.md").read_text())


if __name__ == "__main__":
    main()
