"""Rows of an uncompressed data set, written to the file once, as whole chunks, at places that are known."""

from __future__ import annotations

import os

import h5py
import numpy as np

_LOOKED_AT = 512  # bytes at either end of a chunk that tell whether it is where it should be
Pieces = list[tuple[int, int]]


class WholeChunks:
    """Appends rows to a chunked data set without a filter; whole chunks go to the file at once, past HDF5's cache.

    What is left of the last chunk waits here until `finish`. With a cache each row would be copied once more, and no
    one could say where in the file it is.
    """

    def __init__(self, data: h5py.Dataset) -> None:
        self.data, self.rows = data, data.chunks[0]
        self._file = data.file.id.get_vfd_handle()
        self._waiting = np.empty(data.chunks, data.dtype)
        self._row_bytes = self._waiting[0].nbytes  # asked of HDF5 each time it would cost as much as the writing
        self._done = len(data)  # rows in whole chunks
        self._filled = 0  # rows that wait
        self._end = -1  # of the file, after the chunk before

    def append(self, values: np.ndarray) -> Pieces:
        """Append (n, ...) -> (offset in the file, bytes), in order, of those first rows of `values` that are there."""
        values = np.ascontiguousarray(values, self._waiting.dtype)
        self.data.resize(self._done + self._filled + len(values), axis=0)
        pieces: Pieces = []
        start = 0
        while self._filled + len(values) - start >= self.rows:
            own = self.rows - self._filled
            chunk = values[start : start + own]
            if self._filled:
                self._waiting[self._filled :] = chunk
            self._add(pieces, self._write(self._waiting if self._filled else chunk) + self._bytes(self._filled), own)
            start, self._filled = start + own, 0
        rest = values[start:]
        self._waiting[self._filled : self._filled + len(rest)] = rest
        self._filled += len(rest)
        return pieces

    def _bytes(self, rows: int) -> int:
        return rows * self._row_bytes

    def _write(self, chunk: np.ndarray) -> int:
        """The next whole chunk -> its place in the file."""
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
        """Whether both ends of the chunk are where they would be, were it at `offset`."""
        if offset < 0:
            return False
        data, size = memoryview(chunk).cast("B"), min(_LOOKED_AT, chunk.nbytes)
        start, end = os.pread(self._file, size, offset), os.pread(self._file, size, offset + chunk.nbytes - size)
        return start == data[:size] and end == data[-size:]

    def _add(self, pieces: Pieces, offset: int, rows: int) -> None:
        if pieces and sum(pieces[-1]) == offset:
            offset, before = pieces.pop()
            pieces.append((offset, before + self._bytes(rows)))
        else:
            pieces.append((offset, self._bytes(rows)))

    def finish(self) -> None:
        """Write the rows that wait."""
        if self._filled:
            self.data[self._done :] = self._waiting[: self._filled]
            self._done, self._filled = self._done + self._filled, 0
