"""The training of a flow network without labels.

A run can be stopped at any step and continued to the same result: a step's randomness comes from (seed, step), and the
state holds weights, optimizer and the step.
"""

from __future__ import annotations

import time

import numpy as np
import torch

from dpcli.runtime.progress import Progress, log
from dpcli.runtime.run_folder import LossWatch, RunFolder, diverged, state_of, take_state
from dpcli.runtime.seeds import SegmentStream, generator
from dpcli.runtime.signals import StopRequest
from dpcli.segment.flow.config import FlowConfig, FlowSchedule
from dpcli.segment.flow.flowstep3d import FlowStep3D
from dpcli.segment.flow.losses import flow_loss
from dpcli.segment.flow.model_file import save_flow_model
from dpcli.segment.frame_pairs import PairSource
from dpcli.segment.sequence_splits import hold_out_sequences
from dpcli.segment.thinning import spread_places
from dpcli.store import CloudsReader

_JUDGED = 64  # held-out pairs
_SAVED = ("step", "best", "sums", "spent", "model", "optimizer")  # of a trainer
COLUMNS = ("step", "loss", "chamfer", "validation_loss", "validation_epe", "learning_rate", "seconds")


class FlowTrainer:
    """Trains a flow network on the adjacent pairs, both ways, of the sequences that `hold_out_sequences` gives to learn from.

    Adam at 1e-3, halved every 400,000 pairs, not below 1e-5. Pairs are scaled to diameter 1 and changed as `augment_pair`
    says. Every `log_every` steps (None: 40 times in all) the log gets a row; split `validation` chooses the network that
    `best.safetensors` keeps by the same loss, and shows the true end point error where the file has poses. Raises
    DataError without pairs.
    """

    def __init__(
        self,
        reader: CloudsReader,
        folder: RunFolder,
        network: FlowConfig,
        schedule: FlowSchedule,
        *,
        seed: int,
        device: torch.device,
        stop: StopRequest,
        log_every: int | None = None,
    ) -> None:
        self.folder, self.seed, self.device, self.stop = folder, seed, device, stop
        self.steps, self.batch = schedule.steps, schedule.batch
        self.log_every = log_every or max(1, self.steps // 40)
        learned, held = hold_out_sequences(reader, "auto", seed)
        self.source = PairSource(reader, learned, schedule.points, seed)
        self.held = PairSource(reader, held, schedule.points, seed) if held else None
        torch.manual_seed(int(generator(seed, SegmentStream.FLOW_TRAINING, 0).integers(2**31)))
        self.model = FlowStep3D(network).to(device)
        self.optimizer = torch.optim.Adam(self.model.parameters(), lr=1e-3)
        self.step, self.best, self.sums, self.spent = 0, float("inf"), [0.0, 0.0, 0], 0.0
        self.watch = LossWatch()

    def run(self) -> FlowStep3D:
        """Trains from wherever the folder's state says to the last step; returns the network.

        Raises Stopped when a stop was asked for, after saving.
        """
        self.folder.resume(self._restore)
        self.model.train()
        with Progress("flow", self.steps, "step") as bar:
            bar.skip(self.step)
            started = time.monotonic()
            while self.step < self.steps:
                self._one_step()
                bar.note(loss=self.sums[0] / self.sums[2], chamfer=self.sums[1] / self.sums[2])
                bar.advance(1)
                if self.step % self.log_every == 0 or self.step == self.steps:
                    self._end_interval(started)
                    started = time.monotonic()
                if self.stop.requested:
                    self.spent += time.monotonic() - started
                    self._save()
                    self.stop.check(f"flow network saved at step {self.step}")
        self.folder.draw_curves()
        return self.model.eval()

    def _learning_rate(self) -> float:
        """Returns the learning rate of the step."""
        return max(1e-3 * 0.5 ** (self.step * self.batch // 400_000), 1e-5)

    def _one_step(self) -> None:
        """Learns from one batch of pairs, drawn and changed at random."""
        for group in self.optimizer.param_groups:
            group["lr"] = self._learning_rate()
        rng = generator(self.seed, SegmentStream.FLOW_TRAINING, 1, self.step)
        pairs = []
        for number in rng.integers(len(self.source.pairs), size=self.batch):
            points = self.source.load(self.source.pairs[number]).points
            pairs.append(augment_pair(points[::-1] if rng.random() < 0.5 else points, rng))
        clouds = torch.from_numpy(np.stack(pairs)).to(self.device)
        loss, distance = flow_loss(clouds[:, 0], clouds[:, 1], self.model(clouds[:, 0], clouds[:, 1]))
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        finite = bool(torch.isfinite(torch.nn.utils.clip_grad_norm_(self.model.parameters(), 5.0)))
        if finite:
            self.optimizer.step()
        if problem := self.watch.see(float(loss.detach()), finite):
            raise diverged(problem, f"step {self.step + 1}", " with other settings")
        self.sums = [self.sums[0] + float(loss.detach()), self.sums[1] + float(distance), self.sums[2] + 1]
        self.step += 1

    def _end_interval(self, started: float) -> None:
        """Validates, writes a row of the log, and saves."""
        loss, chamfer_sum, count = self.sums
        value, error = self._validate()
        seconds = self.spent + time.monotonic() - started
        row = {
            "step": self.step,
            "loss": loss / count,
            "chamfer": chamfer_sum / count,
            "validation_loss": value,
            "validation_epe": error,
            "learning_rate": self._learning_rate(),
            "seconds": round(seconds, 2),
        }
        log.detail(f"{row}")
        self.folder.log(row)
        self.sums, self.spent = [0.0, 0.0, 0], 0.0
        notes = {"step": self.step, "seed": self.seed}
        if value is None or value <= self.best:
            self.best = self.best if value is None else value
            save_flow_model(self.folder.file("best.safetensors"), self.model, notes)
        save_flow_model(self.folder.file("last.safetensors"), self.model, notes)
        self._save()

    @torch.inference_mode()
    def _validate(self) -> tuple[float | None, float | None]:
        """Returns loss and mean end point error (diameters) of at most 64 held-out pairs, forth only; None where unknown."""
        if self.held is None:
            return None, None
        self.model.eval()
        losses, errors = [], []
        for number in spread_places(len(self.held.pairs), _JUDGED):
            pair = self.held.load(self.held.pairs[number])
            first, second = torch.from_numpy(pair.points).to(self.device).unbind()
            flows = self.model(first[None], second[None])
            losses.append(float(flow_loss(first[None], second[None], flows)[0]))
            if pair.flow is not None and pair.known[0].any():
                gap = flows[-1][0].cpu() - torch.from_numpy(pair.flow[0])
                errors.append(float(gap.norm(dim=-1)[torch.from_numpy(pair.known[0])].mean()))
        self.model.train()
        return float(np.mean(losses)), float(np.mean(errors)) if errors else None

    def _save(self) -> None:
        self.folder.save_state(state_of(self, _SAVED))

    def _restore(self, state: dict) -> None:
        take_state(self, _SAVED, state)
        self.folder.tell_continuing(f"step {self.step + 1} of {self.steps}" if self.step < self.steps else None)


def augment_pair(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Returns a training pair f32 (2,N,3) changed at random, as FlowStep3D is trained on SAPIEN.

    Both frames are scaled by 0.95 to 1.05 per axis, turned by at most 10 degrees about y and shifted by at most 0.05; the
    second is shifted by at most 0.01 more.
    """
    angle = rng.uniform(-np.pi / 18, np.pi / 18)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    changed = (points * rng.uniform(0.95, 1.05, 3)) @ turn.T + rng.uniform(-0.05, 0.05, 3)
    changed[1] += rng.uniform(-0.01, 0.01, 3)
    return changed.astype(np.float32)
