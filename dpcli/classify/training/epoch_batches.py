"""The clips of an epoch in batches: which clips, in which order, and which of them are one process's."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from dpcli.classify.data.clips import Clip, ClipSource
from dpcli.classify.training.schedule import Schedule
from dpcli.errors import first_line
from dpcli.runtime.distributed import Processes
from dpcli.runtime.seeds import DRAWS_PER_STAGE, ClassifyStream, generator
from dpcli.runtime.worker_server import choose_socket_folder

# Points (b,T,P,3), labels (b), -1 for none, and numbers of the clips (b).
Batch = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


class _ClipDataset(torch.utils.data.Dataset):
    """Gives one draw's clips as arrays, for a DataLoader: points, label, and the clip's number among all draws."""

    def __init__(self, source: ClipSource, clips: list[Clip], draw: int, first: int) -> None:
        self.source, self.clips, self.draw, self.first = source, clips, draw, first

    def __len__(self) -> int:
        return len(self.clips)

    def __getitem__(self, index: int) -> tuple[torch.Tensor, int, int]:
        clip = self.clips[index]
        points = torch.from_numpy(np.ascontiguousarray(self.source.load(clip, self.draw, index, 0), np.float32))
        return points, self.source.target(clip), self.first + index


class EpochBatches:
    """Gives each epoch's batches of one stage (0 static, 1 dynamic) to one of the processes.

    Each clip's position in its draw, not the process, seeds what is drawn from it.
    """

    def __init__(self, source: ClipSource, schedule: Schedule, processes: Processes, stage: int) -> None:
        self.source, self.schedule, self.processes, self.stage = source, schedule, processes, stage
        self.share = schedule.share(processes.count) * schedule.accumulate  # clips of a batch that are this process's
        self.clips = len(self._draw(0))  # of an epoch
        self.size = min(schedule.batch, self.clips)  # clips of a batch, of all processes together
        self.count = max(self.clips // schedule.batch, 1)  # whole batches; clips left over come in another epoch

    @property
    def draws(self) -> int:
        """Returns the number of draws of every clip that the stage comes back to; 0 where each epoch has its own."""
        return min(self.schedule.draws, self.schedule.epochs_dynamic) if self.stage == 1 else 0

    def load(self, epoch: int, first: int) -> Iterator[Batch]:
        """Yields this process's parts of an epoch's batches, from the batch `first` on.

        Raises ChildProcessError when a process that loads clips was killed.
        """
        turn = epoch % self.draws if self.draws else epoch
        number = self.stage * DRAWS_PER_STAGE + turn
        clips = self._draw(number)
        order = self._order(epoch, len(clips))[: self.count * self.schedule.batch]
        starts = range(first * self.schedule.batch + self.processes.rank * self.share, len(order), self.schedule.batch)
        mine = [i for start in starts for i in order[start : start + self.share]]
        dataset = _ClipDataset(self.source, clips, number, turn * len(clips))
        workers = self.schedule.workers
        options = {"num_workers": workers, "multiprocessing_context": "forkserver"} if workers else {}
        if workers:
            choose_socket_folder()
        try:
            yield from torch.utils.data.DataLoader(torch.utils.data.Subset(dataset, mine), self.share, **options)
        except Exception as error:
            if not _tells_of_killed_worker(error):
                raise
            raise ChildProcessError(first_line(error)) from error

    def _draw(self, number: int) -> list[Clip]:
        return self.source.epoch(number, self.schedule.clips_per_video or None, self.schedule.video_loss)

    def _order(self, epoch: int, clips: int) -> list[int]:
        """Returns the order in which an epoch takes its clips: as drawn, or, where draws come back, another one each time."""
        if not self.draws:
            return list(range(clips))
        together = self.schedule.clips_per_loss
        order = generator(self.source.seed, ClassifyStream.DRAW_ORDER, epoch).permutation(clips // together)
        return (order[:, None] * together + np.arange(together)).ravel().tolist()


def _tells_of_killed_worker(error: Exception) -> bool:
    """Returns whether a loader's error says that a worker was killed: in torch's words, or, before it knows, by a pipe that ended.

    >>> _tells_of_killed_worker(RuntimeError("DataLoader worker (pid 7) is killed by signal: Killed. "))
    True
    >>> _tells_of_killed_worker(EOFError()), _tells_of_killed_worker(ConnectionResetError(104, "Connection reset by peer"))
    (True, True)

    What the work itself raised in a worker comes with another sentence of torch before it.

    >>> _tells_of_killed_worker(RuntimeError("Caught RuntimeError in DataLoader worker process 0."))
    False
    """
    said = str(error)
    pipe_ended = isinstance(error, (EOFError, ConnectionError)) and not said.startswith("Caught ")
    return pipe_ended or "DataLoader worker (pid" in said
