"""The speed of a Kinet: latency of a clip, and where training steps and inference spend their time."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from functools import partial
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import nn

from dpcli.classify.network.backbones.interface import Grouping
from dpcli.classify.network.kinet import Kinet, fuse
from dpcli.runtime.tuning import keep_freed_memory, torch_threads

_STEPS = 4  # of each kind that are timed
_STARTS = 5  # the argument of the backward kernels that says where each row's pooled entries are


def body_like_clip(frames: int, points: int, batch: int = 1) -> torch.Tensor:
    """Returns a made-up clip (batch,T,P,3) of the size of a person in MSR-Action3D's units: an upright ellipsoid that sways."""
    generator = torch.Generator().manual_seed(0)
    shape = torch.randn(batch, frames, points, 3, generator=generator)
    shape = torch.nn.functional.normalize(shape, dim=-1) * torch.tensor([0.2, 0.55, 0.15])
    return shape + 0.1 * torch.sin(torch.arange(frames) / 3)[None, :, None, None]


def latency(model: Kinet, points: torch.Tensor, device: torch.device, repeats: int = 5) -> dict[str, float]:
    """Returns the milliseconds of one clip (B=1): neighbor search, both streams, all; medians."""
    rows = []
    with torch.inference_mode():
        for _ in range(repeats + 1):
            marks = [_now(device)]
            groups = model.group(points)
            marks.append(_now(device))
            stages, static = model.static.taps(groups)
            marks.append(_now(device))
            fuse(static, model.dynamic(stages), model.config.fusion)
            marks.append(_now(device))
            rows.append([1000 * (b - a) for a, b in zip(marks, marks[1:])] + [1000 * (marks[-1] - marks[0])])
    medians = torch.tensor(rows[1:]).median(0).values.tolist()
    return dict(zip(("neighbors", "static", "dynamic", "total"), (round(value, 2) for value in medians)))


def _now(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def steps(model: Kinet, device: torch.device, batch: int = 8) -> dict[str, dict[str, Any]]:
    """Returns where a training step of each stream (grouping, forward, loss, backward) and inference of both spend their time.

    On a CPU the parts are those of one thread: threads share the layers' work in whole pieces, products and all. `seconds`
    is the step with every thread. Matrix products are the calls of BLAS as torch's profiler sees them in that same step;
    sparse products, which lie inside other kernels of the static stream: see `_sparse_products`. The fastest of _STEPS
    steps, because other programs only ever add time, and to the parts unequally.
    """
    keep_freed_memory()
    config = model.config
    points = body_like_clip(config.num_frames, config.points_per_frame, batch).to(device)
    labels = torch.arange(batch, device=device) % config.num_classes

    def train(branch: nn.Module, logits: Callable[[list[Grouping]], torch.Tensor]) -> tuple[float, float]:
        """Takes the gradients of one step; returns the seconds of its grouping and of all."""
        began = _now(device)
        groups = model.group(points)
        grouped = _now(device)
        loss = nn.functional.cross_entropy(logits(groups), labels)
        branch.zero_grad(set_to_none=True)
        loss.backward()
        return grouped - began, _now(device) - began

    def infer() -> tuple[float, float]:
        """Predicts once; returns the seconds of the grouping and of all."""
        began = _now(device)
        with torch.inference_mode():
            groups = model.group(points)
            grouped = _now(device)
            stages, static = model.static.taps(groups)
            fuse(static, model.dynamic(stages), config.fusion)
        return grouped - began, _now(device) - began

    model.static.train().requires_grad_(True)
    found = {"static_step": _measured(partial(train, model.static, model.static), batch, sparse=True)}
    model.freeze_static()
    model.dynamic.train()
    dynamic = partial(train, model.dynamic, lambda groups: model.dynamic(model.static.taps(groups)[0]))
    found["dynamic_step"] = _measured(dynamic, batch)
    model.eval()
    return {**found, "inference": _measured(infer, batch)}


def _measured(step: Callable[[], tuple[float, float]], batch: int, sparse: bool = False) -> dict[str, Any]:
    """Returns one of `steps`, from a function that does it and returns the seconds of its grouping and of all."""
    threads = torch.get_num_threads()
    seconds = min(step()[1] for _ in range(_STEPS))
    with torch_threads(1):
        (grouping, alone), inside = min((_profiled(step) for _ in range(_STEPS)), key=lambda found: found[0][1])
        thin = min(_sparse_products(step) for _ in range(_STEPS)) if sparse else 0.0
    parts = {"matrix_products": inside, "sparse_products": thin, "neighbors": grouping}
    parts["other"] = alone - sum(parts.values())
    return {
        "batch": batch,
        "threads": threads,
        "seconds": round(seconds, 4),
        "seconds_on_one_thread": round(alone, 4),
        "matrix_products_share": round(inside / alone, 3),
        "sparse_products_share": round(thin / alone, 3),
        "ms_per_clip": {name: round(1000 * value / batch, 2) for name, value in parts.items()},
    }


def _profiled(step: Callable[[], tuple[float, float]]) -> tuple[tuple[float, float], float]:
    """Returns what a step returns, and the seconds that it spends in matrix products."""
    os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # hides its messages about start and stop
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CPU]) as trace:
        found = step()
    products = ("aten::addmm", "aten::mm", "aten::bmm", "aten::addmm_")
    return found, sum(event.self_cpu_time_total for event in trace.key_averages() if event.key in products) / 1e6


def _sparse_products(step: Callable[[], Any]) -> float:
    """Returns the seconds of a step in products with a sparse matrix: the gradient of max pooling, one entry a centroid and channel,
    times the second layer's weights, and times its inputs. Plain torch multiplies with the same matrix, zeros and all.

    They are a part of the CPU's backward kernels, which run twice here, first without those entries: the difference is
    counted. The kernels that run second find their data nearer, so it is rather too small; the step's gradients are wrong.
    """
    from dpcli.ops import grouped_mlp

    seconds, load = 0.0, grouped_mlp.parallel_kernels

    def twice(kernel: Callable, *arrays: Any) -> None:
        """Runs a kernel without the pooled entries and with them, and adds the difference in seconds."""
        nonlocal seconds
        without = list(arrays)
        without[_STARTS] = np.zeros_like(arrays[_STARTS])
        began = time.perf_counter()
        kernel(*without)
        between = time.perf_counter()
        kernel(*arrays)
        seconds += (time.perf_counter() - between) - (between - began)

    def loaded(name: str) -> ModuleType | SimpleNamespace:
        """Returns the kernels, with those of the backward pass run twice."""
        kernels = load(name)
        both = {key: partial(twice, getattr(kernels, key)) for key in ("back_xyz", "back_table")}
        return SimpleNamespace(**{**vars(kernels), **both})

    grouped_mlp.parallel_kernels = loaded
    try:
        step()
    finally:
        grouped_mlp.parallel_kernels = load
    return max(seconds, 0.0)
