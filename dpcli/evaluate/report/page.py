"""A report as one HTML file: nothing outside it is read, tables are readable without its script."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from importlib.resources import files

from dpcli.counted import counted
from dpcli.evaluate.report.blocks import MISSING, Cell, Figure, Report, Section, Table
from dpcli.evaluate.report.error_clouds import palette_words
from dpcli.standard_streams import printable

_LONG, _LONG_NAME = 44, 26  # characters from which a cell, a row's name, may break into lines


def report_html(report: Report) -> str:
    """Returns the page. Texts from files are escaped; equal reports give equal pages."""
    source = files(__package__)
    script = source.joinpath("report.js").read_text("utf-8").replace("<!--PALETTE-->", palette_words())
    count = counted(len(report.sections), "result")
    pieces = {
        "TITLE": escape(report.title),
        "COUNT": count,
        "VERSION": escape(report.version),
        "BODY": _body(report),
        "SCRIPT": script,
    }
    made = []
    for text in source.joinpath("page.html").read_text("utf-8").split("<!--"):
        mark, closed, rest = text.partition("-->")
        made.append(pieces[mark] + rest if closed else text)
    return printable("".join(made), kept="\n\t")


def _body(report: Report) -> str:
    beside = "".join(_block(own) for own in report.beside)
    parts = [
        _table(report.summary),
        *(f'<p class="faint">{escape(text)}.</p>' for text in report.left_out),
        f'<section id="beside"><h2>Beside the thesis</h2>{beside}</section>' if beside else "",
        *(_section(own) for own in report.sections),
    ]
    return "\n".join(part for part in parts if part)


def _section(section: Section) -> str:
    line = section.headline
    interval = f" ({escape(line.interval)})" if line.interval else ""
    over = f" over {escape(section.data)}" if section.data else ""
    head = (
        f'<h2>{escape(section.title)}</h2><p class="faint">{escape(section.task)}</p>'
        f'<p class="big">{escape(line.metric)} <b>{escape(line.value.text)}</b>{interval}'
        f'<span class="faint">{over}</span></p>'
    )
    notes = "".join(f"<li>{escape(note)}</li>" for note in section.notes)
    body = _figures_in_pairs(section.blocks)
    return (
        f'<section id="{section.anchor}">{head}{f"<ul class=faint>{notes}</ul>" if notes else ""}{body}'
        f"{_details(section)}</section>"
    )


def _figures_in_pairs(blocks: Sequence[Table | Figure]) -> str:
    """Returns blocks in order; charts that follow one another stand side by side where there is room."""
    made, row = [], []
    for block in [*blocks, None]:
        if isinstance(block, Figure) and block.html.startswith("<svg"):
            row.append(f"<div>{_block(block)}</div>")
            continue
        if row:
            made.append(f'<div class="pair">{"".join(row)}</div>')
            row = []
        if block is not None:
            made.append(_block(block))
    return "".join(made)


def _block(block: Table | Figure) -> str:
    note = f'<p class="faint">{escape(block.note)}</p>' if block.note else ""
    inside = _table(block) if isinstance(block, Table) else block.html
    return f"<h3>{escape(block.title)}</h3>{inside}{note}"


def _table(table: Table) -> str:
    words = [_is_words(table, place) for place in range(len(table.header))]
    head = "".join(
        f'<th scope="col"{_kind(["words"] if text else [])}>{escape(name)}</th>'
        for name, text in zip(table.header, words, strict=True)
    )
    rows = "".join(_row(row, words) for row in table.rows)
    return (
        f'<div class="wide" tabindex="0" role="region" aria-label="{escape(table.title)}"><table data-key="{escape(table.key)}">'
        f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _is_words(table: Table, place: int) -> bool:
    """Returns whether a column holds texts, not numbers; it then stands on the left."""
    found = [row[place] for row in table.rows if row[place].text != MISSING]
    return bool(found) and all(own.sort is None for own in found)


def _kind(names: Sequence[str]) -> str:
    return f' class="{" ".join(names)}"' if names else ""


def _row(row: Sequence[Cell], words: Sequence[bool]) -> str:
    mark = next((own.mark for own in row if own.mark), "")
    cells = (_cell(own, place, text) for place, (own, text) in enumerate(zip(row, words, strict=True)))
    return f"<tr{_kind([mark] if mark else [])}>{''.join(cells)}</tr>"


def _cell(own: Cell, place: int, words: bool) -> str:
    sort = "" if own.sort is None else f' data-sort="{own.sort:.10g}"'
    text = f'<a href="#{own.link}">{escape(own.text)}</a>' if own.link else escape(own.text)
    if own.share is not None:
        text = f'<span class="bar" style="--v:{own.share:.3f}"></span><span>{text}</span>'
    if place == 0:
        return f'<th scope="row"{sort}{_kind(["long"] if len(own.text) > _LONG_NAME else [])}>{text}</th>'
    kind = _kind([*(["words"] if words else []), *(["long"] if len(own.text) > _LONG else [])])
    return f"<td{sort}{kind}>{text}</td>"


def _details(section: Section) -> str:
    if not section.details:
        return ""
    commands = "".join(f"<li><code>{escape(command)}</code></li>" for command in section.commands)
    history = f"<h3>Commands, first to last</h3><ol>{commands}</ol>" if commands else ""
    lists = "".join(f"<h3>{escape(title)}</h3><dl>{_terms(terms)}</dl>" for title, terms in section.details)
    title = "Protocol, units, denominators, what was left out, commands and provenance"
    return f"<details><summary>{title}</summary>{history}{lists}</details>"


def _terms(terms: Sequence[tuple[str, str]]) -> str:
    return "".join(f"<dt>{escape(term)}</dt><dd>{escape(words)}</dd>" for term, words in terms)
