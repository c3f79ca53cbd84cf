"""Draws a comparison: differences with their intervals, and each sample on both sides."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.draw.sheet import new_figure, save_figure
from dpcli.evaluate.compare.paired import Change, CompareReport, Paired
from dpcli.evaluate.metric_titles import metric_title, title_of

_LETTERS_PER_INCH = 12  # of text at 9 points


def draw_comparison(report: CompareReport, path: Path) -> None:
    """Draws differences with their intervals, one panel for each unit, and each sample in A against the same in B."""

    rows = {key: own for part in report.parts for key, own in part.changes.items()}
    panels = [
        {key: own for key, own in rows.items() if own.unit == unit}
        for unit in dict.fromkeys(own.unit for own in rows.values())
    ]
    part = report.parts[0]
    figure = new_figure(4 * (len(panels) + 1), 1.8 + 0.45 * max(5, *map(len, panels)))
    axes = figure.subplots(1, len(panels) + 1, squeeze=False)[0]
    for place, group in zip(axes, panels, strict=False):
        _differences_panel(place, group)
    _samples_panel(axes[-1], part)
    room = int(_LETTERS_PER_INCH * figure.get_figwidth())
    lines = [f"{side}: {_end_of(source, room)}" for side, source in zip("AB", report.sources, strict=True)]
    figure.suptitle("\n".join(lines), fontsize=9, parse_math=False)
    save_figure(figure, path)


def _end_of(path: str, room: int) -> str:
    """Returns a path, or its end where it has more letters than there is room for: the file's name tells most."""
    return path if len(path) <= room else "…" + path[1 - room :]


def _differences_panel(axes, group: dict[str, Change]) -> None:
    for row, (key, own) in enumerate(group.items()):
        scale = 100 if own.unit == "fraction" else 1
        if own.interval.defined:
            axes.plot([scale * own.interval.low, scale * own.interval.high], [row, row], color="#4c72b0", linewidth=2)
        if not np.isnan(own.difference):
            axes.plot([scale * own.difference], [row], "o", color="#1b2a41", label=key)
    axes.set_yticks(range(len(group)), [metric_title(key, own.unit) for key, own in group.items()], parse_math=False)
    axes.axvline(0, color="#888888", linewidth=0.8)
    axes.set_ylim(len(group) - 0.5, -0.5)
    axes.set_xlabel("A - B")


def _samples_panel(axes, part: Paired) -> None:
    if not part.changed_by:
        axes.set_axis_off()
        return
    a, b = part.values
    scale = 100 if part.changes[part.changed_by].unit == "fraction" else 1
    if part.mcnemar is not None:  # only right or wrong: counts say more than points on top of each other
        both = [[int(((a == i) & (b == j)).sum()) for j in (1, 0)] for i in (1, 0)]
        axes.imshow(both, cmap="Blues", vmax=2 * max(map(max, both)))  # dark text stays legible
        for i, row in enumerate(both):
            for j, count in enumerate(row):
                axes.text(j, i, str(count), ha="center", va="center")
        axes.set_xticks([0, 1], ["B right", "B wrong"])
        axes.set_yticks([0, 1], ["A right", "A wrong"])
        axes.set_title(f"{part.kind}, right by {title_of(part.changed_by)}", fontsize=9, parse_math=False)
        return
    axes.plot(scale * b, scale * a, ".", color="#4c72b0")
    defined = scale * np.concatenate([a, b])
    low, high = np.nanmin(defined), np.nanmax(defined)
    axes.plot([low, high], [low, high], color="#888888", linewidth=0.8)
    title = metric_title(part.changed_by, part.changes[part.changed_by].unit)
    axes.set_xlabel(f"B: {title} of each of the {part.kind}", parse_math=False)
    axes.set_ylabel("A")
