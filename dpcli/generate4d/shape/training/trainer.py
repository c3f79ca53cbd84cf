"""The training of a shape network.

A run can be stopped at any step and continued to the same weights: pictures come from the seed and their round's number,
what a step draws of them from the seed and the step, and the state holds weights, their running mean, and optimizer.
"""

from __future__ import annotations

import math
import time
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dpcli.generate4d.shape.model_file import save_shape_model
from dpcli.generate4d.shape.network import ShapeNetwork, inflated_layers
from dpcli.generate4d.shape.training.confidence import fit_confidence
from dpcli.generate4d.shape.training.losses import depth_error, object_angles, object_length, shape_loss
from dpcli.generate4d.shape.training.rounds import Batch, Kept, MakeModels, Window, open_window
from dpcli.generate4d.shape.training.settings import ShapeSchedule
from dpcli.runtime.mixed_precision import reduced_products
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.run_folder import LossWatch, RunFolder, diverged, state_of, take_state
from dpcli.runtime.seeds import Generate4DStream, generator
from dpcli.runtime.signals import StopRequest

_WARM = 200  # steps until the learning rate is at its largest
_GUESSED = 0.25  # of the pictures are decoded at the network's own angles
_RUNAWAY = 1000  # times the first loss
_MEMORY = 0.999  # of the running mean of the weights
_SAVED = ("step", "best", "sums", "spent", "model", "mean", "optimizer")  # of a trainer


class ShapeTrainer:
    """Trains a network on rounds of pictures; `best.safetensors` has the running mean of least error on held-out models.

    Adam, cosine learning rate. The log gets a row and the state is saved about 60 times in all.
    """

    def __init__(
        self,
        model: ShapeNetwork,
        folder: RunFolder,
        schedule: ShapeSchedule,
        make: MakeModels,
        kept: Kept,
        notes: dict[str, Any],
        *,
        seed: int,
        jobs: int,
        stop: StopRequest,
        device: torch.device,
    ) -> None:
        self.model = model.to(device, memory_format=torch.channels_last)
        self.mean, self.device = deepcopy(self.model).eval(), device
        self.folder, self.schedule, self.make = folder, schedule, make
        self.kept = kept.to(device)
        self.notes, self.seed, self.jobs, self.stop = notes, seed, jobs, stop
        self.log_every = max(1, schedule.steps // 60)
        self.per_round = max(1, schedule.round * schedule.reuse // schedule.batch)
        self.optimizer = torch.optim.AdamW(model.parameters(), lr=schedule.lr, weight_decay=1e-4)
        self.step, self.best, self.sums, self.spent = 0, float("inf"), {"steps": 0.0}, 0.0
        self.watch: LossWatch | None = None

    def run(self) -> Path:
        """Trains from wherever the folder's state says to the last step; returns the file of the best weights.

        Raises Stopped when a stop was asked for, after saving.
        """
        state = self.folder.resume(self._restore)
        sizes = self.schedule
        rounds = math.ceil(sizes.steps / self.per_round)
        if self.step < sizes.steps:
            at = self.step // self.per_round
            with open_window(self.make, sizes.round, sizes.rounds, at, rounds, self.jobs, self.device) as window:
                self._learn(window)
        elif not sizes.steps and state is None:
            self._end_interval(0.0)
        self.folder.draw_curves()
        return self.folder.file("best.safetensors")

    def _learn(self, window: Window) -> None:
        fresh, started = True, time.monotonic()
        with Progress("shape", self.schedule.steps, "step") as bar:
            bar.skip(self.step)
            while self.step < self.schedule.steps:
                if fresh or self.step % self.per_round == 0:
                    window.advance()
                    fresh = False
                self._one_step(window)
                bar.note(loss=self.sums["loss"] / self.sums["steps"])
                bar.advance(1)
                if self.step % self.log_every == 0 or self.step == self.schedule.steps:
                    self._end_interval(time.monotonic() - started)
                    started = time.monotonic()
                if self.stop.requested:
                    self.spent += time.monotonic() - started
                    self._save()
                    self.stop.check(f"shape network saved at step {self.step}")

    def _learning_rate(self) -> float:
        """Returns the learning rate of the step."""
        warm = min(1.0, (self.step + 1) / _WARM)
        return self.schedule.lr * warm * 0.5 * (1 + math.cos(math.pi * self.step / max(self.schedule.steps, 1)))

    def _one_step(self, window: Window) -> None:
        """Learns from one batch and takes it into the running mean."""
        for group in self.optimizer.param_groups:
            group["lr"] = self._learning_rate()
        rng = generator(self.seed, Generate4DStream.SHAPE_STEP, self.step)
        batch = window.draw(self.schedule.batch, rng)
        guessed = torch.from_numpy(rng.random(min(self.schedule.decoded, self.schedule.batch)) < _GUESSED)
        with reduced_products(self.device, self.schedule.amp):
            loss, parts = shape_loss(self.model, batch, guessed.to(self.device))
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        finite = bool(torch.isfinite(torch.nn.utils.clip_grad_norm_(self.model.parameters(), 1.0)))
        if finite:
            self.optimizer.step()
        self._look_at(float(loss.detach()), finite)
        keep = min(_MEMORY, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for mean, now in zip(self.mean.state_dict().values(), self.model.state_dict().values()):
                mean.lerp_(now, 1 - keep) if mean.is_floating_point() else mean.copy_(now)
        for key, value in {"steps": 1.0, "loss": loss.detach(), **parts}.items():
            self.sums[key] = self.sums.get(key, 0.0) + float(value)
        self.step += 1

    def _look_at(self, loss: float, stepped: bool) -> None:
        """Raises DpcError once the loss has run away from where it began."""
        self.watch = self.watch or LossWatch(_RUNAWAY * max(loss, 1.0), f", from {loss:.3g}")
        if problem := self.watch.see(loss, stepped):
            raise diverged(
                problem, f"step {self.step + 1}, learning rate {self._learning_rate():.3g}", " with a smaller lr"
            )

    def _end_interval(self, seconds: float) -> None:
        """Validates, writes a row of the log, and saves."""
        steps = self.sums.pop("steps")
        row = {"step": self.step, **{key: value / steps for key, value in self.sums.items()}}
        measured = validate(self.mean, self.kept.held)
        confidence = fit_confidence(*(overall_features(self.mean, shown) for shown in self.kept[1:]))
        row |= measured | {"learning_rate": self._learning_rate(), "seconds": round(self.spent + seconds, 2)}
        log.detail(f"{row}")
        self.folder.log(row)
        self.sums, self.spent = {"steps": 0.0}, 0.0
        notes = {**self.notes, "step": self.step, "size": self.schedule.size, "confidence": confidence, **measured}
        if measured["validation_loss"] < self.best:
            self.best = measured["validation_loss"]
            save_shape_model(self.folder.file("best.safetensors"), self.mean, notes)
        save_shape_model(self.folder.file("last.safetensors"), self.mean, notes)
        self._save()
        self.folder.draw_curves()

    def _save(self) -> None:
        self.folder.save_state(state_of(self, _SAVED))

    def _restore(self, state: dict) -> None:
        take_state(self, _SAVED, state)
        end = self.schedule.steps
        self.folder.tell_continuing(f"step {self.step + 1} of {end}" if self.step < end else None)


@torch.inference_mode()
def validate(model: ShapeNetwork, held: Batch, batch: int = 64) -> dict[str, float]:
    """Returns measures of a network that names the angles itself.

    validation_loss, validation_inflated: error of its layers and of the inflation's, sides of the picture;
    validation_angle: mean error of the turn about the vertical, degrees; validation_length: of the logarithm of the length.
    """
    model.eval()
    errors, plain, turned, longer = [], [], [], []
    for start in range(0, len(held.pictures), batch):
        part = Batch(*(tensor[start : start + batch] for tensor in held))
        encoded = model.encode(part.pictures)
        angles, length = model.mean_angles(encoded.angles), model.mean_length(encoded.lengths)
        errors.append(depth_error(model.decode(encoded, part.pictures, angles, length)[0], part.depth))
        plain.append(depth_error(inflated_layers(part.pictures[:, 4]), part.depth))
        true = object_angles(part.depth)
        turned.append((angles - true)[:, 0].abs().rad2deg())
        longer.append((length - object_length(part, true)).abs())
    names = ("validation_loss", "validation_inflated", "validation_angle", "validation_length")
    means = [float(torch.cat(parts).mean()) for parts in (errors, plain, turned, longer)]
    return dict(zip(names, means))


@torch.inference_mode()
def overall_features(model: ShapeNetwork, pictures: Tensor, batch: int = 64) -> np.ndarray:
    """Returns the overall features f32 (N,C) of pictures (N,5,S,S)."""
    model.eval()
    return torch.cat([model.encode(part).overall for part in pictures.split(batch)]).cpu().numpy()
