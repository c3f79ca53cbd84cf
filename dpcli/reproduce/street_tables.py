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
# Groups of drives, and how the thesis's table ends their settings.
GROUPS = {
    "kitti-sf": {"": ""},
    "kitti-det": {"": ""},
    "semantickitti": {
        "all": "sequences 00 - 10",
        "without-08": "sequences 00 - 07 & 09 - 10",
        "only-08": "sequences 08",
    },
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
        thesis = runs.thesis_numbers(NUMBER[streets.command], GROUPS[streets.command][group])
        lines += [*([f"## {group}", ""] if group else []), *rows(results, thesis), ""]
    return "\n".join([*lines, about, ""])


def run(streets: Streets, methods: list[str], model: str | None) -> str:
    """Scores the methods one after the other and returns the table, which is written after each."""
    groups = GROUPS[streets.command]
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
    for command in GROUPS:
        source.add_argument(f"--{command}", type=Path)
    parser.add_argument("--points", type=int, default=8192)
    parser.add_argument("--methods", help="some of the methods of the table, with commas between")
    parser.add_argument("--model", help="a network trained on such scenes (dpc segment train)")
    parser.add_argument("--limit", type=int, help="scenes of each group, for a trial")
    options = parser.parse_args(argv)
    command = next(one for one in GROUPS if getattr(options, one.replace("-", "_")))
    methods = options.methods.split(",") if options.methods else list(METHODS[command])
    runs.refuse_unknown(parser, f"--methods of {command}", "method", methods, METHODS[command])
    options.folder.mkdir(parents=True, exist_ok=True)
    raw = getattr(options, command.replace("-", "_"))
    print(run(Streets(command, raw, options.folder, options.points, options.limit), methods, options.model), end="")


if __name__ == "__main__":
    main()
