"""Markdown of texts that may come from files: all that commands and reports write of it goes through here."""

from __future__ import annotations

import re
from collections.abc import Sequence

from dpcli.standard_streams import printable

_MARKS = {**{mark: f"\\{mark}" for mark in "\\`*_[]>|#~&"}, "<": "&lt;"}  # programs that cut tags out know no \\


def as_markdown(text: str) -> str:
    """Returns text that means nothing to markdown: on one line, its marks escaped, what would command a terminal spelled."""
    return "".join(_MARKS.get(letter, letter) for letter in _flat(text))


def markdown_code(text: str) -> str:
    """Returns text between so many backticks that none in it ends it."""
    flat = _flat(text)
    fence = "`" * (1 + max(map(len, re.findall("`+", flat)), default=0))
    pad = " " if fence != "`" else ""
    return f"{fence}{pad}{flat}{pad}{fence}"


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]], numeric: Sequence[bool]) -> str:
    """Returns a table whose first column is aligned to the left, and those that are `numeric` to the right."""
    rules = ["---", *("---:" if right else "---" for right in numeric[1:])]
    lines = [
        [as_markdown(name) or " " for name in header],
        rules,
        *([as_markdown(cell) for cell in row] for row in rows),
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _flat(text: str) -> str:
    return printable(" ".join(text.split()))
