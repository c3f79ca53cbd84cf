"""`dpc evaluate report`: one page, or one document, of many results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.options import Force
from dpcli.errors import DataError, UsageError

_FORMS = {".html": "html", ".htm": "html", ".md": "markdown", ".tex": "latex"}


def register(app: typer.Typer) -> None:
    """Add the command to `dpc evaluate`."""
    app.command("report")(report)


def report(
    results: Annotated[
        list[str],
        typer.Argument(help="What --json printed (- for a pipe), scores files, parts files, or videos as PRED=TRUTH."),
    ],
    output: Annotated[
        str | None, typer.Option("-o", "--output", help="Page (.html), .md or .tex to write; - for stdout.")
    ] = None,
    truth: Annotated[
        Path | None, typer.Option("--truth", help="Clouds file the parts files are compared with.")
    ] = None,
    split: Annotated[str | None, typer.Option("--split", help="Samples of HDF5 files that count, or all.")] = None,
    beside: Annotated[
        list[str] | None,
        typer.Option(
            "--beside", help="A thesis table to stand beside, such as table-3.4, or none. Default: by the data."
        ),
    ] = None,
    title: Annotated[str, typer.Option("--title", help="Title of the page.")] = "Results",
    pictures: Annotated[bool, typer.Option("--pictures/--no-pictures", help="Error clouds and video strips.")] = True,
    as_markdown: Annotated[bool, typer.Option("--markdown", help="Print markdown instead of a page.")] = False,
    as_latex: Annotated[bool, typer.Option("--latex", help="Print LaTeX tables (booktabs) instead of a page.")] = False,
    force: Force = False,
) -> None:
    """One self-contained page of many results: tables, confusion matrices, error clouds, video strips, provenance."""
    form = _form(output, as_markdown, as_latex)
    _check_output(output, force)
    from dpcli.evaluate.report import arrange, collect, report_html, report_latex, report_markdown
    from dpcli.evaluate.report.thesis import chosen_tables
    from dpcli.runtime.progress import log
    from dpcli.runtime.whole_file import write_whole

    chosen_tables(beside or [], [])  # a wrong name is said before the work
    collected = collect(results, truth, split=split, pictures=pictures and form == "html")
    for text in collected.duplicates:
        log.warn(text)
    made = arrange(collected, title=title, beside=beside or [])
    text = {"html": report_html, "markdown": report_markdown, "latex": report_latex}[form](made)
    if output in (None, "-"):
        typer.echo(text, nl=False)
    else:
        write_whole(Path(output), text.encode("utf-8"))
        log.info(f"wrote {output}: {len(made.sections)} results, {len(text.encode()) / 1e6:.2f} MB")


def _form(output: str | None, as_markdown: bool, as_latex: bool) -> str:
    """html, markdown or latex: as asked, else by the output's ending."""
    if as_markdown and as_latex:
        raise UsageError("--markdown and --latex: choose one form of output")
    if as_markdown or as_latex:
        return "markdown" if as_markdown else "latex"
    if output is None:
        raise UsageError("a page needs a file: -o report.html (or --markdown, --latex to print tables)")
    form = "html" if output == "-" else _FORMS.get(Path(output).suffix.lower())
    if form is None:
        raise UsageError(f"-o {output}: unknown ending; expected {', '.join(_FORMS)}")
    return form


def _check_output(output: str | None, force: bool) -> None:
    if output in (None, "-"):
        return
    if Path(output).exists() and not force:
        raise UsageError(f"{output}: exists already; --force replaces it")
    if not Path(output).absolute().parent.is_dir():
        raise DataError(f"-o {output}: the folder {Path(output).parent} does not exist; create it first")
