"""Training the flow network without labels: Chamfer distance of the warped frame, and smoothness of the flow.

A run can be stopped at any step and continued to the same result: a step's randomness comes from (seed, step), and the
state holds weights, optimizer and the step.
"""

from __future__ import annotations

import time

import numpy as np
import torch
from torch import Tensor

from dpcli.ops import gather_points, knn
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.seeds import SegmentStream, generator
from dpcli.runtime.signals import StopRequest
from dpcli.segment.flow.config import find_flow_config
from dpcli.segment.flow.flow_network import FlowNetwork
from dpcli.segment.flow.model_file import augmented, save_flow_model
from dpcli.segment.frame_pairs import PairSource
from dpcli.segment.training.losses import smoothness_loss, smoothness_neighbors
from dpcli.store import CloudsReader

COLUMNS = ("step", "loss", "chamfer", "validation_loss", "validation_epe", "learning_rate", "seconds")
_FIRST, _LATER = 0.5, 0.3  # weights of the iterations' losses


def chamfer(moved: Tensor, points: Tensor) -> Tensor:
    """Mean distance to the nearest point of the other cloud, both ways, summed: (B,N,3), (B,M,3) -> scalar.

    Nearest points are found without a gradient; at a distance of zero the gradient is zero.
    """
    total = moved.new_zeros(())
    for query, other in ((moved, points), (points, moved)):
        _, idx = knn(query.detach(), other.detach(), 1)
        square = (gather_points(other, idx[..., 0]) - query).square().sum(-1)
        zero = square == 0
        total = total + torch.where(zero, 0.0, torch.where(zero, 1.0, square).sqrt()).mean()
    return total


def flow_loss(points1: Tensor, points2: Tensor, flows: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Weighted sum over iterations of 0.75 Chamfer + 0.25 smoothness (4 nearest within 0.05, 8 of a ball of 0.1), as
    FlowStep3D on SAPIEN; weights 0.5, then 0.3. And the last iteration's Chamfer distance alone."""
    neighbors = smoothness_neighbors(points1, k=4, radius=0.05, ball_k=8, ball_radius=0.1)
    total, distance = points1.new_zeros(()), points1.new_zeros(())
    for i, flow in enumerate(flows):
        distance = chamfer(points1 + flow, points2)
        total = total + (_LATER if i else _FIRST) * (0.75 * distance + 0.25 * smoothness_loss(flow, neighbors))
    return total, distance.detach()


def train_flow(
    reader: CloudsReader,
    folder: RunFolder,
    *,
    steps: int,
    batch: int,
    seed: int,
    device: torch.device | str,
    stop: StopRequest,
    config: str = "compact",
    points: int = 512,
    log_every: int | None = None,
) -> FlowNetwork:
    """Train on the adjacent pairs, both ways, of split `train` (of all sequences if there is none); the best network.

    Adam at 1e-3, halved every 400,000 pairs, not below 1e-5. Pairs are scaled to diameter 1 and changed as `augmented`
    says. Every `log_every` steps (None: 40 times in all) the log gets a row; split `validation` chooses the best by the
    same loss, and shows the true end point error where the file has poses. Raises DataError without pairs, Stopped when
    a stop was asked for, after saving.
    """
    trainer = _Trainer(reader, folder, steps, batch, seed, torch.device(device), stop, config, points, log_every)
    with folder:  # last: it may delete an earlier model
        return trainer.run()


class _Trainer:
    def __init__(
        self,
        reader: CloudsReader,
        folder: RunFolder,
        steps: int,
        batch: int,
        seed: int,
        device: torch.device,
        stop: StopRequest,
        config: str,
        points: int,
        log_every: int | None,
    ) -> None:
        self.folder, self.steps, self.batch, self.seed, self.device, self.stop = (
            folder,
            steps,
            batch,
            seed,
            device,
            stop,
        )
        self.log_every = log_every or max(1, steps // 40)
        by_split = {name: [i for i, s in enumerate(reader.splits) if s == name] for name in set(reader.splits)}
        long = [i for i in range(len(reader)) if reader.frame_counts[i] > 1]
        train = [i for i in by_split.get("train", range(len(reader))) if i in set(long)]
        held = [i for i in by_split.get("validation", []) if i in set(long)]
        self.source = PairSource(reader, train, points, seed)
        self.held = PairSource(reader, held, points, seed) if held else None
        torch.manual_seed(int(generator(seed, SegmentStream.FLOW_TRAINING, 0).integers(2**31)))
        self.model = FlowNetwork(find_flow_config(config)).to(device)
        self.optimizer = torch.optim.Adam(self.model.parameters(), lr=1e-3)
        self.step, self.best, self.sums, self.spent = 0, float("inf"), [0.0, 0.0, 0], 0.0

    def run(self) -> FlowNetwork:
        state = self.folder.load_state()
        if state is not None:
            self._restore(state)
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

    def _rate(self) -> float:
        return max(1e-3 * 0.5 ** (self.step * self.batch // 400_000), 1e-5)

    def _one_step(self) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = self._rate()
        rng = generator(self.seed, SegmentStream.FLOW_TRAINING, 1, self.step)
        pairs = []
        for number in rng.integers(len(self.source.pairs), size=self.batch):
            points = self.source.load(self.source.pairs[number]).points
            pairs.append(augmented(points[::-1] if rng.random() < 0.5 else points, rng))
        clouds = torch.from_numpy(np.stack(pairs)).to(self.device)
        loss, distance = flow_loss(clouds[:, 0], clouds[:, 1], self.model(clouds[:, 0], clouds[:, 1]))
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if torch.isfinite(torch.nn.utils.clip_grad_norm_(self.model.parameters(), 5.0)):
            self.optimizer.step()
        self.sums = [self.sums[0] + float(loss.detach()), self.sums[1] + float(distance), self.sums[2] + 1]
        self.step += 1

    def _end_interval(self, started: float) -> None:
        loss, chamfer_sum, count = self.sums
        value, error = self._validate()
        seconds = self.spent + time.monotonic() - started
        row = {
            "step": self.step,
            "loss": loss / count,
            "chamfer": chamfer_sum / count,
            "validation_loss": value,
            "validation_epe": error,
            "learning_rate": self._rate(),
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
    def _validate(self, most: int = 64) -> tuple[float | None, float | None]:
        """Loss, and mean end point error in diameters, of at most 64 held-out pairs, forth only; None where unknown."""
        if self.held is None:
            return None, None
        self.model.eval()
        losses, errors = [], []
        spread = np.linspace(0, len(self.held.pairs) - 1, min(most, len(self.held.pairs))).astype(int)
        for number in spread:
            pair = self.held.load(self.held.pairs[number])
            first, second = torch.from_numpy(pair.points).to(self.device).unbind()
            flows = self.model(first[None], second[None])
            losses.append(float(flow_loss(first[None], second[None], flows)[0]))
            if pair.flow is not None:
                gap = flows[-1][0].cpu() - torch.from_numpy(pair.flow[0])
                errors.append(float(gap.norm(dim=-1).mean()))
        self.model.train()
        return float(np.mean(losses)), float(np.mean(errors)) if errors else None

    def _save(self) -> None:
        self.folder.save_state(
            {
                "step": self.step,
                "best": self.best,
                "sums": self.sums,
                "spent": self.spent,
                "model": self.model.state_dict(),
                "optimizer": self.optimizer.state_dict(),
            }
        )

    def _restore(self, state: dict) -> None:
        for key in ("step", "best", "sums", "spent"):
            setattr(self, key, state[key])
        self.model.load_state_dict(state["model"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.folder.tell_continuing(f"step {self.step + 1} of {self.steps}" if self.step < self.steps else None)
