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
from dataclasses import dataclass
from pathlib import Path

from dpcli.reproduce.runs import cut, dpc

METRICS = ("ap", "pq", "f1", "pre", "rec", "miou", "ri")
_BOTH = ("--set", "consensus=none", "--set", "motion_head=false")
_PAST = ("--set", "flow_decay=1", *_BOTH)
_CURRENT = ("--set", "flow_decay=0", *_BOTH)


@dataclass(frozen=True)
class Row:
    """Holds one line of the table: what is switched, and the thesis's AP, PQ, F1, Pre, Rec, mIoU, RI in percent."""

    name: str
    words: tuple[str, ...]
    thesis: tuple[float, ...]


ROWS = {
    "plain": Row(
        "no SE(3) features, past flow", ("--set", "group=trivial", *_PAST), (45.2, 44.2, 58.9, 53.8, 65.1, 60.9, 71.2)
    ),
    "global": Row(
        "SE(3), pooled per cloud, past flow",
        ("--set", "pooling=global", *_PAST),
        (51.7, 50.0, 65.8, 64.7, 67.0, 61.6, 72.3),
    ),
    "past": Row("SE(3), pooled per point, past flow", _PAST, (55.3, 52.8, 68.3, 65.9, 70.0, 62.3, 72.7)),
    "current": Row("the same, current flow", _CURRENT, (54.8, 52.0, 67.6, 66.0, 69.3, 63.5, 73.8)),
    "both": Row("the same, past and current flow", _BOTH, (57.0, 51.6, 67.3, 63.8, 71.1, 63.1, 73.2)),
    "full": Row("the same and consensus", (), (63.8, 61.3, 77.3, 84.2, 71.3, 63.7, 75.4)),
}
_FIRST = "full"  # trained first: it estimates the first flows that the others take over


def run_row(key: str, train: Path, test: Path, folder: Path, budget: list[str], protocol: str, split: str) -> dict:
    """Trains, predicts and judges one row as far as it isn't done; returns metrics as shares of 1, None for 0/0."""
    model, parts = folder / key, folder / f"{key}.h5"
    first = [] if key == _FIRST else ["--set", f"flows_of={folder / _FIRST}"]
    dpc("segment", "train", train, "-o", model, *budget, *ROWS[key].words, *first)
    dpc("segment", "predict", test, "-o", parts, "--model", model, "--split", split)
    told = dpc("evaluate", "segmentation", parts, "--truth", test, "--split", split, "--protocol", protocol, "--json")
    return json.loads(told)["metrics"]


def table(found: dict[str, dict], about: str) -> str:
    """Returns Markdown: thesis / ours in percent for every row, a dash where a row has not been run or is undefined."""
    lines = ["| |" + "|".join(f" {name.upper()} " for name in METRICS) + "|", "|---|" + "---|" * len(METRICS)]
    for key, row in ROWS.items():
        own = found.get(key, {})
        cells = (
            f" {theirs:.1f} / {'–' if own.get(name) is None else format(100 * own[name], '.1f')} "
            for name, theirs in zip(METRICS, row.thesis, strict=True)
        )
        lines.append(f"| {row.name} |" + "|".join(cells) + "|")
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
    unknown = [key for key in chosen if key not in ROWS]
    if unknown:
        parser.error(f"--rows: no row {unknown[0]!r}; there are {', '.join(ROWS)}")
    options.folder.mkdir(parents=True, exist_ok=True)
    found, target = {}, options.folder / "table.md"
    about = (
        f"Budget: `dpc segment train {' '.join(budget)}`; protocol {options.protocol}, split {options.split}, one seed."
    )
    for key in sorted(chosen if _FIRST in chosen else [_FIRST, *chosen], key=lambda key: key != _FIRST):
        print(f"table 4.1: {ROWS[key].name}", file=sys.stderr)
        found[key] = run_row(key, options.train, options.test, options.folder, budget, options.protocol, options.split)
        target.write_text(table(found, about))
    print(target.read_text(), end="")


if __name__ == "__main__":
    main()
