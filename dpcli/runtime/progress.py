"""Progress and messages, all on stderr: a live bar on a terminal, a plain line every few seconds in a batch log."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

from dpcli.standard_streams import printable, rich_console

_PLAIN_INTERVAL = 5.0  # seconds between lines in a log that is not a terminal


class _Log:
    """Writes messages on stderr. `level` is 0 (quiet: errors only), 1 (default) or 2 (verbose)."""

    def __init__(self) -> None:
        self.level = 1
        self.debug = False
        self._said: set[str] | None = None

    @contextmanager
    def each_once(self, said: set[str]) -> Iterator[None]:
        """Writes no text that is in `said`, to which it adds those it writes: for files that are read again and again."""
        before, self._said = self._said, said
        try:
            yield
        finally:
            self._said = before

    def _write(self, text: str) -> None:
        if self._said is not None:
            if text in self._said:
                return
            self._said.add(text)
        lines = printable(text, kept="\n\t").replace("\n", "\n     ")  # no name can begin a message of its own
        sys.stderr.write(f"dpc: {lines}\n")
        sys.stderr.flush()

    def detail(self, text: str) -> None:
        """Writes what only -v shows."""
        if self.level >= 2:
            self._write(text)

    def info(self, text: str) -> None:
        """Writes what -q hides."""
        if self.level >= 1:
            self._write(text)

    def warn(self, text: str) -> None:
        """Writes a warning, which -q hides."""
        if self.level >= 1:
            self._write(f"warning: {text}")

    def error(self, text: str) -> None:
        """Writes an error, always."""
        self._write(f"error: {text}")


log = _Log()


def duration(seconds: float) -> str:
    """Returns seconds as text, such as `1m15s` for 75.2; used for the time left."""
    seconds = int(max(seconds, 0))
    hours, minutes, rest = seconds // 3600, seconds % 3600 // 60, seconds % 60
    return f"{hours}h{minutes:02d}m" if hours else f"{minutes}m{rest:02d}s" if minutes else f"{rest}s"


class Progress:
    """Counts finished items of a long task.

    `advance(1, frames=54)` adds to extra counters, shown as rates (`frames/s`); `note(loss=...)` shows current values.
    On a terminal the bar is drawn by rich, elsewhere lines such as
    `dpc: prepare 120/800 15% 3.1 video/s eta 3m40s` appear every few seconds and once at the end.
    """

    def __init__(self, task: str, total: int | None, unit: str = "it", stream: TextIO | None = None) -> None:
        self.task, self.total, self.unit = printable(task), total, unit
        self.stream = stream or sys.stderr
        self.done, self.first = 0, 0
        self.counters: dict[str, float] = {}
        self.values: dict[str, object] = {}
        self.started = self._last = time.monotonic()
        self._shown: tuple[int, dict[str, object]] | None = None  # what the last line told
        self._bar = self._handle = None

    def __enter__(self) -> Progress:
        self.started = self._last = time.monotonic()
        live = self.stream.isatty() and os.environ.get("TERM") != "dumb"
        if log.level >= 1 and live:
            self._open_bar()
        return self

    def _open_bar(self) -> None:
        from rich.progress import BarColumn, TextColumn
        from rich.progress import Progress as Bar

        task, text = (TextColumn(of, markup=False) for of in ("{task.description}", "{task.fields[text]}"))
        self._bar = Bar(task, BarColumn(), text, console=rich_console(self.stream), transient=False)
        self._handle = self._bar.add_task(self.task, total=self.total, text="")
        self._bar.start()

    def skip(self, count: int) -> None:
        """Counts items that were done before this run: they count as done but not for the speed."""
        self.done += count
        self.first += count

    def advance(self, count: int = 1, **counters: float) -> None:
        """Counts `count` more items as done; `counters` are summed and shown per second."""
        self.done += count
        for key, value in counters.items():
            self.counters[key] = self.counters.get(key, 0) + value
        self._show()

    def note(self, **values: object) -> None:
        """Takes current values to show beside the bar, such as a loss."""
        self.values.update(values)

    def status(self) -> str:
        """Returns the line's text without the task's name."""
        elapsed = max(time.monotonic() - self.started, 1e-9)
        rate = (self.done - self.first) / elapsed
        parts = [f"{self.done}/{self.total} {100 * self.done // max(self.total, 1)}%" if self.total else f"{self.done}"]
        rates = {self.unit: rate} | {key: value / elapsed for key, value in self.counters.items()}
        parts += [f"{value:.2g} {key}/s" if value < 10 else f"{value:.0f} {key}/s" for key, value in rates.items()]
        parts += [f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in self.values.items()]
        if self.total and rate > 0 and self.done < self.total:
            parts.append(f"eta {duration((self.total - self.done) / rate)}")
        return printable(" ".join(parts))

    def _show(self, last: bool = False) -> None:
        if self._bar is not None:
            self._bar.update(self._handle, completed=self.done, text=self.status())
            return
        now, state = time.monotonic(), (self.done, dict(self.values))
        due = state != self._shown if last else now - self._last >= _PLAIN_INTERVAL
        if log.level >= 1 and due:
            self._last, self._shown = now, state
            self.stream.write(f"dpc: {self.task} {self.status()}\n")
            self.stream.flush()

    def __exit__(self, *exc: object) -> None:
        self._show(last=True)
        if self._bar is not None:
            self._bar.stop()
