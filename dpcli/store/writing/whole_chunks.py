"""Rows of an uncompressed data set, written to the file once, as whole chunks; the fast form knows at which places.

`tuning.fast_transport` chooses between two forms that leave the same bytes. The plain one lets HDF5 write each chunk.
The fast one hands chunks to the file past HDF5's cache, which would copy each row once more, and says where they are,
so that the journal need not hold them a second time.
"""

from __future__ import annotations

import os

import h5py
import numpy as np

from dpcli.runtime.tuning import fast_transport
from dpcli.store.writing.journal import Placed

_LOOKED_AT = 512  # bytes at either end of a chunk that tell whether it is where it should be


def chunk_writer(data: h5py.Dataset) -> PlainChunks:
    """Returns what appends rows to a chunked data set without a filter: in the fast form, unless the plain one is asked for."""
    return (WholeChunks if fast_transport() else PlainChunks)(data)


class PlainChunks:
    """Appends rows to a chunked data set without a filter, a whole chunk at a time; the rest waits here until `finish`."""

    def __init__(self, data: h5py.Dataset) -> None:
        self.data, self.rows = data, data.chunks[0]
        self._waiting = np.empty(data.chunks, data.dtype)
        self._row_bytes = self._waiting[0].nbytes  # asked of HDF5 each time it would cost as much as the writing
        self._done = len(data)  # rows in whole chunks
        self._filled = 0  # rows that wait

    def append(self, values: np.ndarray) -> Placed | None:
        """Appends values (n, ...). Returns them with (offset in the file, bytes) of those first rows of them that are there.

        None where that isn't known, or the file holds them as another type than `values`.
        """
        given, values = values, np.ascontiguousarray(values, self._waiting.dtype)
        self.data.resize(self._done + self._filled + len(values), axis=0)
        pieces: list[tuple[int, int]] = []
        start = 0
        while self._filled + len(values) - start >= self.rows:
            own = self.rows - self._filled
            chunk = values[start : start + own]
            if self._filled:
                self._waiting[self._filled :] = chunk
            offset = self._write(self._waiting if self._filled else chunk)
            if offset is not None:
                _add(pieces, offset + self._filled * self._row_bytes, own * self._row_bytes)
            start, self._filled = start + own, 0
        rest = values[start:]
        self._waiting[self._filled : self._filled + len(rest)] = rest
        self._filled += len(rest)
        return (given, pieces) if pieces and given.dtype == values.dtype else None

    def _write(self, chunk: np.ndarray) -> int | None:
        """Writes the next whole chunk; returns its place in the file where it is known."""
        self.data[self._done : self._done + self.rows] = chunk
        self.data.flush()  # now, so that it takes the place in the file that the fast form gives it
        self._done += self.rows
        return None

    def finish(self) -> None:
        """Writes the rows that wait."""
        if self._filled:
            self.data[self._done :] = self._waiting[: self._filled]
            self._done, self._filled = self._done + self._filled, 0


class WholeChunks(PlainChunks):
    """Writes chunks to the file at once, past HDF5's cache, so that their places are known: the fast form."""

    def __init__(self, data: h5py.Dataset) -> None:
        super().__init__(data)
        self._file = data.file.id.get_vfd_handle()
        self._end = -1  # of the file, after the chunk before

    def _write(self, chunk: np.ndarray) -> int:
        place = (self._done, *[0] * (self._waiting.ndim - 1))
        self.data.id.write_direct_chunk(place, chunk)
        self._done += self.rows
        # HDF5 would find it by going through all chunks. New ones are at the end: the file grew by just the chunk, or it
        # wrote notes of its own, too, and one has to look.
        before, self._end = self._end, os.fstat(self._file).st_size
        offset = self._end - chunk.nbytes
        if offset == before or self._is_at(offset, chunk):
            return offset
        return int(self.data.id.get_chunk_info_by_coord(place).byte_offset)

    def _is_at(self, offset: int, chunk: np.ndarray) -> bool:
        """Returns whether both ends of the chunk are where they would be, were it at `offset`."""
        if offset < 0:
            return False
        data, size = memoryview(chunk).cast("B"), min(_LOOKED_AT, chunk.nbytes)
        start, end = os.pread(self._file, size, offset), os.pread(self._file, size, offset + chunk.nbytes - size)
        return start == data[:size] and end == data[-size:]


def _add(pieces: list[tuple[int, int]], offset: int, length: int) -> None:
    """Adds a piece, as part of the last one where it follows that."""
    if pieces and sum(pieces[-1]) == offset:
        offset, before = pieces.pop()
        length += before
    pieces.append((offset, length))
