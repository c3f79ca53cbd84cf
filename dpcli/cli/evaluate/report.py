"""`dpc evaluate report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dpcli.cli.options import Force
from dpcli.counted import counted
from dpcli.errors import DataError, UsageError

_FORMS = {".html": "html", ".htm": "html", ".md": "markdown", ".tex": "latex"}


def report(
    results: Annotated[
        list[str],
        typer.Argument(
            help="Files of what --json printed (- for a pipe), scores files, parts files, or videos as PRED=TRUTH."
        ),
    ],
    output: Annotated[
        str | None,
        typer.Option(
            "-o", "--output", help="File to write: a page (.html), markdown (.md) or LaTeX (.tex); - for stdout."
        ),
    ] = None,
    truth: Annotated[
        Path | None, typer.Option("--truth", help="Clouds file that the parts files are compared with.")
    ] = None,
    split: Annotated[
        str | None,
        typer.Option(
            "--split", help="Split of HDF5 files that counts, such as test, or all. Default: test where there is one."
        ),
    ] = None,
    beside: Annotated[
        list[str] | None,
        typer.Option(
            "--beside",
            help="Table of the thesis to put beside the results, such as table-3.4, or none. Default: those of the same data.",
        ),
    ] = None,
    title: Annotated[str, typer.Option("--title", help="Title of the page.")] = "Results",
    pictures: Annotated[
        bool,
        typer.Option("--pictures/--no-pictures", help="Show the clouds with the largest errors, and strips of videos."),
    ] = True,
    as_markdown: Annotated[bool, typer.Option("--markdown", help="Print markdown instead of a page.")] = False,
    as_latex: Annotated[bool, typer.Option("--latex", help="Print LaTeX tables (booktabs) instead of a page.")] = False,
    force: Force = False,
) -> None:
    """Write one self-contained page of many results: tables, confusion matrices, error clouds, video strips, provenance."""
    form = _form(output, as_markdown, as_latex)
    _check_output(output, force)
    from dpcli.evaluate.commands.report import run_report
    from dpcli.runtime.progress import log
    from dpcli.runtime.whole_file import write_whole

    made = run_report(results, form, truth=truth, split=split, beside=beside or [], title=title, pictures=pictures)
    for text in made.duplicates:
        log.warn(text)
    if output in (None, "-"):
        typer.echo(made.text, nl=False)
    else:
        write_whole(Path(output), made.text.encode("utf-8"))
        log.info(f"wrote {output}: {counted(made.results, 'result')}, {len(made.text.encode()) / 1e6:.2f} MB")


def _form(output: str | None, as_markdown: bool, as_latex: bool) -> str:
    """Returns html, markdown or latex: as asked, else by the output's ending."""
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
    from dpcli.runtime.whole_file import refuse_existing

    if output in (None, "-"):
        return
    refuse_existing(output, force)
    if not Path(output).absolute().parent.is_dir():
        raise DataError(f"-o {output}: the folder {Path(output).parent} does not exist; create it first")
