"""Readers of many files, of which only a few are open at a time."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

Reader = Any  # of any kind of file; it opens its file where that is needed, and has close()


class OpenReaders:
    """Keeps the files of the readers used last open, at most so many; as a context manager it closes them in the end."""

    def __init__(self, most: int) -> None:
        self.most = most
        self._latest: OrderedDict[Reader, None] = OrderedDict()

    def use(self, reader: Reader) -> Reader:
        """Returns the reader, whose file may be opened now."""
        self._latest[reader] = None
        self._latest.move_to_end(reader)
        while len(self._latest) > self.most:
            self._latest.popitem(last=False)[0].close()
        return reader

    def __enter__(self) -> OpenReaders:
        return self

    def __exit__(self, *exc: object) -> None:
        for reader in self._latest:
            reader.close()
