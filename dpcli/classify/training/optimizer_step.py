"""An optimizer step of a stage: parts of a batch, mixed precision, several processes, a loss that runs away."""

from __future__ import annotations

import contextlib
import math
import warnings

import torch
from torch import Tensor, nn

from dpcli.classify.network.backbones.interface import BACKBONES, Grouping
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network.sync_norm import synchronize_norms
from dpcli.classify.training.neighbor_cache import NeighborCache
from dpcli.classify.training.schedule import Schedule
from dpcli.runtime.distributed import Processes
from dpcli.runtime.mixed_precision import reduced_products, wanted
from dpcli.runtime.run_folder import LossWatch

_RUNAWAY = 10  # times the loss of guessing


class _Logits(nn.Module):
    """Computes the logits of the branch that a stage trains, as one module whose parameters are that branch's alone."""

    def __init__(self, model: Kinet, stage: int) -> None:
        super().__init__()
        self.branch = model.static if stage == 0 else model.dynamic
        self._logits = [model.static_logits if stage == 0 else model.dynamic_logits]  # in a list: not a submodule

    def forward(self, points: Tensor, *groups: list[Grouping]) -> Tensor:
        """Returns the logits (b,C) of points (b,T,P,3), by groups where they are known."""
        return self._logits[0](points, *groups)


def watch_of(classes: int) -> LossWatch:
    """Returns the watch over a classifier's loss, which runs away where it is on average far above that of guessing."""
    guessing = math.log(classes)
    return LossWatch(_RUNAWAY * max(guessing, 1), f"; guessing has {guessing:.3g}")


class StageStep:
    """Takes optimizer steps of one stage (0 static, 1 dynamic); called with a process's clips of a batch."""

    def __init__(
        self,
        model: Kinet,
        stage: int,
        schedule: Schedule,
        device: torch.device,
        processes: Processes,
        neighbors: NeighborCache | None = None,
    ) -> None:
        self.schedule, self.device, self.processes = schedule, device, processes
        self.amp, self.neighbors = wanted(schedule.amp, device), neighbors
        module = _Logits(model, stage)
        if processes.count > 1:
            synchronize_norms(module)
        self.optimizer = _new_optimizer(module.branch, schedule)
        self.parameters = [one for one in module.branch.parameters() if one.requires_grad]
        self.module: nn.Module = module
        if processes.count > 1:
            self.module = _shared(module, model, stage, device)

    def __call__(
        self, points: Tensor, labels: Tensor, rate: float, clips: Tensor | None = None
    ) -> tuple[float, int, bool]:
        """Takes a step on points (b,T,P,3) with labels (b), -1 for none, at a learning rate; returns the sum of losses, how
        many are rightly classified, and whether weights were changed.

        clips i64 (b): numbers by which `neighbors` knows them.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = rate * group["share"]
        self.optimizer.zero_grad(set_to_none=True)
        size = self.schedule.share(self.processes.count)
        batch = (points, labels) if self.neighbors is None or clips is None else (points, labels, clips)
        parts = list(zip(*(values.split(size) for values in batch)))
        total, correct = 0.0, 0
        for number, (some, known, *which) in enumerate(parts):
            with self._without_exchange(number + 1 < len(parts)):
                loss, right = self._backward(some.to(self.device), known.to(self.device), which, len(labels))
            total, correct = total + loss, correct + right
        norm = nn.utils.clip_grad_norm_(self.parameters, 5.0)
        # a nearly singular fit can overflow: such a step is left out rather than poisoning the weights
        stepped = bool(torch.isfinite(norm))
        if stepped:
            self.optimizer.step()
        return total, correct, stepped

    def _backward(self, points: Tensor, labels: Tensor, which: list[Tensor], clips: int) -> tuple[float, int]:
        groups = [self.neighbors(points, *which)] if self.neighbors is not None and which else []
        with reduced_products(self.device, self.amp):
            logits = self.module(points, *groups).float()
        together = self.schedule.clips_per_loss
        logits, labels = logits.unflatten(0, (-1, together)).mean(1), labels[::together]
        loss = _loss(logits, labels, self.schedule.label_smoothing)
        loss = loss * together  # each clip of a video counts what the video does
        (loss / clips).backward()
        return float(loss.detach()), together * int((logits.argmax(-1) == labels).sum())

    def _without_exchange(self, on: bool) -> contextlib.AbstractContextManager:
        """Keeps gradients to the process: they are exchanged once a step, not after its earlier parts."""
        return self.module.no_sync() if on and self.processes.count > 1 else contextlib.nullcontext()


def _loss(logits: Tensor, labels: Tensor, smoothing: float) -> Tensor:
    """Returns the sum of cross entropies of logits (b,C) and labels (b); of no class, -1, is what is like all of them.

    Lee et al., "Training Confidence-calibrated Classifiers for Detecting Out-of-Distribution Samples", ICLR 2018, without a
    generator: equation 1's second term, on clips that are known to show no class.
    """
    none = labels < 0
    loss = nn.functional.cross_entropy(logits, labels, label_smoothing=smoothing, reduction="sum", ignore_index=-1)
    return loss - logits[none].log_softmax(-1).mean(-1).sum() if none.any() else loss


def _shared(module: nn.Module, model: Kinet, stage: int, device: torch.device) -> nn.Module:
    """Returns the module whose gradients are averaged over processes; batch norms are synchronized by themselves."""
    config = model.config  # some switches leave parameters without a gradient
    unused = (stage == 1 and (config.merge == "cross" or not config.normals)) or config.backbone not in BACKBONES
    unused |= config.members > 1  # a few clips may leave one of them without any
    where = [device.index] if device.type == "cuda" else None
    with warnings.catch_warnings():
        # torch 2.13 renames broadcast_buffers, earlier ones know no other
        warnings.simplefilter("ignore", FutureWarning)
        return nn.parallel.DistributedDataParallel(
            module, device_ids=where, broadcast_buffers=False, find_unused_parameters=unused
        )


def _new_optimizer(branch: nn.Module, schedule: Schedule) -> torch.optim.Optimizer:
    # The last layer sums a thousand pooled maxima, all positive: at the others' rate its first steps overshoot. Where only a
    # head learns, these maxima are sound from the start, and steps are few.
    slower = 0.1 if schedule.fine_tune == "all" else 1.0
    named = {name: one for name, one in branch.named_parameters() if one.requires_grad}
    last = [p for name, p in named.items() if name.startswith("head.classify")]
    rest = [p for name, p in named.items() if not name.startswith("head.classify")]
    groups = [
        {"params": last, "weight_decay": schedule.weight_decay, "share": slower},
        {"params": [p for p in rest if p.dim() > 1], "weight_decay": schedule.weight_decay, "share": 1.0},
        {"params": [p for p in rest if p.dim() <= 1], "weight_decay": 0.0, "share": 1.0},
    ]
    return torch.optim.AdamW([group for group in groups if group["params"]], lr=schedule.learning_rate)
