"""Frames read ahead in a thread of their own, so that arrival is timed and a signal is noticed while the pipe is silent."""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Iterator
from statistics import median

import numpy as np

from dpcli.runtime.signals import StopRequest

_GAPS = 48  # between frames, by which a rate is judged: more than a pipe holds of what was sent before anybody read it
_AT_ONCE = 0.005  # seconds; no camera is as fast, but a program that sends what it has recorded


class ReadAhead:
    """Reads frames in a thread of its own, at most `room` ahead; then the writer is held back. Nothing is dropped."""

    def __init__(self, frames: Iterator[np.ndarray], room: int) -> None:
        self._queue: queue.Queue = queue.Queue(room)
        self._closed = threading.Event()
        threading.Thread(target=self._run, args=(frames,), daemon=True, name="frames").start()

    def _run(self, frames: Iterator[np.ndarray]) -> None:
        try:
            began = time.monotonic()
            for points in frames:
                arrived = time.monotonic()
                self._put((points, arrived, arrived - began))
                if self._closed.is_set():
                    return
                began = time.monotonic()  # not before: while there is no room, it is not the writer who is silent
            self._put(None)
        except Exception as error:  # raised again where the frames are taken, after those before it
            self._put(error)

    def _put(self, item: object) -> None:
        while not self._closed.is_set():
            try:
                return self._queue.put(item, timeout=0.2)
            except queue.Full:
                continue

    @property
    def waiting(self) -> int:
        """Returns the number of frames that have arrived and were not taken yet."""
        return self._queue.qsize()

    def frames(self, stop: StopRequest) -> Iterator[tuple[np.ndarray, float, float]]:
        """Yields (points, time.monotonic() at arrival, seconds that it was waited for) until the stream ends or a stop is
        asked for."""
        while not stop.requested:
            try:
                item = self._queue.get(timeout=0.1)
            except queue.Empty:
                continue
            if item is None:
                return
            if isinstance(item, Exception):
                raise item
            yield item

    def close(self) -> None:
        """Ends the thread once it looks up; what it has read is dropped."""
        self._closed.set()


class Pace:
    """Finds the rate of frames whose writer sets the pace, as a camera does: not a recording that is sent at once, nor frames that come
    together or are held back here."""

    def __init__(self) -> None:
        self._gaps: deque[float] = deque(maxlen=_GAPS)
        self._last = -np.inf

    def see(self, arrived: float, waited: float) -> float | None:
        """Takes the time at which a frame arrived and the seconds that it was waited for; returns the median seconds from frame to
        frame, None until they are known."""
        gap, self._last = arrived - self._last, arrived
        self._gaps.append(gap if _AT_ONCE < gap < 2 * waited else 0.0)
        paced = [gap for gap in self._gaps if gap]
        return median(paced) if 4 * len(paced) >= 3 * _GAPS else None
