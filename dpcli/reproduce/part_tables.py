"""The common parts of the tables of rigid parts: a method's parts of a file scored once, rows of ours and of the thesis."""

from __future__ import annotations

import json
from pathlib import Path

from dpcli.reproduce import runs

METRICS = ("ap", "pq", "f1", "pre", "rec", "miou", "ri")


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


def rows(results: dict[str, dict], thesis: dict[str, tuple[float, ...]]) -> list[str]:
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
