"""Training in two stages: the static stream, then the dynamic stream on its frozen activations; then their fusion.

Thesis section 3.4.2.3 and A.1.3. A run can be stopped at any step and continued to the same result: every clip's
randomness comes from (seed, epoch, position), and the state holds weights, optimiser and the step.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from dpcli.classify.clips import Clip, ClipSource
from dpcli.classify.kinet import STREAMS, Kinet, fuse
from dpcli.classify.model_file import ModelInfo, save_model
from dpcli.classify.predict import batches
from dpcli.errors import UsageError
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.signals import StopRequest

DECAYS = ("cosine", "staircase", "constant")


@dataclass(frozen=True)
class Schedule:
    """How long and how fast. Learning rates are Adam's; `staircase` is the release's x0.7 every 200,000 clips, floor 1e-5."""

    epochs: tuple[int, int] = (150, 150)  # static, dynamic
    batch: int = 16
    learning_rate: float = 1e-3
    learning_rate_dynamic: float | None = None  # None: the same
    decay: str = "cosine"  # cosine (after a short warm-up, to zero) | staircase | constant
    weight_decay: float = 0.0
    label_smoothing: float = 0.0
    clips_per_video: int | None = 1  # per epoch; None: every start
    validate_every: int = 1  # epochs
    validation_clips: int = 4  # per video
    workers: int = 0  # processes that load clips; 0: this one

    def __post_init__(self) -> None:
        rates = (self.learning_rate, self.learning_rate_dynamic)
        problem = {
            f"--batch {self.batch}: expected at least 1": self.batch < 1,
            f"--epochs {self.epochs}: expected 0 or more": min(self.epochs) < 0,
            f"--lr {rates}: expected numbers above 0": any(rate is not None and not rate > 0 for rate in rates),
            f"--decay {self.decay}: expected cosine, staircase or constant": self.decay not in DECAYS,
            f"--workers {self.workers}: expected 0 or more": self.workers < 0,
            f"--clips-per-video {self.clips_per_video}: expected 0 (every start) or more": (self.clips_per_video or 1)
            < 1,
        }
        for message, wrong in problem.items():
            if wrong:
                raise UsageError(message)

    def rate(self, stage: int, step: int, steps: int) -> float:
        """Learning rate at an optimiser step of a stage (0 static, 1 dynamic) with `steps` in all."""
        top = self.learning_rate if stage == 0 or self.learning_rate_dynamic is None else self.learning_rate_dynamic
        if self.decay == "constant":
            return top
        if self.decay == "staircase":
            return max(top * 0.7 ** (step * self.batch // 200_000), 1e-5)
        warm = max(1, min(100, steps // 10))
        if step < warm:
            return top * (step + 1) / warm
        return top * 0.5 * (1 + math.cos(math.pi * (step - warm) / max(steps - warm, 1)))


class _Loader(torch.utils.data.Dataset):
    """One epoch's clips as arrays, for a DataLoader."""

    def __init__(self, source: ClipSource, clips: list[Clip], epoch: int) -> None:
        self.source, self.clips, self.epoch = source, clips, epoch

    def __len__(self) -> int:
        return len(self.clips)

    def __getitem__(self, index: int) -> tuple[torch.Tensor, int]:
        clip = self.clips[index]
        points = self.source.load(clip, self.epoch, index, 0)
        return torch.from_numpy(np.ascontiguousarray(points, np.float32)), int(self.source.reader.labels[clip.sequence])


class Trainer:
    """Runs both stages of one model. `training` and `validation` are clip sources (validation may be None)."""

    def __init__(
        self, model: Kinet, info: ModelInfo, folder: RunFolder, schedule: Schedule, training: ClipSource,
        validation: ClipSource | None, device: torch.device, stop: StopRequest,
    ) -> None:  # fmt: skip
        self.model, self.info, self.folder, self.schedule = model.to(device), info, folder, schedule
        self.training, self.validation, self.device, self.stop = training, validation, device, stop
        self.stage, self.epoch, self.step = 0, 0, 0  # where the run is: stream, its epoch, batch within the epoch
        self.best = [-1.0, -1.0]  # validation accuracy of each stream
        self.sums = [0.0, 0, 0]  # loss, correct, clips of the epoch so far
        self.spent = 0.0  # seconds of the epoch before a stop
        self.optimizer: torch.optim.Optimizer | None = None

    def run(self) -> None:
        """From wherever the folder's state says to the end of the dynamic stage."""
        state = self.folder.load_state()
        if state is not None:
            self._restore(state)
        for stage in range(self.stage, 2):
            if stage > self.stage:
                self.stage, self.epoch, self.step, self.optimizer = stage, 0, 0, None
            self._run_stage()
            self._keep_best_weights()
        self.model.eval()
        save_model(self.folder.file("best.safetensors"), self.model, self.info)
        self.stage = 2
        self._save()

    def _run_stage(self) -> None:
        if self.stage == 1:
            self.model.freeze_static()
        branch = self._branch()
        if self.optimizer is None:
            self.optimizer = self._new_optimizer(branch)
        epochs = self.schedule.epochs[self.stage]
        clips = self._per_epoch(self.training.epoch(0, self.schedule.clips_per_video)) * self.schedule.batch
        name = f"train {STREAMS[self.stage]}"
        with Progress(name, epochs * clips, "clip") as bar:
            bar.skip(self.epoch * clips + self.step * self.schedule.batch)
            while self.epoch < epochs:
                self._run_epoch(branch, epochs, bar)

    def _branch(self) -> nn.Module:
        return self.model.static if self.stage == 0 else self.model.dynamic

    def _new_optimizer(self, branch: nn.Module) -> torch.optim.Optimizer:
        # The last layer sums a thousand pooled maxima, all positive: at the others' rate its first steps overshoot.
        named = dict(branch.named_parameters())
        last = [p for name, p in named.items() if name.startswith("head.classify")]
        rest = [p for name, p in named.items() if not name.startswith("head.classify")]
        groups = [
            {"params": last, "weight_decay": self.schedule.weight_decay, "share": 0.1},
            {"params": [p for p in rest if p.dim() > 1], "weight_decay": self.schedule.weight_decay, "share": 1.0},
            {"params": [p for p in rest if p.dim() <= 1], "weight_decay": 0.0, "share": 1.0},
        ]
        return torch.optim.AdamW(groups, lr=self.schedule.learning_rate)

    def _run_epoch(self, branch: nn.Module, epochs: int, bar: Progress) -> None:
        branch.train()
        started = time.monotonic()
        clips = self.training.epoch(self.stage * 100_000 + self.epoch, self.schedule.clips_per_video)
        per_epoch = self._per_epoch(clips)
        rate = 0.0  # a run stopped after an epoch's last step has none left to do
        for points, labels in self._batches(clips[: per_epoch * self.schedule.batch]):
            rate = self.schedule.rate(self.stage, self.epoch * per_epoch + self.step, epochs * per_epoch)
            self._optimise(points.to(self.device), labels.to(self.device), rate)
            self.step += 1
            bar.note(
                epoch=f"{self.epoch + 1}/{epochs}",
                loss=self.sums[0] / self.sums[2],
                accuracy=self.sums[1] / self.sums[2],
            )
            bar.advance(len(points))
            if self.stop.requested:
                self.spent += time.monotonic() - started
                self._save()
                self.stop.check(f"{STREAMS[self.stage]} stage saved at epoch {self.epoch + 1}, step {self.step}")
        self._end_epoch(rate, started)

    def _per_epoch(self, clips: list[Clip]) -> int:
        """Whole batches in an epoch; the few clips left over come in another epoch's order."""
        return max(len(clips) // self.schedule.batch, 1)

    def _batches(self, clips: list[Clip]) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """The epoch's batches from `self.step` on; each clip's position in the epoch, not the process, seeds it."""
        data = _Loader(self.training, clips, self.stage * 100_000 + self.epoch)
        rest = torch.utils.data.Subset(data, range(self.step * self.schedule.batch, len(clips)))
        workers = (
            {"num_workers": self.schedule.workers, "multiprocessing_context": "forkserver"}
            if self.schedule.workers
            else {}
        )
        yield from torch.utils.data.DataLoader(rest, self.schedule.batch, **workers)

    def _optimise(self, points: torch.Tensor, labels: torch.Tensor, rate: float) -> None:
        assert self.optimizer is not None
        for group in self.optimizer.param_groups:
            group["lr"] = rate * group["share"]
        logits = self.model.static_logits(points) if self.stage == 0 else self.model.dynamic_logits(points)
        loss = nn.functional.cross_entropy(logits, labels, label_smoothing=self.schedule.label_smoothing)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self._branch().parameters(), 5.0)
        if torch.isfinite(
            norm
        ):  # a nearly singular fit can overflow: such a step is left out rather than poisoning the weights
            self.optimizer.step()
        self.sums[0] += float(loss.detach()) * len(labels)
        self.sums[1] += int((logits.argmax(-1) == labels).sum())
        self.sums[2] += len(labels)

    def _end_epoch(self, rate: float, started: float) -> None:
        accuracy = None
        last = self.epoch + 1 == self.schedule.epochs[self.stage]
        if self.validation is not None and (last or (self.epoch + 1) % self.schedule.validate_every == 0):
            accuracy = self.validate()[STREAMS[self.stage]]
        seconds = self.spent + time.monotonic() - started
        row = {"stage": STREAMS[self.stage], "epoch": self.epoch + 1, "loss": self.sums[0] / self.sums[2], "learning_rate": rate,
               "train_accuracy": self.sums[1] / self.sums[2], "validation_accuracy": accuracy, "seconds": round(seconds, 2)}  # fmt: skip
        log.detail(f"{row}")
        self.folder.log(row)
        self.epoch, self.step, self.sums, self.spent = self.epoch + 1, 0, [0.0, 0, 0], 0.0
        if accuracy is not None and accuracy >= self.best[self.stage]:
            self.best[self.stage] = accuracy
            self._save_model("best.safetensors")
        self._save_model("last.safetensors")
        self._save()
        self.folder.draw_curves()

    def _keep_best_weights(self) -> None:
        """Go on from the epoch that validated best; without validation, from the last."""
        if self.best[self.stage] < 0:
            return
        from dpcli.classify.model_file import load_model

        best, _ = load_model(str(self.folder.file("best.safetensors")))
        branch = "static" if self.stage == 0 else "dynamic"
        getattr(self.model, branch).load_state_dict(getattr(best, branch).state_dict())

    @torch.inference_mode()
    def validate(self) -> dict[str, float]:
        """Share of validation videos classified rightly (scores averaged over clips), by stream; fused in the second stage."""
        assert self.validation is not None
        self.model.eval()
        totals: dict[str, dict[int, torch.Tensor]] = {}
        for clips, points in batches(
            self.validation, self.validation.clips(self.schedule.validation_clips), self.schedule.batch
        ):
            for key, scores in self._scores(points.to(self.device)).items():
                sums = totals.setdefault(key, {})
                for clip, row in zip(clips, scores.cpu()):
                    sums[clip.sequence] = sums.get(clip.sequence, 0) + row
        labels = self.validation.reader.labels
        return {
            key: sum(int(row.argmax()) == int(labels[s]) for s, row in sums.items()) / len(sums)
            for key, sums in totals.items()
        }

    def _scores(self, points: torch.Tensor) -> dict[str, torch.Tensor]:
        """Class probabilities of a batch by stream."""
        if self.stage == 0:
            return {"static": torch.softmax(self.model.static_logits(points), -1)}
        static, dynamic = self.model(points)
        fused = fuse(static, dynamic, self.model.config.fusion)
        return {"static": torch.softmax(static, -1), "dynamic": torch.softmax(dynamic, -1), "fused": fused}

    def _save_model(self, name: str) -> None:
        save_model(self.folder.file(name), self.model, self.info)

    def _save(self) -> None:
        self.folder.save_state({
            "stage": self.stage, "epoch": self.epoch, "step": self.step, "best": self.best, "sums": self.sums,
            "spent": self.spent, "model": self.model.state_dict(),
            "optimizer": self.optimizer.state_dict() if self.optimizer is not None else None,
        })  # fmt: skip

    def _restore(self, state: dict) -> None:
        for key in ("stage", "epoch", "step", "best", "sums", "spent"):
            setattr(self, key, state[key])
        self.model.load_state_dict(state["model"])
        if self.stage < 2 and state["optimizer"] is not None:
            self.optimizer = self._new_optimizer(self._branch())
            self.optimizer.load_state_dict(state["optimizer"])
        log.info(f"continuing {self.folder.path} at stage {self.stage + 1} of 2, epoch {self.epoch + 1}")
