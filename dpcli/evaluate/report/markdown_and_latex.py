"""A report as markdown, or as LaTeX tables to be read into a document."""

from __future__ import annotations

from collections.abc import Sequence

from dpcli.evaluate.markdown import as_markdown, markdown_code, markdown_table
from dpcli.evaluate.report.blocks import Cell, Report, Section, Table
from dpcli.standard_streams import printable

_LATEX = {
    "\\": r"\textbackslash{}",
    "_": r"\_",
    "%": r"\%",
    "&": r"\&",
    "#": r"\#",
    "$": r"\$",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "\u00b1": r"$\pm$",
    "\u00d7": r"$\times$",
    "\u00b0": r"$^\circ$",
    "\u2026": r"\ldots{}",
    "\u2013": "--",
    "\u00b7": r"$\cdot$",
    "\u2265": r"$\geq$",
    "\u2264": r"$\leq$",
    "\n": " ",
    '"': r"\textquotedbl{}",
}


def report_markdown(report: Report) -> str:
    """Returns the summary, the thesis's rows beside ours, and each result's tables and notes."""
    lines = [
        f"# {as_markdown(report.title)}",
        _markdown_table(report.summary),
        *(as_markdown(text) + "." for text in report.left_out),
    ]
    for own in report.beside:
        lines += [f"## {as_markdown(own.title)}", _markdown_table(own), as_markdown(own.note)]
    for section in report.sections:
        lines += [f"## {as_markdown(section.task)}: {as_markdown(section.title)}", *_markdown_section(section)]
    return "\n\n".join(line for line in lines if line) + "\n"


def _markdown_section(section: Section) -> list[str]:
    lines = []
    for own in section.blocks:
        if isinstance(own, Table):
            lines += [f"**{as_markdown(own.title)}**", _markdown_table(own), as_markdown(own.note)]
    lines.append("\n".join(f"- {as_markdown(note)}" for note in section.notes))
    protocol = next((terms for title, terms in section.details if title == "Protocol"), [])
    lines.append("; ".join(f"{as_markdown(term)}: {as_markdown(words)}" for term, words in protocol))
    return [*lines, *(f"Command: {markdown_code(command)}" for command in section.commands)]


def _markdown_table(table: Table) -> str:
    numeric = [_numeric(table, place) for place in range(len(table.header))]
    return markdown_table(table.header, [[own.text for own in row] for row in table.rows], numeric)


def _numeric(table: Table, place: int) -> bool:
    return all(row[place].sort is not None or row[place].text == "-" for row in table.rows)


def report_latex(report: Report) -> str:
    """Returns the summary, the thesis's rows beside ours, and each result's tables, as `table` environments with booktabs."""
    lines = [r"% \usepackage{booktabs} \usepackage[T1]{fontenc}", _latex_table(report.summary, report.title)]
    lines += [_latex_table(own, own.title, own.note) for own in report.beside]
    for section in report.sections:
        tables = [own for own in section.blocks if isinstance(own, Table)]
        lines.append(_comment(f"{section.task}: {section.title}"))
        lines += [_latex_table(own, f"{section.title}: {own.title}", own.note) for own in tables]
    return "\n\n".join(lines) + "\n"


def _comment(text: str) -> str:
    return "% " + printable(" ".join(text.split()))


def _latex_table(table: Table, caption: str, note: str = "") -> str:
    columns = "l" + "".join("r" if _numeric(table, place) else "l" for place in range(1, len(table.header)))
    rows, ours = [], True
    for row in table.rows:
        if ours and row[0].mark == "thesis" and rows:
            rows.append(r"\midrule")
        ours = row[0].mark != "thesis"
        rows.append(_latex_row(row))
    words = escape_latex(caption) + (f". {escape_latex(note)}" if note else "")
    inside = [
        r"\toprule",
        _join_cells([escape_latex(name) for name in table.header]),
        r"\midrule",
        *rows,
        r"\bottomrule",
    ]
    return "\n".join(
        [
            r"\begin{table}[htbp]",
            r"\centering\footnotesize",
            rf"\caption{{{words}}}",
            rf"\begin{{tabular}}{{{columns}}}",
            *inside,
            r"\end{tabular}",
            r"\end{table}",
        ]
    )


def _latex_row(row: Sequence[Cell]) -> str:
    return _join_cells([escape_latex(own.text) for own in row])


def _join_cells(cells: Sequence[str]) -> str:
    # braces: a first cell that begins with [ would be read as an argument of the row before
    first = f"{{{cells[0]}}}" if cells[0].startswith(("[", "*")) else cells[0]
    return " & ".join([first, *cells[1:]]) + r" \\"


def escape_latex(text: str) -> str:
    """Returns text as LaTeX prints it: what it would take as a command is escaped."""
    return "".join(_LATEX.get(letter, letter) for letter in printable(text, kept="\n"))
