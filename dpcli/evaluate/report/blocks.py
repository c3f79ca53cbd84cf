"""What a report is made of: tables whose cells know how they sort, figures, and sections that hold them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

MISSING = "-"
TITLES = {
    "ap": "AP",
    "pq": "PQ",
    "f1": "F1",
    "pre": "Pre",
    "rec": "Rec",
    "miou": "mIoU",
    "ri": "RI",
    "epe3d": "EPE3D",
    "epe3d_no_motion": "EPE3D of no motion",
    "accs": "AccS",
    "accr": "AccR",
    "outlier": "Outlier",
    "psnr": "PSNR",
    "psnr_foreground": "PSNR on object",
    "ssim": "SSIM",
    "ms_ssim": "MS-SSIM",
    "lpips": "LPIPS",
    "fvd": "FVD",
    "fid_vid": "FID-VID",
    "clip": "CLIP",
    "macro_f1": "macro F1",
    "top5_accuracy": "top-5 accuracy",
    "sd": "sd",
    "p": "p",
    "adjusted_rand_index": "adjusted Rand index",
    "epe": "EPE",
    "tau": "tau",
}
_DIGITS = {"dB": 2, "degree": 2, "percent": 2}


@dataclass(frozen=True)
class Cell:
    """A table's cell. `sort`: number it sorts by, None = by its text, or last when that is "-"; `share`: bar in 0..1."""

    text: str
    sort: float | None = None
    share: float | None = None
    link: str = ""
    mark: str = ""  # "ours" | "thesis"


@dataclass(frozen=True)
class Table:
    """Rows under a header, the first cell of each its name; `key`: what the table is, for those who look for it."""

    title: str
    header: tuple[str, ...]
    rows: list[list[Cell]]
    note: str = ""
    key: str = ""


@dataclass(frozen=True)
class Figure:
    """Markup made by ours, all text from files escaped: what only a page can show."""

    title: str
    html: str
    note: str = ""


@dataclass(frozen=True)
class Headline:
    """The one number a result is known by: metric, value and interval as text, what it is a share or mean of."""

    metric: str
    value: Cell
    interval: str = ""
    of: str = ""


@dataclass
class Section:
    """One result: its headline, tables and figures, and all that its numbers depend on."""

    anchor: str
    title: str
    task: str
    data: str
    headline: Headline
    blocks: list[Table | Figure] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    details: list[tuple[str, list[tuple[str, str]]]] = field(default_factory=list)  # (heading, term and words)
    commands: list[str] = field(default_factory=list)


@dataclass
class Report:
    """All of the page; `beside` holds the tables with the thesis's rows, `left_out` what was given but isn't shown."""

    title: str
    summary: Table
    sections: list[Section]
    beside: list[Table]
    left_out: list[str]
    version: str


def title_of(key: str) -> str:
    """A metric's name as people write it."""
    return TITLES.get(key, str(key).replace("_", " "))


def is_number(value: Any) -> bool:
    """A number, not a truth value."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def text_of(value: Any, unit: str = "") -> str:
    """`0.9351`, fraction -> `93.5 %`; two digits for dB, degrees and percent, four significant ones for the rest."""
    if value is None:
        return MISSING
    if not is_number(value):
        return str(value)
    if unit == "fraction":
        return f"{100 * value:.1f} %"
    if isinstance(value, int):
        return str(value)
    return f"{value:.{_DIGITS[unit]}f}" if unit in _DIGITS else f"{value:.4g}"


def cell(value: Any, unit: str = "", *, bar: bool = False, mark: str = "") -> Cell:
    """A cell of a value that is a number, a text, or missing (None)."""
    if not is_number(value):
        return Cell(text_of(value), mark=mark)
    share = min(max(float(value), 0.0), 1.0) if bar else None
    return Cell(text_of(value, unit), float(value), share, mark=mark)


def interval_of(found: Any) -> tuple[float, float] | None:
    """[low, high] of an interval, however it is written; None when it is none."""
    if isinstance(found, dict):
        found = found.get("interval", [found.get("low"), found.get("high")])
    if isinstance(found, (list, tuple)) and len(found) == 2 and all(is_number(end) for end in found):
        return float(found[0]), float(found[1])
    return None


def interval_text(found: Any, unit: str = "") -> str:
    """`89.6 - 96.0 %`; "" without an interval."""
    ends = interval_of(found)
    if ends is None:
        return ""
    low, high = (text_of(end, unit) for end in ends)
    return f"{low.removesuffix(' %')} to {high}" if low.endswith(" %") else f"{low} to {high}"


def sort_key(text: str) -> float | None:
    """The number a text begins with, `93.5 %` -> 93.5, `1,024` -> 1024; None for others and missing ones."""
    head = text.strip().replace(",", "").replace("\u2212", "-").split(" ")[0].rstrip("%\u00b0")
    try:
        value = float(head)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def table(
    title: str, header: Sequence[str], rows: Sequence[Sequence[Cell | str]], note: str = "", key: str = ""
) -> Table:
    """A table from cells and plain texts, which sort by the number they begin with, if any."""
    made = [[own if isinstance(own, Cell) else Cell(own, sort_key(own)) for own in row] for row in rows]
    return Table(title, tuple(header), made, note, key)
