"""The thesis's rows, to stand beside ours: which table belongs to which data, and both in the table's units."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import as_file, files
from typing import Any

from dpcli.errors import UsageError
from dpcli.evaluate.metric_titles import title_of
from dpcli.evaluate.report.blocks import Cell, Table, is_number, table
from dpcli.text_files import read_toml

_WORDS = {"percent": "%", "1": "", "1/100 length unit": "\u00d7100"}


@dataclass(frozen=True)
class ThesisTable:
    """Holds a table of the thesis; `rows` as in the file: method, setting, values ("-" = not given), own."""

    number: str
    title: str
    data: str
    task: str
    protocol: str
    metrics: tuple[str, ...]
    units: tuple[str, ...]
    rows: tuple[dict[str, Any], ...]
    commands: tuple[str, ...] = ()
    classes: tuple[str, ...] = ()
    tau: float | None = None
    reference: tuple[str, ...] = ()

    @property
    def id(self) -> str:
        """Returns the name by which `--beside` asks for the table, such as table-3.4."""
        return f"table-{self.number}"

    def knows(self, found: Mapping[str, Any]) -> bool:
        """Returns whether a result is of this table's task and data: by a command of its provenance, or by its class names."""
        if found.get("task") != self.task:
            return False
        ran = [str(entry.get("command", "")) for entry in found.get("provenance", [])]
        if any(f"{words} " in f"{command} " for words in self.commands for command in ran):
            return True
        per_class = found.get("metrics", {}).get("per_class", [])
        names = {str(row.get("name", "")).lower() for row in per_class if isinstance(row, Mapping)}
        return bool(self.classes) and set(self.classes) <= names


@lru_cache(maxsize=1)
def thesis_tables() -> tuple[ThesisTable, ...]:
    """Returns all tables, in the thesis's order."""
    with as_file(files(__package__).joinpath("thesis_tables.toml")) as path:
        tables = read_toml(path)["table"]
    made = []
    for own in tables:
        known = own.pop("recognize", {})
        own = {key: tuple(value) if isinstance(value, list) else value for key, value in own.items()}
        made.append(
            ThesisTable(**own, commands=tuple(known.get("commands", ())), classes=tuple(known.get("classes", ())))
        )
    return tuple(made)


def choose_tables(beside: Sequence[str], objects: Sequence[Mapping[str, Any]]) -> list[ThesisTable]:
    """Returns the tables asked for by id (`table-3.4`; `none` = no table), else those that know one of the results.

    Ablations only stand beside a result when they are asked for. Raises UsageError for ids there aren't.
    """
    known = {own.id: own for own in thesis_tables()}
    if beside:
        wrong = [name for name in beside if name not in known and name != "none"]
        if wrong:
            raise UsageError(f"--beside {wrong[0]}: expected none or some of {', '.join(known)}")
        return [known[name] for name in beside if name != "none"]
    return [
        own for own in known.values() if "ablation" not in own.protocol and any(own.knows(found) for found in objects)
    ]


def beside_table(thesis: ThesisTable, objects: Sequence[tuple[str, Mapping[str, Any]]], asked: bool = False) -> Table:
    """Returns a table of our results beside the thesis's rows, whose own methods stand before those it cites.

    objects: (title, object) of ours; those of the table's data are shown (of its task, when the table was asked for).
    """
    ours = [
        (title, found) for title, found in objects if thesis.knows(found) or asked and found.get("task") == thesis.task
    ]
    rows = [row for title, found in ours for row in _rows_of_ours(thesis, title, found)]
    rows += [_thesis_row(thesis, own) for own in sorted(thesis.rows, key=lambda row: not row.get("own"))]
    header = (
        "method",
        "source",
        "setting",
        *(_header(metric, unit) for metric, unit in zip(thesis.metrics, thesis.units)),
    )
    protocols = (
        "; ".join(dict.fromkeys(f"{title}: {_protocol_in_words(found)}" for title, found in ours))
        or "no result of ours is of this task"
    )
    note = (
        f"Thesis: {thesis.protocol}. Ours: {protocols}. Rows marked thesis are copied from its {_place_in_thesis(thesis)}, "
        "not measured here; "
        "protocol, split and length unit may differ from ours."
    )
    return table(
        f"{thesis.title}: ours beside the thesis's {_place_in_thesis(thesis)}", header, rows, note, key=thesis.id
    )


def _place_in_thesis(thesis: ThesisTable) -> str:
    return f"figure {thesis.number}" if "figure" in thesis.title else f"Table {thesis.number}"


def _header(metric: str, unit: str) -> str:
    words = _WORDS.get(unit, unit)
    return title_of(metric) + (f" ({words})" if words else "")


def _rows_of_ours(thesis: ThesisTable, title: str, found: Mapping[str, Any]) -> list[list[Cell | str]]:
    metrics, split = found.get("metrics", {}), found.get("protocol", {}).get("split", "")
    setting = f"split {split}" if split else ""
    if thesis.tau is not None:
        metrics = metrics | _at_tau(metrics, thesis.tau)
    roles = metrics.get("per_role", {})
    if thesis.reference and isinstance(roles, Mapping) and isinstance(roles.get("reference"), Mapping):
        metrics = metrics | {key: roles["reference"].get(key) for key in thesis.reference}
        setting = f"{' and '.join(map(title_of, thesis.reference))} on the reference view"
    streams, units = metrics.get("streams", {}), found.get("units", {})
    named = [(f"{title}, {name}", own) for name, own in streams.items()] if len(streams) > 1 else [(title, metrics)]
    columns = [
        (metric, units.get(metric, ""), unit, _digits(thesis, place))
        for place, (metric, unit) in enumerate(zip(thesis.metrics, thesis.units, strict=True))
    ]
    return [
        [Cell(name, mark="ours"), "ours", setting, *(_convert(own.get(metric), *rest) for metric, *rest in columns)]
        for name, own in named
    ]


def _at_tau(metrics: Mapping[str, Any], tau: float) -> dict[str, Any]:
    """Returns the shares at the thesis's threshold, which need not be the result's main one; None where it has no such."""
    same = [own for own in metrics.get("thresholds", []) if isinstance(own, Mapping) and own.get("tau") == tau]
    return {key: same[0].get(key) if same else None for key in ("accs", "accr", "outlier")}


def _digits(thesis: ThesisTable, place: int) -> int:
    """Returns how many decimals the thesis prints in a column, in which ours are shown too."""
    return max(
        (len(f"{row['values'][place]}".partition(".")[2]) for row in thesis.rows if is_number(row["values"][place])),
        default=2,
    )


def _convert(value: Any, ours: str, theirs: str, digits: int) -> Cell:
    if not is_number(value):
        return Cell("-")
    factor = 100.0 if (ours, theirs) == ("fraction", "percent") or theirs.startswith("1/100") else 1.0
    return Cell(f"{value * factor:.{digits}f}", value * factor)


def _thesis_row(thesis: ThesisTable, row: dict[str, Any]) -> list[Cell | str]:
    source = f"thesis, {_place_in_thesis(thesis)}" + ("" if row.get("own") else " (cited)")
    cells = [
        Cell(f"{value:.{_digits(thesis, place)}f}", float(value)) if is_number(value) else Cell("-")
        for place, value in enumerate(row["values"])
    ]
    return [Cell(row["method"], mark="thesis"), source, row["setting"], *cells]


def _protocol_in_words(found: Mapping[str, Any]) -> str:
    protocol = found.get("protocol", {})
    words = {key: protocol[key] for key in ("name", "split", "views") if key in protocol}
    counts = found.get("denominators", {})
    words |= {key: counts[key] for key in ("samples", "sequences", "frames") if key in counts}
    return json.dumps(words, ensure_ascii=False).strip("{}").replace('"', "")
