"""Tables 3.2 to 3.5 of the thesis: accuracy of both streams and of their fusion, over seeds, the thesis's beside ours.

    python -m dpcli.reproduce.accuracy_tables 3.4 RAW FOLDER [--seeds 0,1,2] [--only 16] [-- words of `dpc classify train`]

RAW is the data set's folder, for `dpc prepare`; or with --clouds a file of clouds made before. Results: FOLDER/table.md
and FOLDER/results.json, written again after every cell (a setting and a seed). Stopped, it goes on where it was.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from dpcli.counted import counted
from dpcli.reproduce.runs import (
    DASH,
    Cell,
    Dpc,
    beside,
    cut,
    dpc,
    markdown,
    numbers,
    override,
    refuse_unknown,
    samples,
    shares,
    spread,
    thesis_rows,
    write_json,
    write_text,
)
from dpcli.store import CloudsReader

STREAMS = ("static", "dynamic", "fused")
# the networks of 4 to 24 frames in docs/results.md were made so
MORE = "--epochs 15 --set epochs_dynamic=40 --lr 0.0005"
_RAW = "the data set's folder; - with --clouds"
EVERY_START = ("thesis", "release")  # presets that score every clip of a video by default; the others 8 spread over it


@dataclass(frozen=True)
class Setting:
    """Holds one line of a table. cites: how the setting of the thesis's rows ends; streams: what else the thesis says of it."""

    key: str
    name: str
    data: str  # which of the experiment's prepared files
    words: tuple[str, ...]
    cites: str
    streams: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Experiment:
    """Holds a table: how its data are prepared (file: words of `dpc prepare`) and which settings are trained on them."""

    number: str
    title: str
    prepare: Mapping[str, tuple[str, ...]]
    settings: tuple[Setting, ...]
    short: bool = False  # peers leave out videos shorter than a clip: scored that way too
    first: str = ""  # the setting whose network the others go on from, where a setting only differs in length


_GESTURES = ("--frames", "32", "--timing", "uniform", "--set", "normalize=image")  # facts of the peers' loaders
_NTU = ("--frames", "24")
EXPERIMENTS = {
    "3.2": Experiment(
        "3.2",
        "NvGesture",
        {"clouds": ("nvgesture",)},
        (Setting("kinet", "Kinet", "clouds", _GESTURES, "Point Cloud", {"static": 84.5, "dynamic": 82.4}),),
    ),
    "3.3": Experiment(
        "3.3",
        "SHREC'17",
        {"bbox": ("shrec17", "--bbox"), "no-bbox": ("shrec17", "--no-bbox")},
        (
            Setting("bbox", "bounding box yes", "bbox", _GESTURES, "bounding box yes", {"dynamic": 93.1}),
            Setting(
                "no-bbox", "bounding box no", "no-bbox", _GESTURES, "bounding box no", {"static": 86.5, "dynamic": 92.6}
            ),
        ),
    ),
    "3.4": Experiment(
        "3.4",
        "MSRAction-3D",
        {"clouds": ("msraction3d", "--points", "2048")},
        tuple(
            Setting(
                f"{n}",
                f"{n} frames",
                "clouds",
                ("--frames", f"{n}"),
                f", {n} frames",
                {"static": 84.30} if n == 16 else {},
            )
            for n in (4, 8, 12, 16, 24)
        ),
        short=True,
        first="16",
    ),
    "3.5": Experiment(
        "3.5",
        "NTU RGB+D 60",
        {
            "xsub": ("ntu60", "--protocol", "xsub", "--points", "2048"),
            "xview": ("ntu60", "--protocol", "xview", "--points", "2048"),
        },
        (
            Setting("xsub", "cross-subject", "xsub", _NTU, "cross-subject"),
            Setting("xview", "cross-view", "xview", _NTU, "cross-view"),
        ),
    ),
}


@dataclass(frozen=True)
class Plan:
    """Says how every cell is trained and scored. clips: per video at prediction, 0 = every start.

    first: the setting whose network of the same seed all others go on from, by the words `more` after the budget's own.
    """

    preset: str
    clips: int
    budget: tuple[str, ...]
    first: str = ""
    more: tuple[str, ...] = ()

    def cell(self, setting: Setting, seed: int, clouds: Path, folder: Path) -> Cell:
        """Returns the cell of a setting and a seed in its folder."""
        name, budget = f"{self.preset}-{setting.key}", self.budget
        if self.first and setting.key != self.first:
            start = folder / f"{self.preset}-{self.first}-seed{seed}" / "model"
            name, budget = f"{name}-from{self.first}", tuple(override(budget, ("--init", str(start), *self.more)))
        train = ("--preset", self.preset, "--validation", "none", *override(budget, setting.words), "--seed", seed)
        return Cell(folder / f"{name}-seed{seed}", clouds, train, ("--clips-per-video", self.clips, "--seed", seed))

    def __str__(self) -> str:
        """Returns what a reader has to type."""
        said = f"`dpc classify train {' '.join(['--preset', self.preset, '--validation none', *self.budget])}`"
        if not self.first:
            return said
        return (
            f"{said} at {self.first} frames, from whose network of the same seed the other lengths go on "
            f"(`--init`, `{' '.join(self.more)}`)"
        )


def too_short(clouds: Path, words: Sequence[str]) -> int:
    """Returns how many test videos have fewer frames than a clip."""
    with CloudsReader(clouds) as reader:
        counts = reader.frame_counts[[i for i, name in enumerate(reader.splits) if name == "test"]]
    return int((counts < int(words[words.index("--frames") + 1])).sum())


def score(
    run: Dpc, plan: Plan, experiment: Experiment, place: tuple[Setting, int, Path, Path], train: bool
) -> dict | None:
    """Returns what a cell says; without `train` only what is known already. `long`: only videos as long as a clip."""
    setting, _, clouds, _ = place
    found = plan.cell(*place).run(run) if train else plan.cell(*place).known()
    if found is None or not experiment.short:
        return found
    if not too_short(clouds, setting.words):
        return {**found, "long": found}
    cell = plan.cell(*place).scored_again("long", "--drop-short")
    return {**found, "long": cell.run(run) if train else cell.known() or {"samples": 0, "correct": {}}}


def peers(experiment: Experiment, setting: Setting) -> str:
    """Returns the methods and numbers that the thesis cites for the setting."""
    rows = [
        row for row in thesis_rows(experiment.number) if not row.get("own") and row["setting"].endswith(setting.cites)
    ]
    return ", ".join(f"{row['method']} {row['values'][0]:.2f}" for row in rows) or DASH


def thesis_value(experiment: Experiment, setting: Setting) -> float:
    """Returns Kinet's number in the thesis."""
    rows = thesis_rows(experiment.number)
    return next(row["values"][0] for row in rows if row.get("own") and row["setting"].endswith(setting.cites))


def table(experiment: Experiment, cells: Mapping[str, Mapping[int, dict]], about: str) -> str:
    """Returns markdown of what is there so far. cells: by setting and seed, what `score` said."""
    header = [
        "setting",
        *STREAMS,
        "runs",
        "test videos",
        *(["fused, short videos left out"] if experiment.short else []),
        "peers",
    ]
    rows = []
    for setting in experiment.settings:
        found = list(cells.get(setting.key, {}).values())
        theirs = {**setting.streams, "fused": thesis_value(experiment, setting)}
        row = [setting.name, *(beside(theirs.get(stream), shares(found, stream)) for stream in STREAMS)]
        row += [len(found) or DASH, samples(found)]
        if experiment.short:
            long = [one["long"] for one in found if one["long"]["samples"]]
            row.append(f"{spread(shares(long, 'fused'))} of {samples(long)}" if long else DASH)
        rows.append([*row, peers(experiment, setting)])
    title = f"# Table {experiment.number}: {experiment.title}"
    said = "Thesis / ours, accuracy in percent of the test videos, mean ± standard deviation over runs (seeds)."
    return "\n\n".join([title, said, markdown(header, rows), about]) + "\n"


def _rounds(
    experiment: Experiment, only: Sequence[str], seeds: Sequence[int], first: str = ""
) -> Iterator[tuple[Setting, int]]:
    """Yields every setting once, then again with the next seed: a table that is stopped early has all lines. `first` leads."""
    order = sorted(experiment.settings, key=lambda one: one.key != first)
    return ((one, seed) for seed in seeds for one in order if one.key in only or one.key == first)


def make(
    experiment: Experiment,
    clouds: Mapping[str, Path],
    folder: Path,
    plan: Plan,
    seeds: Sequence[int],
    only: Sequence[str],
    run: Dpc = dpc,
) -> dict[str, dict[int, dict]]:
    """Runs what isn't done; writes table.md and results.json after every cell. clouds: by name, the prepared files."""
    about = (
        f"Ours: {plan} and each line's own {', '.join(word for word in experiment.settings[0].words if word.startswith('--'))}; "
        f"{counted(plan.clips, 'clip') if plan.clips else 'every clip'} of a video scored. Thesis: its own data and budget"
        + (", mean of 10 runs." if experiment.short else ".")
    )
    cells: dict[str, dict[int, dict]] = {one.key: {} for one in experiment.settings}

    def look(setting: Setting, seed: int, train: bool) -> None:
        """Notes what a setting and a seed say, trained first if need be."""
        found = score(run, plan, experiment, (setting, seed, clouds[setting.data], folder), train)
        if found is not None:
            cells[setting.key][seed] = found

    for setting, seed in _rounds(experiment, [one.key for one in experiment.settings if one.data in clouds], seeds):
        look(setting, seed, train=False)
    for setting, seed in _rounds(experiment, only, seeds, plan.first):
        look(setting, seed, train=True)
        write_json(folder / "results.json", {"table": experiment.number, "about": about, "cells": cells})
        write_text(folder / "table.md", table(experiment, cells, about))
    return cells


def prepared(
    experiment: Experiment, raw: str, folder: Path, needed: Sequence[str], extra: Sequence[str], run: Dpc
) -> dict[str, Path]:
    """Returns the files of clouds that the settings need; `dpc prepare` passes over what is there."""
    files = {name: folder / f"{name}.h5" for name in needed}
    for name, path in files.items():
        reader, *words = experiment.prepare[name]
        folder.mkdir(parents=True, exist_ok=True)
        run("prepare", reader, raw, "-o", path, *words, *extra)
    return files


def add_data(parser: argparse.ArgumentParser, raw: str = _RAW) -> None:
    """Adds the data, whose help `raw` is, the folder of the results, and the options that every network has."""
    parser.add_argument("raw", help=raw)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--prepare", default="", help="more words for `dpc prepare`")
    parser.add_argument("--clouds", type=Path, help="a file of clouds to take instead of preparing RAW")


def clouds_of(given: argparse.Namespace, experiment: Experiment, run: Dpc) -> Path:
    """Returns the file of clouds that is named, or the one that RAW makes."""
    return (
        given.clouds or prepared(experiment, given.raw, given.folder, ["clouds"], given.prepare.split(), run)["clouds"]
    )


def add_plan(parser: argparse.ArgumentParser, raw: str = _RAW) -> None:
    """Adds what `add_data` does, and the options that every accuracy has."""
    add_data(parser, raw)
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument(
        "--clips", type=int, help="per video at prediction, 0 = every start; 8, or 0 for thesis and release"
    )


def clips_of(preset: str, given: int | None) -> int:
    """Returns the clips per video at prediction."""
    return given if given is not None else (0 if preset in EVERY_START else 8)


def main(argv: Sequence[str] | None = None, run: Dpc = dpc) -> None:
    """Runs the program by its words; `run` does the commands."""
    own, budget = cut(argv)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=list(EXPERIMENTS))
    parser.add_argument("--only", default="", help="some of the table's settings: 16, bbox, xsub ...")
    parser.add_argument("--from", dest="first", help="3.4: the length whose network the others go on from; 16, or none")
    parser.add_argument("--more", default=MORE, help=f"3.4: how they go on; {MORE}")
    add_plan(parser)
    given = parser.parse_args(own)
    experiment = EXPERIMENTS[given.table]
    known = [one.key for one in experiment.settings]
    only = given.only.replace(" ", ",").split(",") if given.only else known
    first = {None: experiment.first, "none": ""}.get(given.first, given.first)
    for option, keys in (("--only", only), ("--from", [first] if first else [])):
        refuse_unknown(parser, option, "setting", keys, known)
    if first and not experiment.first:
        parser.error(f"--from: the settings of table {experiment.number} don't go on from one another")
    needed = list(dict.fromkeys(one.data for one in experiment.settings if one.key in only))
    if given.clouds:
        clouds = dict.fromkeys(needed, given.clouds)
    else:
        clouds = prepared(experiment, given.raw, given.folder, needed, given.prepare.split(), run)
    plan = Plan(given.preset, clips_of(given.preset, given.clips), tuple(budget), first, tuple(given.more.split()))
    make(experiment, clouds, given.folder, plan, numbers(given.seeds), only, run)
    sys.stdout.write((given.folder / "table.md").read_text())


if __name__ == "__main__":
    main()
