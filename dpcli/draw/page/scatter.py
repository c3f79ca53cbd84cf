"""An embedding as a page: a plane for each stream, a dot for each sample, a color and a shape for each class."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dpcli.draw.page.assemble import data_page
from dpcli.draw.page.points import PageFacts
from dpcli.draw.palette import PALETTE, part_colors
from dpcli.draw.sheet import spread_evenly

MOST_DOTS = 20_000
_SHAPES = ("circle", "square", "diamond")  # the next one where the colors begin anew


def scatter_page(
    facts: PageFacts,
    names: Sequence[str],
    class_names: Sequence[str],
    labels: np.ndarray,
    planes: Mapping[str, tuple[np.ndarray, Mapping[str, float]]],
) -> str:
    """Returns the page. labels: i (S), -1 = unknown. planes: by stream, places f (S,2) without unit, and figures by name."""
    kept = spread_evenly(len(names), MOST_DOTS)
    if len(kept) < len(names):
        facts.notes.append(f"Showing {len(kept):,} of {len(names):,} samples, evenly spread.")
    used = sorted(set(labels[kept].tolist()))
    classes = [
        {
            "label": label,
            "color": part_colors(np.array([label]))[0].tolist(),
            "shape": _SHAPES[max(label, 0) // len(PALETTE) % len(_SHAPES)],
            "name": "unknown"
            if label < 0
            else class_names[label]
            if label < len(class_names) and class_names[label]
            else f"label {label}",
        }
        for label in used
    ]
    header = facts.header() | {
        "names": [names[row] for row in kept],
        "labels": labels[kept].tolist(),
        "classes": classes,
        "planes": [
            {"title": title, "places": _rounded(places[kept]), "figures": dict(figures)}
            for title, (places, figures) in planes.items()
        ],
    }
    return data_page(header, "scatter", script=("scatter",))


def _rounded(places: np.ndarray) -> list[list[float]]:
    """Returns places (S,2) to four decimals, or more where they lie so near one another that these would merge them."""
    span = float(np.ptp(places.astype(np.float64), axis=0).max(initial=0))
    digits = 4 if span == 0 else max(4, 4 - int(np.floor(np.log10(span))))
    return np.round(places.astype(np.float64), digits).tolist()
