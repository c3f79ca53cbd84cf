"""Table 4.3 of the thesis: rigid parts of rooms seen from all around and by one camera, every method of `segment predict`.

    python -m dpcli.reproduce.table_4_3 FOLDER --meshes MESHES [--rooms 20] | --ogc OGC [--points 2048] [--methods ...]

MESHES is a folder of models, of which new rooms are made; OGC holds `OGC-DR` and `OGC-DRSV` as released. Each step is
done once; the table FOLDER/table.md is written again after every method.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from dpcli.reproduce import runs

METRICS = ("ap", "pq", "f1", "pre", "rec", "miou", "ri")
VIEWS = {"full": ("ogc-dr", "OGC-DR"), "single view": ("ogc-drsv", "OGC-DRSV")}
METHODS = ("multibody", "network", "ssc", "trajaffn", "ward", "dbscan")


def prepare(view: str, options: argparse.Namespace) -> Path:
    """Returns the clouds file of a view; `prepare` passes over what is there already."""
    command, released = VIEWS[view]
    path = options.folder / f"{command}.h5"
    made = ["--generate", options.meshes, "--rooms", options.rooms, "--seed", options.seed, "--fractions", "0,0,1"]
    source = made if options.meshes else [options.ogc / released]
    runs.dpc("prepare", command, *source, "--points", options.points, "-o", path)
    return path


def score(
    data: Path,
    method: str,
    points: int,
    split: str,
    predicting: tuple[object, ...] = (),
    judging: tuple[object, ...] = (),
) -> dict:
    """Returns the metrics of a method on a split of a file, as shares of 1, with their intervals.

    points: of a frame that the method sees; the method scene takes all. predicting, judging: further words of `dpc segment
    predict` and `dpc evaluate segmentation`.
    """
    parts = data.with_name(f"{data.stem}-{method}.h5")
    words = [*predicting, *(() if method == "scene" else ("--points", points)), "--method", method, "--split", split]

    def work() -> dict:
        runs.dpc("segment", "predict", data, "-o", parts, *words)
        told = runs.dpc("evaluate", "segmentation", parts, "--truth", data, "--split", split, *judging, "--json")
        return json.loads(told)

    key = [runs.digest(data), method, points, *(map(str, (*predicting, *judging)))]
    return runs.once(parts.with_suffix(".json"), key, work)


def rows(results: dict[str, dict], thesis: dict[str, list[float]]) -> list[str]:
    """Returns lines of Markdown, percent: our methods with the interval of AP, then the thesis's numbers."""
    lines = ["| |" + "|".join(f" {name.upper()} " for name in METRICS) + "| AP, 95 % |"]
    lines += ["|---|" + "---|" * (len(METRICS) + 1)]
    for method, result in results.items():
        values = [result["metrics"][name] for name in METRICS]
        cells = [runs.DASH if value is None else f"{100 * value:.1f}" for value in values]
        lines.append(f"| {method} | {' | '.join([*cells, _interval(result)])} |")
    for name, numbers in thesis.items():
        lines.append(f"| *{name}, thesis* | {' | '.join([*map(str, numbers), runs.DASH])} |")
    return lines


def _interval(result: dict) -> str:
    found = result.get("intervals", {}).get("metrics", {}).get("ap")
    return f"{100 * found[0]:.1f} – {100 * found[1]:.1f}" if found else runs.DASH


def table(found: dict[str, dict[str, dict]], about: str) -> str:
    """Returns Markdown with a part for each view: our methods, then the thesis's numbers, percent."""
    lines = []
    for view, by_method in found.items():
        thesis = runs.thesis_numbers("4.3", f"unsupervised, {VIEWS[view][1]}")
        lines += [f"## {view}", "", *rows(by_method, thesis), ""]
    return "\n".join([*lines, about, ""])


def main(argv: list[str] | None = None) -> None:
    """Makes the rooms, runs the methods that are asked for, and writes the table after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--meshes", type=Path)
    source.add_argument("--ogc", type=Path)
    parser.add_argument("--rooms", type=int, default=20, help="new rooms of each number of objects")
    parser.add_argument("--points", type=int, default=2048)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--methods", default=",".join(METHODS), help=f"some of {','.join(METHODS)}")
    options = parser.parse_args(argv)
    chosen = options.methods.split(",")
    runs.refuse_unknown(parser, "--methods", "method", chosen, METHODS)
    options.folder.mkdir(parents=True, exist_ok=True)
    target = options.folder / "table.md"
    rooms = f"new rooms from {options.meshes.name}" if options.meshes else "the released rooms"
    about = (
        f"Percent; {rooms}, {options.points} points a frame, split test, seed {options.seed}; thesis: its own rooms."
    )
    found: dict[str, dict[str, dict]] = {view: {} for view in VIEWS}
    for view in VIEWS:
        data = prepare(view, options)
        for method in chosen:
            print(f"table 4.3: {view}, {method}", file=sys.stderr)
            found[view][method] = score(data, method, options.points, "test")
            runs.write_text(target, table(found, about))
    print(target.read_text(), end="")


if __name__ == "__main__":
    main()
