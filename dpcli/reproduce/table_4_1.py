"""Table 4.1 of the thesis: every switch of the part network trained with the same budget, the thesis's numbers beside ours.

    python -m dpcli.reproduce.table_4_1 TRAIN.h5 TEST.h5 FOLDER [--protocol dpc] [--rows ...] [-- words of `dpc segment train`]

TRAIN and TEST are clouds files with parts (`dpc prepare sapien`, or `synthetic articulated` for a trial). Each row is
a folder under FOLDER: a stopped run continues, a finished one is passed over, and what is there so far makes the table
FOLDER/table.md. All rows start from the same first flows. One seed each: small differences mean nothing.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from dpcli.reproduce.runs import DASH, cut, dpc, refuse_unknown, thesis_rows, write_text
from dpcli.reproduce.table_4_3 import METRICS

_BOTH = ("--set", "consensus=none", "--set", "motion_head=false")
_PAST = ("--set", "flow_decay=1", *_BOTH)
_CURRENT = ("--set", "flow_decay=0", *_BOTH)
ROWS = {  # in the thesis's order: what is switched, and the words that do it
    "plain": ("no SE(3) features, past flow", ("--set", "group=trivial", *_PAST)),
    "global": ("SE(3), pooled per cloud, past flow", ("--set", "pooling=global", *_PAST)),
    "past": ("SE(3), pooled per point, past flow", _PAST),
    "current": ("the same, current flow", _CURRENT),
    "both": ("the same, past and current flow", _BOTH),
    "full": ("the same and consensus", ()),
}
_FIRST = "full"  # trained first: it estimates the first flows that the others take over


def run_row(key: str, train: Path, test: Path, folder: Path, budget: list[str], protocol: str, split: str) -> dict:
    """Trains, predicts and judges one row as far as it isn't done; returns metrics as shares of 1, None for 0/0."""
    model, parts = folder / key, folder / f"{key}.h5"
    first = [] if key == _FIRST else ["--set", f"flows_of={folder / _FIRST}"]
    dpc("segment", "train", train, "-o", model, *budget, *ROWS[key][1], *first)
    dpc("segment", "predict", test, "-o", parts, "--model", model, "--split", split)
    told = dpc("evaluate", "segmentation", parts, "--truth", test, "--split", split, "--protocol", protocol, "--json")
    return json.loads(told)["metrics"]


def table(found: dict[str, dict], about: str) -> str:
    """Returns Markdown: thesis / ours in percent for every row, a dash where a row has not been run or is undefined."""
    lines = ["| |" + "|".join(f" {metric.upper()} " for metric in METRICS) + "|", "|---|" + "---|" * len(METRICS)]
    for (key, (name, _)), row in zip(ROWS.items(), thesis_rows("4.1"), strict=True):
        own = found.get(key, {})
        cells = (
            f" {theirs:.1f} / {DASH if own.get(metric) is None else format(100 * own[metric], '.1f')} "
            for metric, theirs in zip(METRICS, row["values"], strict=True)
        )
        lines.append(f"| {name} |" + "|".join(cells) + "|")
    return "\n".join(["Thesis / ours, percent.", "", *lines, "", about, ""])


def main(argv: list[str] | None = None) -> None:
    """Runs the rows that are asked for and writes the table after each."""
    own, budget = cut(argv)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("train", type=Path)
    parser.add_argument("test", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--protocol", default="dpc")
    parser.add_argument("--split", default="test")
    parser.add_argument("--rows", default=",".join(ROWS), help=f"some of {','.join(ROWS)}")
    options = parser.parse_args(own)
    chosen = options.rows.split(",")
    refuse_unknown(parser, "--rows", "row", chosen, ROWS)
    options.folder.mkdir(parents=True, exist_ok=True)
    found, target = {}, options.folder / "table.md"
    about = (
        f"Budget: `dpc segment train {' '.join(budget)}`; protocol {options.protocol}, split {options.split}, one seed."
    )
    for key in sorted(chosen if _FIRST in chosen else [_FIRST, *chosen], key=lambda key: key != _FIRST):
        print(f"table 4.1: {ROWS[key][0]}", file=sys.stderr)
        found[key] = run_row(key, options.train, options.test, options.folder, budget, options.protocol, options.split)
        write_text(target, table(found, about))
    print(target.read_text(), end="")


if __name__ == "__main__":
    main()
