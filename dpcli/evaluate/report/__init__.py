"""This folder makes one page, or one document, from many results: collect them, arrange them as sections, write HTML, markdown or LaTeX."""

from __future__ import annotations

from dpcli.evaluate.report.arrange import arrange
from dpcli.evaluate.report.collect import Collected, CollectedResult, collect
from dpcli.evaluate.report.markdown_and_latex import report_latex, report_markdown
from dpcli.evaluate.report.page import report_html

__all__ = ["Collected", "CollectedResult", "arrange", "collect", "report_html", "report_latex", "report_markdown"]
