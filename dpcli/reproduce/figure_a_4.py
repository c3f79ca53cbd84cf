"""Figure A.4 of the thesis: what each class gains when the kinematic stream, or scene flow, joins the static stream.

    python -m dpcli.reproduce.figure_a_4 FOLDER SCORES.h5 ... [--flow SCORES.h5 ...]

SCORES: scores files with the streams static and fused, one a seed (table 3.4's on 16 frames). --flow: scores of the flow
baseline on the same videos (figure 3.8's). Gains are differences in the share of a class's videos that are told right,
in percentage points, means over the files. Results: FOLDER/figure.png, table.md, results.json.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dpcli.counted import counted
from dpcli.draw.sheet import new_figure, save_figure
from dpcli.errors import DataError
from dpcli.evaluate.classification.metrics import predicted_labels
from dpcli.reproduce.runs import DASH, markdown, write_json, write_text
from dpcli.store import ScoresReader

SAID = {  # A.2.2: what the thesis says of single classes; the figure prints no numbers
    "kinet": {"high throw": "more than +30", "hand catch": "more than +30", "horizontal arm wave": "about -6"},
    "flow": {"high arm wave": "below -10"},
}
TITLES = {"kinet": "(a) Kinet", "flow": "(b) flow-based two streams"}


def recalls(scores: np.ndarray, labels: np.ndarray, classes: int) -> np.ndarray:
    """Returns the percent of each class's videos told right, f64 (C); NaN for a class without videos. scores (S,C), labels (S)."""
    right = np.bincount(labels[predicted_labels(scores) == labels], minlength=classes)
    count = np.bincount(labels, minlength=classes)
    with np.errstate(invalid="ignore"):
        return 100 * right / count


def _of(path: Path, stream: str | None = None) -> tuple[np.ndarray, list[str]]:
    """Returns the recall of each class of the test videos, and the class names."""
    reader = ScoresReader(path)
    if stream is not None and stream not in reader.streams:
        raise DataError(f"{path}: no stream {stream!r}; the file has {', '.join(reader.streams) or 'none'}")
    scores = reader.scores if stream is None else reader.streams[stream]
    test = np.array([split in ("test", "") for split in reader.splits]) & (reader.labels >= 0)
    return recalls(scores[test], reader.labels[test], len(reader.class_names)), reader.class_names


def gains(files: Sequence[Path]) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Returns class names, static recall and gain of the final score over it, percentage points f64 (C), means over files."""
    before, after = [], []
    for path in files:
        own, names = _of(path, "static")
        before.append(own)
        after.append(_of(path)[0])
    return names, np.mean(before, 0), np.mean(after, 0) - np.mean(before, 0)


def table(names: Sequence[str], base: np.ndarray, found: Mapping[str, np.ndarray], about: str) -> str:
    """Returns markdown, classes by Kinet's gain."""
    header = ["class", "static, %"]
    for key in found:
        header += [f"{TITLES[key]}: gain, points", "thesis"]
    lines = []
    for k in np.argsort(-np.nan_to_num(found["kinet"], nan=-np.inf), kind="stable"):
        line = [names[k], _number(base[k])]
        for key, own in found.items():
            line += [_number(own[k], "+"), SAID[key].get(names[k].lower(), DASH)]
        lines.append(line)
    means = ["mean over classes", _number(np.nanmean(base))]
    for own in found.values():
        means += [_number(np.nanmean(own), "+"), DASH]
    return (
        "\n\n".join(
            ["# Figure A.4: gains of each class over the static stream", markdown(header, [*lines, means]), about]
        )
        + "\n"
    )


def _number(value: float, sign: str = "") -> str:
    return DASH if np.isnan(value) else f"{value:{sign}.1f}"


def picture(names: Sequence[str], found: Mapping[str, np.ndarray], path: Path) -> None:
    """Draws a panel each: bars sorted by gain, blue up, red down."""

    figure = new_figure(0.35 * len(names) + 2.5, 3.6 * len(found))
    for panel, (key, own) in enumerate(found.items()):
        axes = figure.add_subplot(len(found), 1, panel + 1)
        known = [k for k in np.argsort(-own, kind="stable") if not np.isnan(own[k])]
        axes.bar(range(len(known)), own[known], color=["tab:red" if own[k] < 0 else "tab:blue" for k in known])
        axes.axhline(0, color="black", linewidth=0.8)
        axes.set_xticks(range(len(known)), [names[k] for k in known], rotation=60, ha="right", fontsize=8)
        axes.set(title=TITLES[key], ylabel="gain, percentage points")
    save_figure(figure, path, 120)


def make(folder: Path, files: Sequence[Path], flow: Sequence[Path] = ()) -> dict[str, np.ndarray]:
    """Writes picture and table of scores files. flow: the flow baseline's, which hold its static scores as a stream too."""
    names, base, own = gains(files)
    found = {"kinet": own}
    about = f"Ours: mean over {counted(len(files), 'run')} (seeds)."
    if flow:
        others, _, found["flow"] = gains(flow)
        if others != names:
            raise DataError(f"{flow[0]}: other classes than {files[0]}")
        about += f" Flow-based two streams: {counted(len(flow), 'run')}, over their own static networks."
    write_json(
        folder / "results.json",
        {
            "figure": "A.4",
            "classes": names,
            "static": base.tolist(),
            "gain": {key: value.tolist() for key, value in found.items()},
        },
    )
    write_text(folder / "table.md", table(names, base, found, about))
    picture(names, found, folder / "figure.png")
    return found


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the program by its words."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("scores", type=Path, nargs="+")
    parser.add_argument("--flow", type=Path, nargs="*", default=[])
    given = parser.parse_args(argv)
    try:
        make(given.folder, given.scores, [path for path in given.flow if path.exists()])
    except DataError as error:
        sys.exit(str(error))
    sys.stdout.write((given.folder / "table.md").read_text())


if __name__ == "__main__":
    main()
