"""Arranges results as sections: what is shown of each, in which order, and the thesis's tables beside them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import PurePath

from dpcli import __version__
from dpcli.errors import DataError
from dpcli.evaluate.metric_titles import title_of
from dpcli.evaluate.report.blocks import Cell, Report, Section, Table, table
from dpcli.evaluate.report.classification_section import SHOWN_HERE, classification_blocks
from dpcli.evaluate.report.collect import Collected, CollectedResult
from dpcli.evaluate.report.metric_tables import denominator, detail_lists, headline, metric_blocks
from dpcli.evaluate.report.thesis_tables import beside_table, choose_tables


def arrange(collected: Collected, *, title: str = "Results", beside: Sequence[str] = ()) -> Report:
    """Returns the report of all results. beside: ids of the thesis's tables, none = those that know the data.

    Raises DataError when a result's numbers have no shape that can be shown; UsageError for a table there isn't.
    """
    objects = [result.found for result in collected.results]
    tables = choose_tables(beside, objects)
    titles = _distinct_titles(collected.results)
    sections = [_section(number, own, title) for number, (own, title) in enumerate(zip(collected.results, titles), 1)]
    named = list(zip(titles, objects, strict=True))
    return Report(
        title,
        _summary(sections),
        sections,
        [beside_table(own, named, bool(beside)) for own in tables],
        collected.duplicates,
        __version__,
    )


def _distinct_titles(results: Sequence[CollectedResult]) -> list[str]:
    """Returns the input's file name, or the whole path where names repeat within a task, or a number after it."""
    full = [_input_name(result) for result in results]
    short = [PurePath(text).name or text for text in full]
    seen = Counter((own.found["task"], name) for own, name in zip(results, short))
    made = [name if seen[result.found["task"], name] == 1 else text for result, name, text in zip(results, short, full)]
    taken: Counter = Counter()
    out = []
    for result, name in zip(results, made):
        taken[result.found["task"], name] += 1
        count = taken[result.found["task"], name]
        out.append(name if count == 1 else f"{name} ({count})")
    return out


def _input_name(result: CollectedResult) -> str:
    name = result.found.get("input", "")
    if isinstance(name, (list, tuple)):
        name = ", ".join(PurePath(str(own)).name for own in name)
    return result.source if name in ("", "-", None) else str(name)


def _section(number: int, result: CollectedResult, title: str) -> Section:
    found = result.found
    classified = found["task"] == "classification"
    try:
        special = classification_blocks(found) if classified else []
        blocks, notes = metric_blocks(found, SHOWN_HERE if classified else ())
    except (DataError, AttributeError, TypeError, KeyError, ValueError, IndexError) as error:
        raise DataError(f"{result.source}: the {found['task']} object can't be shown: {error}") from None
    protocol, data = found.get("protocol", {}), denominator(found)
    truth = PurePath(str(protocol.get("truth", "")))
    if truth.suffix or len(truth.parts) > 1:  # a path, not words
        data = f"{data} of {truth.name}" if data else truth.name
    remarks = [str(note) for note in found.get("notes", []) if isinstance(note, str)]
    accepted = found.get("accepted")
    if isinstance(accepted, Mapping):
        remarks.append(
            f"Something was recognized in {accepted.get('samples')} samples, of which {accepted.get('correct')} are right; the tables"
            " count the others as scored."
        )
    left_out = [
        f"Left out, {own.get('reason', 'unknown')}: {own.get('count', len(own.get('names', [])))}."
        for own in found.get("left_out", [])
    ]
    missing = found.get("not_computed", {})
    reasons = missing.items() if isinstance(missing, Mapping) else ()
    left_out += [f"{title_of(name)} not computed: {reason}." for name, reason in reasons]
    commands = [str(own["command"]) for own in found.get("provenance", []) if own.get("command")]
    return Section(
        f"result-{number}",
        title,
        found["task"],
        data,
        headline(found),
        [*special, *blocks, *result.extras],
        [*remarks, *left_out, *result.notes, *notes],
        detail_lists(found),
        commands,
    )


def _summary(sections: Sequence[Section]) -> Table:
    rows = [
        [
            Cell(own.title, link=own.anchor),
            own.task,
            own.headline.metric,
            own.headline.value,
            own.headline.interval or "-",
            Cell(own.data or "-"),
        ]
        for own in sections
    ]
    return table("Summary", ("result", "task", "metric", "value", "interval", "over"), rows, key="summary")
