"""Table 3.1 of the thesis, ablations on NvGesture: what pretraining, surface normals and neighbors' weights are worth.

    python -m dpcli.reproduce.table_3_1 nvgesture|msraction3d RAW FOLDER [--modelnet FOLDER] [-- words of `dpc classify train`]

Networks share what the thesis says they share: rows ii, iv and vii are one network, v and vi train its dynamic stream
again on its static stream. Without --modelnet nothing can be pretrained, and the switches are tried on the network
trained from scratch, in lines of their own. Results: FOLDER/table.md, FOLDER/results.json. Stopped, it goes on.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dpcli.reproduce.accuracy_tables import EXPERIMENTS, Plan, Setting, add_plan, clips_of, clouds_of
from dpcli.reproduce.runs import (
    DASH,
    Cell,
    Dpc,
    beside,
    cut,
    dpc,
    markdown,
    numbers,
    samples,
    shares,
    thesis_rows,
    write_json,
    write_text,
)

DATA = {
    "nvgesture": (EXPERIMENTS["3.2"], EXPERIMENTS["3.2"].settings[0]),
    "msraction3d": (EXPERIMENTS["3.4"], next(one for one in EXPERIMENTS["3.4"].settings if one.key == "16")),
}
_SWITCH = {"normals": ("--set", "normals=false"), "weights": ("--set", "weighting=none")}


@dataclass(frozen=True)
class Row:
    """Holds a line: which network's which stream. number: the thesis's row, or nothing for a line it doesn't have."""

    number: str
    name: str
    network: str
    stream: str


ROWS = (
    Row("i.", "static, from scratch", "scratch", "static"),
    Row("ii.", "static, pretrained", "pretrained", "static"),
    Row("iii.", "dynamic, from scratch", "scratch", "dynamic"),
    Row("iv.", "dynamic, pretrained", "pretrained", "dynamic"),
    Row("v.", "both, pretrained, no ST-normals, no weights", "pretrained-normals", "fused"),
    Row("vi.", "both, pretrained, no weights", "pretrained-weights", "fused"),
    Row("vii.", "both, pretrained", "pretrained", "fused"),
)
PLAIN = (
    Row("", "like v., from scratch", "scratch-normals", "fused"),
    Row("", "like vi., from scratch", "scratch-weights", "fused"),
    Row("", "like vii., from scratch", "scratch", "fused"),
)


def network(plan: Plan, setting: Setting, name: str, seed: int, clouds: Path, folder: Path, start: Path | None) -> Cell:
    """Returns the cell of a network by its name: `scratch` or `pretrained`, and what is switched off."""
    base, _, switch = name.partition("-")
    words = list(setting.words)
    if switch:
        trained = network(plan, setting, base, seed, clouds, folder, start)
        words += ["--epochs", "0", "--set", f"static_from={trained.model}", *_SWITCH[switch]]
    elif base == "pretrained":
        words += ["--set", f"static_from={start}"]
    return plan.cell(Setting(name, "", setting.data, tuple(words), ""), seed, clouds, folder)


def pretrained(modelnet: str, folder: Path, preset: str, words: Sequence[str], run: Dpc) -> Path:
    """Trains the static stream on ModelNet40's single clouds."""
    shapes, out = folder / "modelnet40.h5", folder / f"{preset}-modelnet40"
    folder.mkdir(parents=True, exist_ok=True)
    run("prepare", "modelnet40", modelnet, "-o", shapes)
    said = ("--preset", preset, "--validation", "none", "--set", "pretrain=true", *words)
    run("classify", "train", shapes, "-o", out, *said)
    return out


def table(rows: Sequence[Row], found: Mapping[str, Sequence[dict]], about: Sequence[str]) -> str:
    """Returns markdown. found: by network, what its runs say."""
    thesis = {row["method"].partition("(")[2].rstrip(")"): row["values"][0] for row in thesis_rows("3.1")}
    lines = []
    for row in rows:
        own = found.get(row.network, [])
        line = (row.number or DASH, row.name, beside(thesis.get(row.number), shares(own, row.stream)))
        lines.append([*line, len(own) or DASH, samples(own)])
    said = "Thesis / ours, accuracy in percent of the test videos, mean ± standard deviation over runs (seeds)."
    header = ("row", "streams", "accuracy", "runs", "test videos")
    return "\n\n".join(["# Table 3.1: ablations", said, markdown(header, lines), *about]) + "\n"


def make(
    setting: Setting,
    clouds: Path,
    folder: Path,
    plan: Plan,
    seeds: Sequence[int],
    start: Path | None,
    about: Sequence[str] = (),
    run: Dpc = dpc,
) -> dict[str, list[dict]]:
    """Runs what isn't done, writes a table after every network. start: the pretrained static stream, None without."""
    rows = ROWS if start else tuple(row for row in ROWS if row.network == "scratch") + PLAIN
    notes = [*about, f"Ours: `dpc classify train --preset {plan.preset} --validation none {' '.join(plan.budget)}`."]
    if start is None:
        left = ", ".join(row.number.rstrip(".") for row in ROWS if row.network != "scratch")
        notes.append(
            f"Rows {left} need ModelNet40 (MODELNET=folder of modelnet40_ply_hdf5_2048) and are left out; the "
            "lines without a number are the same switches on networks trained from scratch."
        )
    found: dict[str, list[dict]] = {}
    for seed in seeds:
        for name in dict.fromkeys(row.network for row in rows):
            cell = network(plan, setting, name, seed, clouds, folder, start)
            found.setdefault(name, []).append(cell.run(run))
            write_json(folder / "results.json", {"table": "3.1", "about": notes, "networks": found})
            write_text(folder / "table.md", table(rows, found, notes))
    return found


def main(argv: Sequence[str] | None = None, run: Dpc = dpc) -> None:
    """Runs the program by its words; `run` does the commands."""
    own, budget = cut(argv)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", choices=list(DATA))
    parser.add_argument("--modelnet", default="", help="folder modelnet40_ply_hdf5_2048")
    parser.add_argument("--pretrain", default="", help="more words for the training on ModelNet40, such as --epochs 20")
    add_plan(parser)
    given = parser.parse_args(own)
    experiment, setting = DATA[given.data]
    folder, plan = given.folder, Plan(given.preset, clips_of(given.preset, given.clips), tuple(budget))
    clouds = clouds_of(given, experiment, run)
    start = None
    if given.modelnet:
        start = pretrained(given.modelnet, folder, given.preset, given.pretrain.split(), run)
    about = (
        []
        if given.data == "nvgesture"
        else ["Ours are on MSRAction-3D, 16 frames; the thesis's numbers are NvGesture's."]
    )
    make(setting, clouds, folder, plan, numbers(given.seeds), start, about, run)
    sys.stdout.write((folder / "table.md").read_text())


if __name__ == "__main__":
    main()
