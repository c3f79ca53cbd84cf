"""Training in two stages: the static stream, then the dynamic stream on its frozen activations; then their fusion.

Thesis section 3.4.2.3 and A.1.3. A run can be stopped at any step and continued to the same result: every clip's
randomness comes from (seed, epoch, position), what a step drops from (seed, stage, epoch, step), and the state holds weights,
optimizer and the step. Several processes (torchrun) share each batch and take the steps that one process would take.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import torch

from dpcli.classify.data.clips import ClipSource
from dpcli.classify.network.kinet import STREAMS, Kinet
from dpcli.classify.network.model_file import ModelInfo, load_model, save_model
from dpcli.classify.training.epoch_batches import Batch, EpochBatches
from dpcli.classify.training.fine_tune import freeze, train_mode
from dpcli.classify.training.learning_rate_schedule import learning_rate
from dpcli.classify.training.neighbor_cache import NeighborCache
from dpcli.classify.training.optimizer_step import StageStep, watch_of
from dpcli.classify.training.schedule import Schedule
from dpcli.classify.training.validation import validation_accuracy
from dpcli.errors import DpcError
from dpcli.runtime.distributed import Processes
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.run_folder import RunFolder, state_of, take_state
from dpcli.runtime.seeds import torch_seed
from dpcli.runtime.signals import StopRequest

_SAVED = ("stage", "epoch", "step", "best", "sums", "spent", "model")  # of a trainer, beside the optimizer


class Trainer:
    """Runs both stages of one model. `training` and `validation` are clip sources (validation may be None)."""

    def __init__(
        self,
        model: Kinet,
        info: ModelInfo,
        folder: RunFolder,
        schedule: Schedule,
        training: ClipSource,
        validation: ClipSource | None,
        device: torch.device,
        stop: StopRequest,
        processes: Processes | None = None,
    ) -> None:
        self.model, self.info, self.folder, self.schedule = model.to(device), info, folder, schedule
        self.training, self.validation, self.device, self.stop = training, validation, device, stop
        self.processes = processes or Processes()
        self.stage, self.epoch, self.step = 0, 0, 0  # where the run is: stream, its epoch, batch within the epoch
        self.best = [-1.0, -1.0]  # validation accuracy of each stream
        self.sums = [0.0, 0.0, 0.0, 0.0]  # of the epoch so far: loss, correct, clips, those of no class
        self.spent = 0.0  # seconds of the epoch before a stop
        self.optimize: StageStep | None = None
        self.watch = watch_of(info.config.num_classes)

    def run(self) -> None:
        """Trains from wherever the folder's state says to the end of the dynamic stage; does nothing when it is there."""
        self.folder.resume(self._restore)
        if self.stage == 2:
            return
        for stage in range(self.stage, 2):
            if stage > self.stage:
                self.stage, self.epoch, self.step, self.optimize = stage, 0, 0, None
            self._run_stage()
            self._load_best_stream()
        self.model.eval()
        self._save_model("best.safetensors")
        self.stage = 2
        self._save_state()

    def validate(self) -> dict[str, float]:
        """Returns the validation videos' accuracy by stream, fused once both streams are trained."""
        # the dynamic stream is not trained yet, or never
        static_only = self.stage == 0 or not self.schedule.epochs_dynamic
        streams = STREAMS[:1] if static_only else (*STREAMS, "fused")
        return validation_accuracy(self.model, self.validation, self.schedule, self.processes, self.device, streams)

    def _run_stage(self) -> None:
        if self.stage == 1:
            self.model.freeze_static()
        epochs = self.schedule.stage_epochs[self.stage]
        if not epochs:
            return
        data = self._batches()
        if self.optimize is None:
            self.optimize = self._new_step(data)
        self.watch = watch_of(self.info.config.num_classes)
        clips = data.count * data.size
        with Progress(f"train {STREAMS[self.stage]}", epochs * clips, "clip") as bar:
            bar.skip(self.epoch * clips + self.step * data.size)
            while self.epoch < epochs:
                self._run_epoch(data, epochs, bar)

    def _batches(self) -> EpochBatches:
        return EpochBatches(self.training, self.schedule, self.processes, self.stage)

    @property
    def _branch(self) -> torch.nn.Module:
        return self.model.static if self.stage == 0 else self.model.dynamic

    def _new_step(self, data: EpochBatches) -> StageStep:
        freeze(self._branch, self.schedule.fine_tune)
        neighbors = None
        if data.draws:
            neighbors = NeighborCache(self.model.group, self.folder.path, data.clips * data.draws)
        return StageStep(self.model, self.stage, self.schedule, self.device, self.processes, neighbors)

    def _run_epoch(self, data: EpochBatches, epochs: int, bar: Progress) -> None:
        train_mode(self._branch, self.schedule.fine_tune)
        started, steps = time.monotonic(), epochs * data.count
        done = self.epoch * data.count
        # a run stopped after an epoch's last step has none left to do, and logs that one's rate
        rate = learning_rate(self.schedule, self.stage, done + max(self.step - 1, 0), steps)
        for batch in self._load(data):
            rate = learning_rate(self.schedule, self.stage, done + self.step, steps)
            stopping = self._take(*batch, rate)
            loss, accuracy = self._means()
            bar.note(epoch=f"{self.epoch + 1}/{epochs}", loss=loss, accuracy=accuracy)
            bar.advance(data.size)
            if stopping:
                self._stop_here(started)
        self._end_epoch(rate, started)

    def _load(self, data: EpochBatches) -> Iterator[Batch]:
        """Yields the epoch's batches from `self.step` on. Raises DpcError, once the work is saved, when a worker was killed."""
        try:
            yield from data.load(self.epoch, self.step)
        except ChildProcessError as error:
            self._save_state(together=False)
            raise DpcError(
                f"a process that loads clips was killed, perhaps for lack of memory ({error});"
                f" saved at epoch {self.epoch + 1}, step {self.step}: run again to continue, with fewer workers"
                " (--set workers=0)"
            ) from None

    def _take(self, points: torch.Tensor, labels: torch.Tensor, clips: torch.Tensor, rate: float) -> bool:
        """Takes one step of all processes together; returns whether one of them was asked to stop."""
        where = (self.training.seed, self.stage, self.epoch, self.step, self.processes.rank)
        torch.manual_seed(torch_seed(*where))  # dropout, whenever the run was begun
        loss, correct, stepped = self.optimize(points, labels, rate, clips)
        shares = (loss, correct, len(labels), int((labels < 0).sum()), self.stop.requested)
        *sums, stopping = self.processes.sums(tuple(map(float, shares)), self.device)
        problem = self.watch.see(sums[0] / sums[2], stepped)
        if problem:
            raise DpcError(self._divergence(problem, rate))
        self.sums = [before + new for before, new in zip(self.sums, sums)]
        self.step += 1
        return stopping > 0

    def _means(self) -> tuple[float, float]:
        """Returns the mean loss of the epoch's clips so far, and the share of those with a class that is right."""
        loss, correct, clips, none = self.sums
        return loss / clips, correct / max(clips - none, 1)

    def _divergence(self, problem: str, rate: float) -> str:
        """Returns the sentences about a run whose loss or weights ran away."""
        kept = (
            "nothing was trained yet"
            if self.epoch == 0 and self.stage == 0
            else f"the last good weights are in {self.folder.file('last.safetensors')}"
        )
        where = f"{STREAMS[self.stage]} stage, epoch {self.epoch + 1}, step {self.step + 1}"
        return (
            f"training diverged ({where}, learning rate {rate:.3g}): {problem}; {kept}."
            f"\nStart another -o with a smaller {'--lr' if self.stage == 0 else 'lr_dynamic'}, or look at the data (dpc info FILE)"
        )

    def _stop_here(self, started: float) -> None:
        self.spent += time.monotonic() - started
        self._save_state()
        if not self.stop.requested:
            self.stop.requested, self.stop.name = True, "a signal to another process"
        self.stop.check(f"{STREAMS[self.stage]} stage saved at epoch {self.epoch + 1}, step {self.step}")

    def _end_epoch(self, rate: float, started: float) -> None:
        if not all(torch.isfinite(value).all() for value in self.model.state_dict().values()):
            raise DpcError(self._divergence("weights or batch statistics are no longer finite", rate))
        accuracy = None
        last = self.epoch + 1 == self.schedule.stage_epochs[self.stage]
        if self.validation is not None and (last or (self.epoch + 1) % self.schedule.validate_every == 0):
            accuracy = self.validate()[STREAMS[self.stage]]
        loss, train_accuracy = self._means()
        row = {
            "stage": STREAMS[self.stage],
            "epoch": self.epoch + 1,
            "loss": loss,
            "learning_rate": rate,
            "train_accuracy": train_accuracy,
            "validation_accuracy": accuracy,
            "seconds": round(self.spent + time.monotonic() - started, 2),
        }
        self.epoch, self.step, self.sums, self.spent = self.epoch + 1, 0, [0.0] * 4, 0.0
        if accuracy is not None and accuracy >= self.best[self.stage]:
            self.best[self.stage] = accuracy
            self._save_model("best.safetensors")
        self._save_model("last.safetensors")
        if self.processes.first:
            log.detail(f"{row}")
            self.folder.log(row)
            self.folder.draw_curves()
        self._save_state()

    def _load_best_stream(self) -> None:
        """Goes on from the epoch that validated best; without validation, from the last."""
        if self.best[self.stage] < 0:
            return
        self.processes.wait()  # the first one may still be writing them
        best, _ = load_model(str(self.folder.file("best.safetensors")), self.info.config.backbone)
        branch = STREAMS[self.stage]
        getattr(self.model, branch).load_state_dict(getattr(best, branch).state_dict())

    def _save_model(self, name: str) -> None:
        """Writes the weights. A run without a dynamic stage says that only its static stream may be asked for."""
        if self.processes.first:
            self.info.notes["streams"] = list(STREAMS) if self.schedule.epochs_dynamic else ["static"]
            save_model(self.folder.file(name), self.model, self.info)

    def _save_state(self, together: bool = True) -> None:
        """Saves all that a continued run needs. together: every process is here; none goes on, or ends, before it is safe."""
        if self.processes.first:
            optimizer = None if self.optimize is None else self.optimize.optimizer.state_dict()
            self.folder.save_state({**state_of(self, _SAVED), "optimizer": optimizer})
        if together:
            self.processes.wait()

    def _restore(self, state: dict) -> None:
        take_state(self, _SAVED, state)
        if self.stage < 2 and state["optimizer"] is not None:
            if self.stage == 1:
                self.model.freeze_static()
            self.optimize = self._new_step(self._batches())
            self.optimize.optimizer.load_state_dict(state["optimizer"])
        where = None if self.stage == 2 else f"stage {self.stage + 1} of 2, epoch {self.epoch + 1}"
        self.folder.tell_continuing(where)
