"""Training in two stages: the static stream, then the dynamic stream on its frozen activations; then their fusion.

Thesis section 3.4.2.3 and A.1.3. A run can be stopped at any step and continued to the same result: every clip's
randomness comes from (seed, epoch, position), what a step drops from (seed, stage, epoch, step), and the state holds weights,
optimizer and the step. Several processes
(torchrun) share each batch and take the steps that one process would take.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import torch

from dpcli.classify.data.clips import Clip, ClipSource
from dpcli.classify.network.kinet import STREAMS, Kinet, fuse
from dpcli.classify.network.model_file import ModelInfo, load_model, save_model
from dpcli.classify.training.neighbor_cache import NeighborCache
from dpcli.classify.training.optimizer_step import LossWatch, StageStep
from dpcli.classify.training.schedule import Schedule
from dpcli.classify.video_scores import batches
from dpcli.errors import DpcError
from dpcli.runtime.distributed import Processes
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.seeds import DRAWS_PER_STAGE, ClassifyStream, generator, torch_seed
from dpcli.runtime.signals import StopRequest


class _Loader(torch.utils.data.Dataset):
    """One draw's clips as arrays, for a DataLoader: points, label, and the clip's number among all draws."""

    def __init__(self, source: ClipSource, clips: list[Clip], draw: int, first: int) -> None:
        self.source, self.clips, self.draw, self.first = source, clips, draw, first

    def __len__(self) -> int:
        return len(self.clips)

    def __getitem__(self, index: int) -> tuple[torch.Tensor, int, int]:
        clip = self.clips[index]
        points = torch.from_numpy(np.ascontiguousarray(self.source.load(clip, self.draw, index, 0), np.float32))
        return points, int(self.source.reader.labels[clip.sequence]), self.first + index


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
        self.share = (
            schedule.share(self.processes.count) * schedule.accumulate
        )  # clips of a batch that are this process's
        self.stage, self.epoch, self.step = 0, 0, 0  # where the run is: stream, its epoch, batch within the epoch
        self.best = [-1.0, -1.0]  # validation accuracy of each stream
        self.sums = [0.0, 0.0, 0.0]  # loss, correct, clips of the epoch so far
        self.spent = 0.0  # seconds of the epoch before a stop
        self.optimize: StageStep | None = None
        self.watch = LossWatch(info.config.num_classes)

    def run(self) -> None:
        """From wherever the folder's state says to the end of the dynamic stage; nothing when it is there."""
        state = self.folder.load_state()
        if state is not None:
            self._restore(state)
        if self.stage == 2:
            return
        for stage in range(self.stage, 2):
            if stage > self.stage:
                self.stage, self.epoch, self.step, self.optimize = stage, 0, 0, None
            self._run_stage()
            self._keep_best_weights()
        self.model.eval()
        self._save_model("best.safetensors")
        self.stage = 2
        self._save()

    def _run_stage(self) -> None:
        if self.stage == 1:
            self.model.freeze_static()
        epochs = self.schedule.epochs[self.stage]
        if not epochs:
            return
        if self.optimize is None:
            self.optimize = self._new_step()
        self.watch = LossWatch(self.info.config.num_classes)
        clips = self._per_epoch(self.training.epoch(0, self.schedule.clips_per_video)) * self.schedule.batch
        name = f"train {STREAMS[self.stage]}"
        with Progress(name, epochs * clips, "clip") as bar:
            bar.skip(self.epoch * clips + self.step * self.schedule.batch)
            while self.epoch < epochs:
                self._run_epoch(epochs, bar)

    def _new_step(self) -> StageStep:
        neighbors = None
        if self._draws():
            clips = len(self.training.epoch(0, self.schedule.clips_per_video))
            neighbors = NeighborCache(self.model.group, self.folder.path, clips * self._draws())
        return StageStep(self.model, self.stage, self.schedule, self.device, self.processes, neighbors)

    def _draws(self) -> int:
        """How many draws of every clip this stage comes back to; 0: each epoch has its own."""
        return min(self.schedule.draws or 0, self.schedule.epochs[1]) if self.stage == 1 else 0

    def _run_epoch(self, epochs: int, bar: Progress) -> None:
        (self.model.static if self.stage == 0 else self.model.dynamic).train()
        started = time.monotonic()
        turn = self.epoch % self._draws() if self._draws() else self.epoch
        draw = self.stage * DRAWS_PER_STAGE + turn
        clips = self.training.epoch(draw, self.schedule.clips_per_video)
        per_epoch = self._per_epoch(clips)
        loader = _Loader(self.training, clips, draw, turn * len(clips))
        order = self._order(len(clips))[: per_epoch * self.schedule.batch]
        # a run stopped after an epoch's last step has none left to do, and logs that one's rate
        rate = self.schedule.rate(self.stage, self.epoch * per_epoch + max(self.step - 1, 0), epochs * per_epoch)
        for batch in self._batches(loader, order):
            rate = self.schedule.rate(self.stage, self.epoch * per_epoch + self.step, epochs * per_epoch)
            stopping = self._take(*batch, rate)
            bar.note(
                epoch=f"{self.epoch + 1}/{epochs}",
                loss=self.sums[0] / self.sums[2],
                accuracy=self.sums[1] / self.sums[2],
            )
            bar.advance(self.schedule.batch)
            if stopping:
                self._stop_here(started)
        self._end_epoch(rate, started)

    def _order(self, clips: int) -> list[int]:
        """In which order an epoch takes its draw's clips: as drawn, or, of a draw that comes back, in another one each time."""
        if not self._draws():
            return list(range(clips))
        return generator(self.training.seed, ClassifyStream.DRAW_ORDER, self.epoch).permutation(clips).tolist()

    def _take(self, points: torch.Tensor, labels: torch.Tensor, clips: torch.Tensor, rate: float) -> bool:
        """One step of all processes together; whether one of them was asked to stop."""
        assert self.optimize is not None
        where = (self.training.seed, self.stage, self.epoch, self.step, self.processes.rank)
        torch.manual_seed(torch_seed(*where))  # dropout, whenever the run was begun
        loss, correct, stepped = self.optimize(points, labels, rate, clips)
        shares = (loss, float(correct), float(len(labels)), float(self.stop.requested))
        loss, correct, count, stopping = self.processes.sums(shares, self.device)
        problem = self.watch.see(loss / count, stepped)
        if problem:
            raise DpcError(self._diverged(problem, rate))
        self.sums = [before + new for before, new in zip(self.sums, (loss, correct, count))]
        self.step += 1
        return stopping > 0

    def _diverged(self, problem: str, rate: float) -> str:
        kept = (
            "nothing was trained yet"
            if self.epoch == 0 and self.stage == 0
            else f"the last good weights are in {self.folder.file('last.safetensors')}"
        )
        where = f"{STREAMS[self.stage]} stage, epoch {self.epoch + 1}, step {self.step + 1}"
        return (
            f"training diverged ({where}, learning rate {rate:.3g}): {problem}; {kept}."
            f"\nStart another -o with a smaller --lr{'' if self.stage == 0 else '-dynamic'}, or look at the data (dpc info FILE)"
        )

    def _stop_here(self, started: float) -> None:
        self.spent += time.monotonic() - started
        self._save()
        if not self.stop.requested:
            self.stop.requested, self.stop.name = True, "a signal to another process"
        self.stop.check(f"{STREAMS[self.stage]} stage saved at epoch {self.epoch + 1}, step {self.step}")

    def _per_epoch(self, clips: list[Clip]) -> int:
        """Whole batches in an epoch; the few clips left over come in another epoch's order."""
        return max(len(clips) // self.schedule.batch, 1)

    def _batches(self, data: _Loader, order: list[int]) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
        """This process's part of the epoch's batches from `self.step` on: points, labels, numbers of the clips.

        Each clip's position in its draw, not the process, seeds it.
        """
        starts = range(
            self.step * self.schedule.batch + self.processes.rank * self.share, len(order), self.schedule.batch
        )
        mine = torch.utils.data.Subset(data, [i for start in starts for i in order[start : start + self.share]])
        workers = (
            {"num_workers": self.schedule.workers, "multiprocessing_context": "forkserver"}
            if self.schedule.workers
            else {}
        )
        try:
            yield from torch.utils.data.DataLoader(mine, self.share, **workers)
        except RuntimeError as error:
            if "DataLoader worker" not in str(error):
                raise
            self._save(together=False)
            raise DpcError(
                f"a process that loads clips was killed, perhaps for want of memory ({str(error).splitlines()[0]});"
                f" saved at epoch {self.epoch + 1}, step {self.step}: run again to continue, with fewer --workers"
            ) from None

    def _end_epoch(self, rate: float, started: float) -> None:
        if not all(torch.isfinite(value).all() for value in self.model.state_dict().values()):
            raise DpcError(self._diverged("weights or batch statistics are no longer finite", rate))
        accuracy = None
        last = self.epoch + 1 == self.schedule.epochs[self.stage]
        if self.validation is not None and (last or (self.epoch + 1) % self.schedule.validate_every == 0):
            accuracy = self.validate()[STREAMS[self.stage]]
        seconds = self.spent + time.monotonic() - started
        row = {
            "stage": STREAMS[self.stage],
            "epoch": self.epoch + 1,
            "loss": self.sums[0] / self.sums[2],
            "learning_rate": rate,
            "train_accuracy": self.sums[1] / self.sums[2],
            "validation_accuracy": accuracy,
            "seconds": round(seconds, 2),
        }
        self.epoch, self.step, self.sums, self.spent = self.epoch + 1, 0, [0.0, 0.0, 0.0], 0.0
        better = accuracy is not None and accuracy >= self.best[self.stage]
        if better:
            self.best[self.stage] = accuracy
            self._save_model("best.safetensors")
        self._save_model("last.safetensors")
        if self.processes.first:
            log.detail(f"{row}")
            self.folder.log(row)
            self.folder.draw_curves()
        self._save()

    def _keep_best_weights(self) -> None:
        """Go on from the epoch that validated best; without validation, from the last."""
        if self.best[self.stage] < 0:
            return
        self.processes.wait()  # the first one may still be writing them
        best, _ = load_model(str(self.folder.file("best.safetensors")), self.info.config.backbone)
        branch = STREAMS[self.stage]
        getattr(self.model, branch).load_state_dict(getattr(best, branch).state_dict())

    @torch.inference_mode()
    def validate(self) -> dict[str, float]:
        """Share of validation videos classified rightly (scores averaged over clips), by stream; fused once both are trained."""
        assert self.validation is not None
        self.model.eval()
        mine = set(self.validation.sequences[self.processes.rank :: self.processes.count])
        clips = [clip for clip in self.validation.clips(self.schedule.validation_clips) if clip.sequence in mine]
        totals: dict[str, dict[int, torch.Tensor]] = {
            name: {} for name in (STREAMS[:1] if self._static_only() else (*STREAMS, "fused"))
        }
        for chosen, points in batches(self.validation, clips, self.schedule.batch):
            for key, scores in self._scores(points.to(self.device)).items():
                for clip, row in zip(chosen, scores.cpu()):
                    totals[key][clip.sequence] = totals[key].get(clip.sequence, 0) + row
        labels = self.validation.reader.labels
        right = [sum(int(row.argmax()) == int(labels[s]) for s, row in sums.items()) for sums in totals.values()]
        counted = self.processes.sums([*map(float, right), float(len(mine))], self.device)
        return dict(zip(totals, (value / counted[-1] for value in counted[:-1])))

    def _scores(self, points: torch.Tensor) -> dict[str, torch.Tensor]:
        """Class probabilities of a batch by stream."""
        if self._static_only():
            return {"static": torch.softmax(self.model.static_logits(points), -1)}
        static, dynamic = self.model(points)
        fused = fuse(static, dynamic, self.model.config.fusion)
        return {"static": torch.softmax(static, -1), "dynamic": torch.softmax(dynamic, -1), "fused": fused}

    def _static_only(self) -> bool:
        """Whether the dynamic stream is still untrained, or will stay so."""
        return self.stage == 0 or not self.schedule.epochs[1]

    def _save_model(self, name: str) -> None:
        if self.processes.first:
            self.info.notes["streams"] = self._trained_streams()
            save_model(self.folder.file(name), self.model, self.info)

    def _trained_streams(self) -> list[str]:
        """Which streams the weights may be asked for: a run without a dynamic stage has the static one only."""
        return list(STREAMS) if self.schedule.epochs[1] else ["static"]

    def _save(self, together: bool = True) -> None:
        """together: every process is here; none goes on, or ends, before the work is safe."""
        if self.processes.first:
            self.folder.save_state(
                {
                    "stage": self.stage,
                    "epoch": self.epoch,
                    "step": self.step,
                    "best": self.best,
                    "sums": self.sums,
                    "spent": self.spent,
                    "model": self.model.state_dict(),
                    "optimizer": self.optimize.optimizer.state_dict() if self.optimize is not None else None,
                }
            )
        if together:
            self.processes.wait()

    def _restore(self, state: dict) -> None:
        for key in ("stage", "epoch", "step", "best", "sums", "spent"):
            setattr(self, key, state[key])
        self.model.load_state_dict(state["model"])
        if self.stage < 2 and state["optimizer"] is not None:
            if self.stage == 1:
                self.model.freeze_static()
            self.optimize = self._new_step()
            self.optimize.optimizer.load_state_dict(state["optimizer"])
        where = None if self.stage == 2 else f"stage {self.stage + 1} of 2, epoch {self.epoch + 1}"
        self.folder.tell_continuing(where)
