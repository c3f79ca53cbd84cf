"""Tables 4.4 to 4.6 of the thesis: objects of KITTI's streets, every method that can be run on them.

    python -m dpcli.reproduce.street_tables FOLDER --kitti-sf RAW | --kitti-det RAW | --semantickitti RAW
        [--points 8192] [--methods ...] [--model TRAINED] [--limit N]

RAW is the data set as published. Single scans (4.5, 4.6) show no motion: only methods that need none are run on them,
and `scene` on windows of four scans (4.6). Each step is done once; FOLDER/table.md is written again after every method.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

from dpcli.reproduce import runs
from dpcli.reproduce.table_4_3 import rows, score
from dpcli.store import CloudsReader

JUDGING = ("--ignore-below", 50)  # as the thesis: smaller objects don't count
_WINDOW = ("--frames", 4)
_STILL = ("network", "ward", "dbscan")
_SF = ("multibody", "scene", "network", "ssc", "trajaffn", "ward", "dbscan")
_SK = {  # AP, PQ, F1, Pre, Rec, mIoU, RI in percent, by group of drives
    "all": {
        "OGC, supervised": (53.8, 41.3, 48.1, 40.1, 60.0, 68.3, 90.0),
        "network, supervised": (60.1, 47.6, 55.4, 48.6, 64.4, 71.9, 93.4),
        "OGC": (42.6, 30.2, 35.3, 28.2, 47.3, 60.3, 86.0),
        "network": (46.9, 31.6, 36.9, 29.0, 50.6, 63.2, 88.7),
    },
    "without-08": {
        "OGC, supervised": (55.3, 41.8, 48.4, 40.1, 61.1, 69.9, 90.3),
        "network, supervised": (60.5, 48.1, 55.6, 48.8, 64.7, 73.2, 93.8),
        "OGC": (43.6, 30.5, 35.5, 28.1, 48.2, 62.1, 86.3),
        "network": (47.4, 31.7, 36.8, 28.7, 51.0, 64.8, 89.3),
    },
    "only-08": {
        "OGC, supervised": (49.4, 39.2, 46.6, 40.0, 55.8, 60.3, 88.3),
        "network, supervised": (58.4, 46.0, 54.4, 47.8, 63.1, 65.8, 91.7),
        "OGC": (38.6, 29.1, 34.7, 28.6, 44.0, 51.8, 84.3),
        "network": (44.2, 31.0, 37.3, 30.0, 49.1, 55.8, 86.1),
    },
}
THESIS = {
    "kitti-sf": {
        "": {
            "OGC, supervised": (62.4, 52.7, 65.1, 63.4, 67.0, 67.3, 95.0),
            "network, supervised": (65.1, 56.3, 68.6, 69.4, 67.8, 69.5, 95.7),
            "trajaffn": (24.0, 30.2, 43.2, 37.6, 50.8, 48.1, 58.5),
            "ssc": (12.5, 20.4, 28.4, 22.8, 37.6, 41.5, 48.9),
            "ward": (25.0, 16.3, 22.9, 13.7, 69.8, 60.5, 44.9),
            "dbscan": (13.4, 22.8, 32.6, 26.7, 42.0, 42.6, 55.3),
            "OGC": (54.4, 42.4, 52.4, 47.3, 58.8, 63.7, 93.6),
            "network": (53.6, 44.4, 55.1, 56.3, 54.0, 61.5, 93.4),
        }
    },
    "kitti-det": {
        "": {
            "OGC, supervised": (51.4, 41.0, 49.1, 43.7, 56.0, 66.2, 91.0),
            "network, supervised": (52.5, 43.3, 51.8, 47.5, 57.0, 68.0, 92.6),
            "OGC": (40.5, 30.9, 37.0, 30.8, 46.5, 60.6, 86.4),
            "network": (41.3, 32.9, 38.8, 35.3, 43.1, 60.2, 87.2),
        }
    },
    "semantickitti": _SK,
}
NUMBER = {"kitti-sf": "4.4", "kitti-det": "4.5", "semantickitti": "4.6"}
METHODS = {"kitti-sf": _SF, "kitti-det": _STILL, "semantickitti": ("scene", *_STILL)}


@dataclass(frozen=True)
class Streets:
    """Holds a published data set, by the name of its `dpc prepare` command, and how much of it is used."""

    command: str
    raw: Path
    folder: Path
    points: int
    limit: int | None

    def prepare(self, group: str, method: str) -> tuple[Path, str]:
        """Returns the clouds file that a method sees of a group of drives, and the split of it that is judged."""
        windows = method == "scene" and self.command == "semantickitti"
        path = self.folder / f"{'-'.join(filter(None, [self.command, group, 'windows' if windows else '']))}.h5"
        words = [*(("--group", group) if group else ()), *(_WINDOW if windows else ())]
        limit = () if self.limit is None else ("--limit", self.limit)
        runs.dpc("prepare", self.command, self.raw, "--points", self.points, *words, *limit, "-o", path)
        if self.command == "semantickitti":
            return path, "all"
        with CloudsReader(path) as reader:
            wanted = {"kitti-sf": "test", "kitti-det": "validation"}[self.command]
            return path, wanted if wanted in reader.splits else "all"


def table(streets: Streets, found: dict[str, dict[str, dict]], about: str) -> str:
    """Returns Markdown with a part for each group of drives: our methods, then the thesis's numbers, percent."""
    lines = []
    for group, results in found.items():
        lines += [*([f"## {group}", ""] if group else []), *rows(results, THESIS[streets.command][group]), ""]
    return "\n".join([*lines, about, ""])


def run(streets: Streets, methods: list[str], model: str | None) -> str:
    """Scores the methods one after the other and returns the table, which is written after each."""
    groups = THESIS[streets.command]
    about = (
        f"Percent; {streets.points} points a scan at most, objects of fewer than 50 points ignored; network:"
        f" {model or 'the shipped one, which was trained on single objects'}; scene in 4.6: windows of four scans."
    )
    found: dict[str, dict[str, dict]] = {group: {} for group in groups}
    for group in groups:
        for method in methods:
            print(f"table {NUMBER[streets.command]}: {group} {method}".replace("  ", " "), file=sys.stderr)
            data, split = streets.prepare(group, method)
            predicting = ("--model", model) if model and method == "network" else ()
            found[group][method] = score(data, method, streets.points, split, predicting, JUDGING)
            runs.write_text(streets.folder / "table.md", table(streets, found, about))
    return table(streets, found, about)


def main(argv: list[str] | None = None) -> None:
    """Reads the data set that is named, runs the methods that are asked for, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    source = parser.add_mutually_exclusive_group(required=True)
    for command in THESIS:
        source.add_argument(f"--{command}", type=Path)
    parser.add_argument("--points", type=int, default=8192)
    parser.add_argument("--methods", help="some of the methods of the table, with commas between")
    parser.add_argument("--model", help="a network trained on such scenes (dpc segment train)")
    parser.add_argument("--limit", type=int, help="scenes of each group, for a trial")
    options = parser.parse_args(argv)
    command = next(one for one in THESIS if getattr(options, one.replace("-", "_")))
    methods = options.methods.split(",") if options.methods else list(METHODS[command])
    unknown = [method for method in methods if method not in METHODS[command]]
    if unknown:
        parser.error(f"--methods: no method {unknown[0]!r} for {command}; there are {', '.join(METHODS[command])}")
    options.folder.mkdir(parents=True, exist_ok=True)
    raw = getattr(options, command.replace("-", "_"))
    print(run(Streets(command, raw, options.folder, options.points, options.limit), methods, options.model), end="")


if __name__ == "__main__":
    main()
