"""The training of a part network on pairs of frames, without labels or with them.

A run can be stopped or killed at any step and continued to the same result: what a step does depends on (seed, epoch,
step) and on the saved state alone, and the flows it corrects are saved with that state.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from itertools import chain, cycle, islice
from pathlib import Path

import numpy as np
import torch

from dpcli.errors import DpcError
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.run_folder import LossWatch, RunFolder, diverged, state_of, take_state
from dpcli.runtime.seeds import SegmentStream, torch_seed
from dpcli.runtime.signals import StopRequest
from dpcli.segment.flow.rigid_groups import rigid_groups
from dpcli.segment.frame_pairs import LoadedPair, Pair, PairSource, epoch_order
from dpcli.segment.network.model_file import save_model
from dpcli.segment.network.part_network import PartNetwork
from dpcli.segment.training.flow_store import FlowStore
from dpcli.segment.training.losses import supervised_loss
from dpcli.segment.training.pair_loss import Batch, pair_loss, turn_randomly
from dpcli.segment.training.settings import TrainSettings

_SAVE_EVERY = 100  # steps between checkpoints: their flows are what memory holds
_SAVED = ("epoch", "step", "best", "sums", "spent", "model", "optimizer")  # of a trainer, beside the flows
Estimate = Callable[[torch.Tensor, torch.Tensor], tuple[torch.Tensor, torch.Tensor]]


class Trainer:
    """Trains one network on the device it is on.

    estimate: gives the first flow, forth and back, of two frames (N,3), of which supervised training has no need. notes:
    what the weights file says of the training.
    """

    def __init__(
        self,
        model: PartNetwork,
        folder: RunFolder,
        settings: TrainSettings,
        training: PairSource,
        validation: PairSource | None,
        estimate: Estimate,
        notes: dict,
        stop: StopRequest,
        seed: int,
    ) -> None:
        self.model, self.folder, self.settings = model, folder, settings
        self.schedule, self.objective = settings.schedule, settings.objective
        self.training, self.validation, self.estimate = training, validation, estimate
        self.notes, self.stop, self.seed, self.device = notes, stop, seed, next(model.parameters()).device
        self.epoch, self.step, self.best = 0, 0, math.inf
        self.sums: dict[str, list[float]] = {}
        self.spent, self.watch = 0.0, LossWatch()
        self.optimizer = torch.optim.AdamW(
            model.parameters(), lr=self.schedule.learning_rate, weight_decay=self.schedule.weight_decay
        )
        self.checking: list[Batch] | None = None

    def run(self) -> None:
        """Trains from wherever the folder's state says to the last epoch."""
        state = self.folder.resume(self._restore)
        finished = self.epoch >= self.schedule.epochs  # by an earlier run
        if not finished or self.folder.file("flows.npy").exists():  # which nothing needs after the end, and is large
            self._open_flows(state)
        total = self.schedule.epochs * self._steps() * self.schedule.batch
        with Progress("train parts", total, "pair") as bar:
            bar.skip((self.epoch * self._steps() + self.step) * self.schedule.batch)
            while self.epoch < self.schedule.epochs:
                self._run_epoch(bar)
        if self.validation is None and not (finished and self.folder.file("best.safetensors").exists()):
            save_model(self.folder.file("best.safetensors"), self.model, self.notes)

    def _open_flows(self, state: dict | None) -> None:
        """Opens the run's flows, and writes what a run that was killed may not have written of them."""
        shape, first = (len(self.training.pairs), self.training.points), self.settings.run.flows_of
        self.flows = FlowStore(self.folder.path, *shape, state is None, Path(first) if first else None)
        if state is not None:
            with self.folder.restoring():
                self.flows.restore(state["flows"])

    def _steps(self) -> int:
        """Returns the steps of an epoch: whole batches; the few pairs left over come in another epoch's order."""
        count = len(self.training.pairs)
        return max(min(self.schedule.pairs_per_epoch or count, count) // self.schedule.batch, 1)

    def _run_epoch(self, bar: Progress) -> None:
        """Learns from the pairs that are left of the epoch, and saves now and then."""
        self.model.train()
        started = time.monotonic()
        steps, rate = self._steps(), 0.0
        chosen = self._epoch_pairs()
        while self.step < steps:
            pairs = list(islice(chosen, self.schedule.batch))
            rate = self._step(pairs, self.epoch * steps + self.step, steps * self.schedule.epochs)
            self.step += 1
            shown = {key: self._mean(key) for key in ("loss", "flow_error") if key in self.sums}
            bar.note(epoch=f"{self.epoch + 1}/{self.schedule.epochs}", **shown)
            bar.advance(len(pairs))
            if self.step % _SAVE_EVERY == 0 or self.stop.requested:
                self.spent += time.monotonic() - started
                started = time.monotonic()
                self._save()
            self.stop.check(f"saved at epoch {self.epoch + 1}, step {self.step}")
        self._end_epoch(rate, started)

    def _epoch_pairs(self) -> Iterator[Pair]:
        """Yields the epoch's pairs from `self.step` on; while the cold start lasts, only those whose flow shows bodies.

        The others, half of them or more in slow scenes, show one body, from which the cold start learns nothing.
        """
        cold = self.objective.cold_start > 0 and not self.objective.supervised
        cold = cold and self.epoch < self.objective.cold_until * self.schedule.epochs
        skip = self.step * self.schedule.batch
        order = epoch_order(self.training, self.epoch, None)
        picked = (pair for pair in order if not cold or self._shows_bodies(pair))
        for count, pair in enumerate(chain(picked, cycle(order))):  # too few of these pairs: any, once more
            if count >= skip:
                yield pair

    def _shows_bodies(self, pair: Pair) -> bool:
        """Returns whether the pair's first flow shows more than one body; it is estimated now if the pair is new."""
        if self.flows.shows_bodies(pair.number) is None:
            self._find_flow(pair, torch.from_numpy(self.training.load(pair).points))
        return bool(self.flows.shows_bodies(pair.number))

    def _step(self, pairs: list[Pair], step: int, steps: int) -> float:
        """Learns from one batch of pairs and keeps their corrected flows; returns the learning rate."""
        loaded = [self.training.load(pair) for pair in pairs]
        batch = self._load_batch(pairs, loaded)
        rotation, rng = None, torch.Generator().manual_seed(torch_seed(self.seed, SegmentStream.TURN, step))
        if self.schedule.augment:
            batch.points, rotation = turn_randomly(batch.points, rng)
            batch.flow = batch.flow @ rotation.mT
        rate = self.schedule.learning_rate_at(step, steps)
        try:
            outcome = pair_loss(self.model, batch, self.objective, step / max(steps, 1), rng)
        except torch.linalg.LinAlgError:  # of motions of masks that are no numbers
            raise self._diverged("the masks are no longer finite", rate) from None
        stepped = self._optimize(outcome.loss, rate)
        if problem := self.watch.see(float(outcome.loss.detach()), stepped):
            raise self._diverged(problem, rate)
        if outcome.flow is not None:
            self._keep_flow(pairs, outcome.flow if rotation is None else outcome.flow @ rotation)
        self._count({"loss": float(outcome.loss.detach()), **outcome.terms})
        return rate

    def _diverged(self, problem: str, rate: float) -> DpcError:
        where = f"epoch {self.epoch + 1}, step {self.step + 1}, learning rate {rate:.3g}"
        return diverged(problem, where, " with a smaller lr")

    def _optimize(self, loss: torch.Tensor, rate: float) -> bool:
        """Takes a step along the gradient, whose norm is clipped at 5, and returns True; False where it is not finite."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), 5.0)
        finite = bool(torch.isfinite(norm))
        if finite:
            self.optimizer.step()
        return finite

    def _load_batch(self, pairs: list[Pair], loaded: list[LoadedPair]) -> Batch:
        """Returns points, labels and the flows as they stand, estimated now where a pair is new."""
        batch, flow = self._assemble(loaded, lambda i, frames: self._find_flow(pairs[i], frames))
        self._measure_flow_error(flow, loaded)
        return batch

    def _assemble(
        self, loaded: list[LoadedPair], estimate: Callable[[int, torch.Tensor], torch.Tensor]
    ) -> tuple[Batch, torch.Tensor]:
        """Returns a batch on the device, and its flow (B,2,N,3): the true one when supervised, else estimate(i, frames)."""
        points = torch.from_numpy(np.stack([pair.points for pair in loaded]))  # [B, 2, N, 3]
        if self.objective.supervised:
            flow = torch.from_numpy(np.stack([pair.flow for pair in loaded]))
        else:
            flow = torch.stack([estimate(i, frames) for i, frames in enumerate(points)])
        part = torch.from_numpy(np.stack([pair.part for pair in loaded]))
        return Batch(*(v.transpose(0, 1).flatten(0, 1).to(self.device) for v in (points, flow, part))), flow

    def _find_flow(self, pair: Pair, frames: torch.Tensor) -> torch.Tensor:
        """Returns the flow (2,N,3) that is kept for a pair; a new pair's is estimated."""
        known = self.flows.get(pair.number)
        if known is None:
            known = torch.stack(self.estimate(*frames))
            self.flows.put_first(pair.number, known, bool((rigid_groups(frames, known) > 0).any()))
        return known

    def _keep_flow(self, pairs: list[Pair], flow: torch.Tensor) -> None:
        """Keeps the corrected flows (2B,N,3) of the pairs."""
        for pair, both in zip(pairs, flow.cpu().unflatten(0, (2, -1)).transpose(0, 1)):
            self.flows.put(pair.number, both)

    def _measure_flow_error(self, flow: torch.Tensor, loaded: list[LoadedPair]) -> None:
        """Notes for the log how far the flow in use is from the true one, at the points where the data know that."""
        known = torch.from_numpy(np.stack([pair.known for pair in loaded]))
        if all(pair.flow is not None for pair in loaded) and known.any():
            truth = torch.from_numpy(np.stack([pair.flow for pair in loaded]))
            self._count({"flow_error": float((flow - truth).norm(dim=-1)[known].mean())})

    def _count(self, values: dict[str, float]) -> None:
        """Adds values to the epoch's means."""
        for key, value in values.items():
            entry = self.sums.setdefault(key, [0.0, 0.0])
            entry[0], entry[1] = entry[0] + value, entry[1] + 1

    def _mean(self, key: str) -> float | None:
        """Returns the epoch's mean of a value so far, None where there is none."""
        total, count = self.sums.get(key, (0.0, 0.0))
        return total / count if count else None

    def _end_epoch(self, rate: float, started: float) -> None:
        """Validates, writes a row of the log and the weights, and saves."""
        row = {key: self._mean(key) for key in self.sums}
        if self.validation is not None:
            row |= self.validate()
        self.epoch, self.step = self.epoch + 1, 0
        seconds = self.spent + time.monotonic() - started
        pairs = self._steps() * self.schedule.batch
        row |= {"epoch": self.epoch, "pairs": pairs, "learning_rate": rate, "seconds": round(seconds, 2)}
        log.detail(" ".join(f"{key} {value:.4g}" for key, value in row.items() if value is not None))
        self.folder.log(row)
        self.sums, self.spent = {}, 0.0
        if self.validation is not None and row["validation_loss"] <= self.best:
            self.best = row["validation_loss"]
            save_model(self.folder.file("best.safetensors"), self.model, self.notes)
        save_model(self.folder.file("last.safetensors"), self.model, self.notes)
        self._save()
        self.folder.draw_curves()

    @torch.no_grad()
    def validate(self) -> dict[str, float | None]:
        """Returns the loss on held-out pairs, which chooses the best weights, and the mean Rand index, None without labels.

        The loss compares masks with the bodies that the pairs' first flow shows, or with the labels when supervised. The
        Rand index, of the points whose part is known, is for people to watch: nothing is chosen by it.
        """
        self.model.eval()
        if self.checking is None:
            self.checking = self._validation_batches()
        losses, scores = [], []
        for batch in self.checking:
            mask = self.model(batch.points).mask
            bodies = (
                batch.part if self.objective.supervised else rigid_groups(batch.points, batch.flow, most=mask.shape[-1])
            )
            several = bodies.amax(1) > 0
            if several.any():
                losses += [float(supervised_loss(mask[several], bodies[several]))] * int(several.sum())
            for labels, part in zip(mask.argmax(-1), batch.part):
                if (known := part >= 0).any():
                    scores.append(rand_index(labels[known], part[known]))
        loss = float(np.mean(losses)) if losses else 0.0
        return {"validation_loss": loss, "validation_rand_index": float(np.mean(scores)) if scores else None}

    def _validation_batches(self) -> list[Batch]:
        """Returns the held-out pairs with their first flows, which are estimated once."""
        pairs = epoch_order(self.validation, 0, self.schedule.validation_pairs)
        batches = []
        for start in range(0, len(pairs), self.schedule.batch):
            loaded = [self.validation.load(pair) for pair in pairs[start : start + self.schedule.batch]]
            batches.append(self._assemble(loaded, lambda _, frames: torch.stack(self.estimate(*frames)))[0])
        return batches

    def _save(self) -> None:
        self.folder.save_state({**state_of(self, _SAVED), "flows": self.flows.pending()})
        self.flows.flush()

    def _restore(self, state: dict) -> None:
        take_state(self, _SAVED, state)
        where = f"epoch {self.epoch + 1} of {self.schedule.epochs}, step {self.step}"
        self.folder.tell_continuing(where if self.epoch < self.schedule.epochs else None)


def rand_index(labels: torch.Tensor, truth: torch.Tensor) -> float:
    """Returns the share of ordered point pairs (itself included) on which two labelings (N) agree about same or different.

    >>> rand_index(torch.tensor([0, 0, 1, 1]), torch.tensor([0, 1, 1, 1]))
    0.625
    """
    same = labels[:, None] == labels
    return float((same == (truth[:, None] == truth)).float().mean())
