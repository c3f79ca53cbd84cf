"""Any result object as tables: scalars with units and intervals, one table for each list or group of records."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from dpcli.evaluate.metric_titles import title_of
from dpcli.evaluate.report.blocks import (
    Cell,
    Figure,
    Headline,
    Table,
    cell,
    interval_of,
    interval_text,
    is_number,
    sort_key,
    table,
)
from dpcli.evaluate.report.charts import curve, histogram

_HEADLINES = ("accuracy", "ap", "epe3d", "psnr", "lpips", "fvd", "miou", "ssim", "adjusted_rand_index")
_COUNTS = ("samples", "sequences", "recordings", "views", "frames", "pairs", "n", "runs")
_UNITLESS = ("p", "p_value", "wilcoxon_p", "n", "count", "wins", "losses", "ties", "label", "frame", "seed")
_SPREAD_OF = ("per_sequence", "per_frame", "per_sample", "per_video", "per_object")
_LONGEST_CURVE = 400


def headline(found: Mapping[str, Any]) -> Headline:
    """Returns the metric a result is known by: the first of the usual ones, else a difference or mean, else its first number."""
    metrics, units = found.get("metrics", {}), found.get("units", {})
    plain = {key: value for key, value in metrics.items() if is_number(value)}
    for key in (*_HEADLINES, *plain):
        if key in plain:
            unit = _unit_of(units, key)
            ends = metrics.get(f"{key}_interval") or intervals_of(found).get(key)
            return Headline(_with_unit(key, unit), cell(plain[key], unit), interval_text(ends, unit))
    for key, record in metrics.items():
        for name in ("difference", "mean"):
            if isinstance(record, Mapping) and is_number(record.get(name)):
                unit = _unit_of(units, key)
                return Headline(
                    f"{name} of {_with_unit(key, unit)}",
                    cell(record[name], unit),
                    interval_text(record.get("interval"), unit),
                )
    return Headline("-", Cell("-"))


def denominator(found: Mapping[str, Any]) -> str:
    """Returns the first counts of the object, in words.

    >>> denominator({"denominators": {"samples": 231, "classes": 20}}), denominator({"denominators": {"recordings": 2, "frames": 50}})
    ('231 samples', '2 recordings, 50 frames')
    """
    counts = found.get("denominators", {})
    for own in [own for own in counts.values() if isinstance(own, Mapping)]:  # of a comparison: by what is compared
        counts = own | counts
    shown = [f"{counts[key]} {key}" for key in _COUNTS if is_number(counts.get(key))]
    return ", ".join(shown[:2])


def metric_blocks(found: Mapping[str, Any], skip: Sequence[str] = ()) -> tuple[list[Table | Figure], list[str]]:
    """Returns tables and curves of all `metrics` but those to skip, and notes on what could not be shown."""
    metrics, units = found.get("metrics", {}), found.get("units", {})
    intervals = intervals_of(found)
    grouped = _grouped_metrics(metrics)
    scalars: list[tuple[str, Any, str]] = []
    blocks: list[Table | Figure] = []
    notes: list[str] = []
    for key, value in metrics.items():
        if key in skip or key in grouped or key.endswith("_interval") or (value is None and key not in units):
            continue  # what is missing and has no unit is no number: records that the object lacks
        if _is_scalar(value) or interval_of(value):
            scalars.append((key, value, key))
        elif (
            isinstance(value, Mapping) and value and all(_is_scalar(own) or interval_of(own) for own in value.values())
        ):
            scalars += [(f"{key} {name}", own, name) for name, own in value.items()]
        elif (records := _named_records(value)) is not None:
            blocks.append(_records_table(key, records, units))
            blocks += _histograms_and_curves(key, records, units)
        elif isinstance(value, (list, Mapping)) and (series := _named_series(key, value)):
            blocks.append(Figure(title_of(key), "".join(curve(name, ys) for name, ys in series.items())))
        elif value not in ([], {}):
            notes.append(f"{title_of(key)}: in the object, not shown here.")
    rows = [_scalar_row(name, value, unit_key, units, intervals, metrics) for name, value, unit_key in scalars]
    columns = ["metric", "value", "interval", "unit"]
    if all(row[2] == "-" for row in rows):
        columns, rows = [columns[k] for k in (0, 1, 3)], [[row[k] for k in (0, 1, 3)] for row in rows]
    head = [table("Metrics", columns, rows, _interval_note(found), key="metrics")] if rows else []
    return [*head, *_grouped_tables(found, grouped, units), *blocks], notes


def intervals_of(found: Mapping[str, Any]) -> Mapping[str, Any]:
    """Returns [low, high] by metric, which stand under `intervals`, or there under `metrics` beside how they were found.

    Those of a scene's surface, of which frames are resampled, have a place of their own.
    """
    own, surface = found.get("intervals", {}), found.get("surface_intervals", {}).get("metrics")
    own = own["metrics"] if isinstance(own.get("metrics"), Mapping) else own
    return {**surface, **own} if isinstance(surface, Mapping) else own


def _interval_note(found: Mapping[str, Any]) -> str:
    """Returns how the intervals were found, in sentences; "" without any."""
    how, of_surface = (_how_resampled(found.get(key, {})) for key in ("intervals", "surface_intervals"))
    wilson = how and "accuracy_interval" in found.get("metrics", {})
    said = ((how, "Intervals: "), ("Wilson" if wilson else "", "Of accuracy: "), (of_surface, "Of the surface: "))
    return " ".join(f"{opening}{words}." for words, opening in said if words)


def _how_resampled(own: Mapping[str, Any]) -> str:
    if not own.get("resamples") or not is_number(own.get("confidence")):
        return ""
    of = f"{own.get('number', '')} {own.get('resampled', '')}".strip()
    return f"{100 * own['confidence']:g} %, {own.get('method', '')}, {own['resamples']} resamples of {of}"


def _grouped_metrics(metrics: Mapping[str, Any]) -> dict[str, Mapping]:
    """Returns the metrics that are records: differences of a comparison, means over runs."""
    return {key: own for key, own in metrics.items() if isinstance(own, Mapping) and {"difference", "mean"} & set(own)}


def _grouped_tables(found: Mapping[str, Any], grouped: Mapping[str, Mapping], units: Mapping) -> list[Table]:
    """Returns a row for each metric of a comparison or of runs; then the single runs, a test, and the samples that differ most."""
    if not grouped:
        return []
    records = _named_records(grouped)
    made = [_records_table("metric", records, units, _interval_note(found))] if records else []
    names = found.get("runs", [])
    if isinstance(names, list) and all(isinstance(own.get("values"), list) for own in grouped.values()):
        runs = [
            (str(name), {key: own["values"][row] for key, own in grouped.items() if row < len(own["values"])})
            for row, name in enumerate(names)
        ]
        made += [_records_table("run", runs, units)] if any(name or own for name, own in runs) else []
    if (records := _named_records([found.get("mcnemar")])) is not None:
        made.append(_records_table("McNemar's exact test", records, {}))
    changed = found.get("most_changed", {})
    for key, rows in changed.items() if isinstance(changed, Mapping) else ():
        if (records := _named_records(rows)) is not None:
            unit = _unit_of(units, key)
            made.append(
                _records_table(f"samples that differ most, by {title_of(key)}", records, {"a": unit, "b": unit})
            )
    return made


def _scalar_row(
    name: str, value: Any, key: str, units: Mapping, intervals: Mapping, metrics: Mapping
) -> list[Cell | str]:
    unit = _unit_of(units, key)
    own = interval_text(metrics.get(f"{key}_interval") or intervals.get(key), unit) or "-"
    words = {"fraction": "share", "1": "", "": ""}.get(unit, unit)
    if not _is_scalar(value):
        return [title_of(name), Cell("-"), interval_text(value, unit), words]
    return [title_of(name), cell(value, unit), own, words]


def _is_scalar(value: Any) -> bool:
    return value is None or isinstance(value, (str, bool, int, float))


def _named_records(value: Any) -> list[tuple[str, Mapping]] | None:
    """Returns (row name, record) of a list of records or of records by name; None for anything else, or without a column."""
    records: list[tuple[str, Mapping]] = []
    if isinstance(value, list) and all(isinstance(own, Mapping) for own in value):
        records = [("", own) for own in value]
    if isinstance(value, Mapping) and all(isinstance(own, Mapping) for own in value.values()):
        records = [(str(name), own) for name, own in value.items()]
    return records if any(name or _flatten_record(own) for name, own in records) else None


def _records_table(key: str, records: list[tuple[str, Mapping]], units: Mapping, note: str = "") -> Table:
    flat = [(name, _flatten_record(record)) for name, record in records]
    columns = list(dict.fromkeys(column for _, record in flat for column in record))
    named = any(name for name, _ in flat)
    rows = []
    for name, record in flat:
        head = [name if key == "run" else title_of(name)] if named else []
        rows.append([*head, *(_record_cell(name, column, record, units) for column in columns)])
    header = [
        *([title_of(key.removeprefix("per_"))] if named else []),
        *(_with_unit(column, _unit_of(units, column)) for column in columns),
    ]
    title = title_of(key.removeprefix("per_"))
    return table(
        f"By {title}" if named or key.startswith("per_") else title[:1].upper() + title[1:], header, rows, note, key
    )


def _record_cell(name: str, column: str, record: Mapping, units: Mapping) -> Cell:
    value = record.get(column)
    unit = "" if column in _UNITLESS or isinstance(value, int) else _unit_of(units, column) or _unit_of(units, name)
    if interval_of(value):
        text = interval_text(value, unit)
        return Cell(text, sort_key(text))
    return cell(value, unit)


def _flatten_record(record: Mapping) -> dict[str, Any]:
    """Returns scalars and intervals of a record, those of records in it under both names; longer lists are left out."""
    made: dict[str, Any] = {}
    for key, value in record.items():
        if isinstance(value, Mapping) and interval_of(value) is None:
            made |= {f"{key} {name}": own for name, own in value.items() if _is_scalar(own)}
        elif _is_scalar(value) or interval_of(value):
            made[key] = value
    return made


def _histograms_and_curves(key: str, records: list[tuple[str, Mapping]], units: Mapping) -> list[Figure]:
    """Returns how the metrics of single sequences or frames are spread, and curves of records that hold values by frame."""
    made = []
    if key in _SPREAD_OF:
        for column in [name for name in records[0][1] if name in units]:
            values = [own[column] for _, own in records if is_number(own.get(column))]
            if len(values) > 3:
                made.append(Figure(f"{title_of(column)} {title_of(key)}", histogram(values, _unit_of(units, column))))
    for number, (name, record) in enumerate(records):
        series = _named_series("", record.get("per_frame", {}))
        title = name or str(record.get("view", record.get("name", number)))
        if series:
            made.append(Figure(f"{title}, by frame", "".join(curve(own, ys) for own, ys in series.items())))
    return made


def _named_series(key: str, value: Any) -> dict[str, list[float | None]]:
    """Returns values by name, for lists of numbers; {} for anything else."""
    named = value if isinstance(value, Mapping) else {title_of(key): value}
    good = {
        title_of(name): list(ys)
        for name, ys in named.items()
        if isinstance(ys, list)
        and 2 < len(ys) <= _LONGEST_CURVE
        and all(y is None or is_number(y) for y in ys)
        and any(y is not None for y in ys)
    }
    return good if len(good) == len(named) else {}


def _unit_of(units: Mapping, key: str) -> str:
    found = units.get(key, "")
    return found if isinstance(found, str) else ""


def _with_unit(key: str, unit: str) -> str:
    return title_of(key) + ("" if unit in ("", "1", "fraction", "samples") else f" ({unit})")


def detail_lists(found: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Returns protocol, units, denominators, notes, what was left out, and provenance, in words."""
    made = [
        (title, [(title_of(key), _in_words(value)) for key, value in found.get(name, {}).items()])
        for title, name in (("Protocol", "protocol"), ("Units", "units"), ("Denominators", "denominators"))
    ]
    made.append(("Left out", [_left_out_in_words(entry) for entry in found.get("left_out", [])] or [("nothing", "")]))
    how = {key: value for key, value in found.get("intervals", {}).items() if _is_scalar(value)}
    made.append(("Intervals", [(title_of(key), _in_words(value)) for key, value in how.items()]))
    for number, entry in enumerate(found.get("provenance", []), 1):
        terms = [(key, _in_words(value)) for key, value in entry.items()]
        made.append((f"Provenance {number}", terms))
    return [(title, terms) for title, terms in made if terms]


def _left_out_in_words(entry: Mapping[str, Any]) -> tuple[str, str]:
    names = [str(name) for name in entry.get("names", [])]
    return str(entry.get("reason", "")), f"{entry.get('count', len(names))}: " + ", ".join(names[:200])


def _in_words(value: Any) -> str:
    if isinstance(value, list) and all(isinstance(own, str) for own in value):
        return "; ".join(value) or "none"
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, sort_keys=True)
