"""Work cut into pieces that stay in a core's cache, shared by threads each of which computes alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch

from dpcli.ops.backend import run_in_threads
from dpcli.runtime.tuning import torch_threads

Task, Room = TypeVar("Task"), TypeVar("Room")

# Pieces of a sum, each added up in an array of its own: more than there are threads, and always as many, so that sums
# repeat exactly on any number of threads.
TASKS = 8


def ranges(count: int, parts: int) -> list[tuple[int, int]]:
    """Cuts 0..count into at most `parts` ranges (low, high) whose lengths differ by one at most."""
    parts = max(1, min(parts, count))
    bounds = [count * part // parts for part in range(parts + 1)]
    return list(zip(bounds, bounds[1:]))


def steps(low: int, high: int, step: int) -> list[tuple[int, int]]:
    """Cuts low..high into ranges (low, high) of length `step`; the last may be shorter."""
    return [(start, min(start + step, high)) for start in range(low, high, step)]


def share_tasks(tasks: Sequence[Task], make_room: Callable[[], Room], work: Callable[[int, Task, Room], None]) -> None:
    """Calls work(number, task, room) for every task; `make_room` makes each thread a workspace, `room`, that it uses again.

    There are as many threads as torch has, and each computes its matrix products alone: threads that shared a product would
    wait for one another several times a task, and longer than they work. No gradients are recorded.
    """
    threads, inference = torch.get_num_threads(), torch.is_inference_mode_enabled()
    waiting = iter(enumerate(tasks))

    def run(*_: int) -> None:
        torch.set_num_threads(1)  # of this thread's products
        room = make_room()
        with torch.inference_mode(inference), torch.no_grad():  # modes are a thread's own, and tensors know theirs
            for number, task in waiting:
                work(number, task, room)

    with torch_threads(threads):  # the caller works, too, and gets its threads back
        run_in_threads(run, (), min(threads, len(tasks)), item_ns=1e9)
