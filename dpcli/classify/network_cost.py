"""The cost of a Kinet: parameters and multiply-adds as they are, the papers' ways of counting beside them, time and memory."""

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

from dpcli.classify.network.backbones.interface import Grouping, Stage
from dpcli.classify.network.kinematic import Kinematics
from dpcli.classify.network.kinet import Kinet, fuse
from dpcli.ops.backend import reference_only
from dpcli.runtime.device import peak_memory
from dpcli.runtime.tuning import torch_threads

_STEPS = 4  # of each kind that are timed
_STARTS = 5  # the argument of the backward kernels that says where each row's pooled entries are


def count_parameters(module: nn.Module) -> int:
    """Returns the count of all trainable numbers, batch norm's included."""
    return sum(p.numel() for p in module.parameters())


def paper_parameters(module: nn.Module) -> float:
    """Returns millions as the thesis's table A.1 counts: weights, both Adam moments and batch norm's moving statistics, over 2^20."""
    moving = sum(b.numel() for name, b in module.named_buffers() if "running" in name)
    return (3 * count_parameters(module) + moving) / 2**20


def _paper_total(model: Kinet) -> float:
    """Returns both streams counted that way: a frozen static stream has no moments, and is counted once."""
    frozen = count_parameters(model.static) + sum(
        b.numel() for name, b in model.static.named_buffers() if "running" in name
    )
    return paper_parameters(model.dynamic) + frozen / 2**20


def macs(model: Kinet, points: torch.Tensor) -> dict[str, int]:
    """Returns multiply-adds of the matrix products of one clip (B=1), by stream, and of the fits (counted by hand).

    Neighbor search, batch norm, activations and the small inverses are not in it; each is named in `uncounted`.
    """
    from torch.utils.flop_counter import FlopCounterMode

    groups = model.group(points)
    with torch.no_grad(), reference_only(), FlopCounterMode(display=False) as counter:
        stages, _ = model.static.taps(groups)
    static = counter.get_total_flops() // 2
    written = getattr(model.static, "macs_as_written", lambda: static)()
    dynamic = _linear_macs(model.dynamic, stages) + _fit_macs(model, stages)
    return {"static": static, "static_as_written": written, "dynamic": dynamic, "total": static + dynamic}


def _linear_macs(dynamic: Kinematics, stages: list[Stage]) -> int:
    """Returns multiply-adds of the dynamic stream's linear layers that are called as such: all but the units' reductions."""
    counts: list[int] = []

    def count(layer: nn.Linear, _: tuple, out: torch.Tensor) -> None:
        counts.append(out.numel() * layer.in_features)

    hooks = [layer.register_forward_hook(count) for layer in dynamic.modules() if isinstance(layer, nn.Linear)]
    try:
        with torch.no_grad():
            dynamic(stages)
    finally:
        for hook in hooks:
            hook.remove()
    return sum(counts)


def _fit_macs(model: Kinet, stages: list[Stage]) -> int:
    """Returns the multiply-adds of every fit, which `_linear_macs` doesn't see: reduction, normal matrix, right side, solution and
    deviations."""
    config, size, total = model.config, model.config.group_size + 1, 0
    shapes = [activation.shape[1:3] for stage in stages for activation in stage.activations]
    for number, (unit, (centroids, neighbors)) in enumerate(zip(model.dynamic.units, shapes), 1):
        unread = config.weighting == "none" or number == len(shapes)  # nobody's weights come from the last deviations
        per_neighbor = size * (size + 1) // 2 + size + (0 if unread else size)
        total += centroids * unit.groups * (neighbors * per_neighbor + size * size)
        total += centroids * neighbors * unit.reduce.weight.numel()
    return total if config.normals else 0


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


def measure(model: Kinet, device: torch.device, with_steps: bool = False) -> dict[str, Any]:
    """Returns everything that `dpc classify profile` prints, as one object."""
    config = model.config
    torch.manual_seed(0)
    points = body_like_clip(config.num_frames, config.points_per_frame).to(device)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    before = peak_memory()
    counts = macs(model, points)
    result = {
        "variant": config.variant,
        "backbone": config.backbone,
        "classes": config.num_classes,
        "clip": [config.num_frames, config.points_per_frame],
        "parameters": {
            "total": count_parameters(model),
            "static": count_parameters(model.static),
            "dynamic": count_parameters(model.dynamic),
            **{f"static_{name}": count_parameters(part) for name, part in model.static.named_children()},
            **{f"dynamic_{k}": count_parameters(getattr(model.dynamic, k)) for k in ("units", "merge", "head")},
        },
        "paper_style_parameters": {
            "total": round(_paper_total(model), 3),
            "static": round(paper_parameters(model.static), 3),
            "rule": "weights + Adam moments + moving statistics, / 2^20 (thesis table A.1); in the"
            " total the static stream is frozen",
        },
        "macs_per_clip": counts,
        "paper_style_gflops": {
            "static": round(2 * counts["static_as_written"] / 2**30, 2),
            "total": round(2 * (counts["static_as_written"] + counts["dynamic"]) / 2**30, 2),
            "rule": "2 x multiply-adds of the layers as written, / 2^30",
        },
        "uncounted": "neighbor search, batch norm, activations, pooling, the small inverses",
        "latency_ms": latency(model, points, device),
        "peak_memory_mb": _peak(device, before),
        "device": str(device),
        "threads": torch.get_num_threads(),
    }
    if with_steps:
        result |= steps(model, device)
    return result


def _peak(device: torch.device, before: int) -> float:
    if device.type == "cuda":
        return round(torch.cuda.max_memory_allocated(device) / 2**20, 1)
    return round(max(peak_memory(), before) / 2**20, 1)


def body_like_clip(frames: int, points: int, batch: int = 1) -> torch.Tensor:
    """Returns a made-up clip (batch,T,P,3) of the size of a person in MSR-Action3D's units: an upright ellipsoid that sways."""
    generator = torch.Generator().manual_seed(0)
    shape = torch.randn(batch, frames, points, 3, generator=generator)
    shape = torch.nn.functional.normalize(shape, dim=-1) * torch.tensor([0.2, 0.55, 0.15])
    return shape + 0.1 * torch.sin(torch.arange(frames) / 3)[None, :, None, None]


def steps(model: Kinet, device: torch.device, batch: int = 8) -> dict[str, dict[str, Any]]:
    """Returns where a training step of each stream (grouping, forward, loss, backward) and inference of both spend their time.

    On a CPU the parts are those of one thread: threads share the layers' work in whole pieces, products and all. `seconds`
    is the step with every thread. Matrix products are the calls of BLAS as torch's profiler sees them in that same step;
    sparse products, which lie inside other kernels of the static stream: see `_sparse_products`. The fastest of _STEPS
    steps, because other programs only ever add time, and to the parts unequally.
    """
    from dpcli.runtime.tuning import keep_freed_memory

    keep_freed_memory()
    config = model.config
    points = body_like_clip(config.num_frames, config.points_per_frame, batch).to(device)
    labels = torch.arange(batch, device=device) % config.num_classes

    def train(branch: nn.Module, logits: Callable[[list[Grouping]], torch.Tensor]) -> tuple[float, float]:
        began = _now(device)
        groups = model.group(points)
        grouped = _now(device)
        loss = nn.functional.cross_entropy(logits(groups), labels)
        branch.zero_grad(set_to_none=True)
        loss.backward()
        return grouped - began, _now(device) - began

    def infer() -> tuple[float, float]:
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
    os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # its start and stop are nobody's news
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
        nonlocal seconds
        without = list(arrays)
        without[_STARTS] = np.zeros_like(arrays[_STARTS])
        began = time.perf_counter()
        kernel(*without)
        between = time.perf_counter()
        kernel(*arrays)
        seconds += (time.perf_counter() - between) - (between - began)

    def loaded(name: str) -> ModuleType | SimpleNamespace:
        kernels = load(name)
        both = {key: partial(twice, getattr(kernels, key)) for key in ("back_xyz", "back_table")}
        return SimpleNamespace(**{**vars(kernels), **both})

    grouped_mlp.parallel_kernels = loaded
    try:
        step()
    finally:
        grouped_mlp.parallel_kernels = load
    return max(seconds, 0.0)


def render(result: dict[str, Any]) -> str:
    """Returns the object of `measure` as lines for a person."""
    lines = [
        f"Kinet on {result['backbone']}, {result['variant']} variant, {result['classes']} classes,"
        f" clip {result['clip'][0]} x {result['clip'][1]} points"
    ]
    parameters = result["parameters"]
    lines.append(
        f"parameters    {parameters['total']:,} (static {parameters['static']:,}, dynamic {parameters['dynamic']:,})"
    )
    paper = result["paper_style_parameters"]
    lines.append(f"  paper style {paper['total']} M, static {paper['static']} M: {paper['rule']}")
    counts = result["macs_per_clip"]
    lines.append(
        f"multiply-adds {counts['total'] / 1e9:.2f} G per clip (static {counts['static'] / 1e9:.2f}, dynamic {counts['dynamic'] / 1e9:.2f})"
    )
    gflops = result["paper_style_gflops"]
    lines.append(f"  paper style {gflops['total']} GFLOPs, static {gflops['static']}: {gflops['rule']}")
    lines.append(f"  not counted: {result['uncounted']}")
    times = ", ".join(f"{key} {value}" for key, value in result["latency_ms"].items())
    lines.append(f"latency       {times} ms on {result['device']} with {result['threads']} threads, one clip at a time")
    lines.append(f"peak memory   {result['peak_memory_mb']} MB of the process")
    for key in ("static_step", "dynamic_step", "inference"):
        lines += _step_lines(key.replace("_", " "), result[key]) if key in result else []
    return "\n".join(lines)


def _step_lines(name: str, step: dict[str, Any]) -> list[str]:
    parts = ", ".join(f"{part.replace('_', ' ')} {value}" for part, value in step["ms_per_clip"].items() if value)
    dense, sparse = (100 * step[f"{kind}_products_share"] for kind in ("matrix", "sparse"))
    return [
        f"{name:<13} {step['batch'] / step['seconds']:.3g} clips/s: {step['seconds']} s for {step['batch']} clips with"
        f" {step['threads']} threads, {step['seconds_on_one_thread']} s with one,",
        f"              of which {dense:.0f} % in matrix products"
        + (f" and {sparse:.0f} % in sparse ones" if sparse else ""),
        f"  per clip    {parts} ms",
    ]
