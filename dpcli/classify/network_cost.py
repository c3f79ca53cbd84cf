"""The cost of a Kinet: parameters and multiply-adds as they are, the papers' ways of counting beside them, and memory.

How fast it is: `network_speed.py`.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from dpcli.classify.network.backbones.interface import Grouping, Stage
from dpcli.classify.network.kinematic import Kinematics
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network_speed import body_like_clip, latency, steps
from dpcli.counted import counted
from dpcli.ops.backend import reference_only
from dpcli.runtime.device import peak_memory


def count_parameters(module: nn.Module) -> int:
    """Returns the count of all trainable numbers, batch norm's included."""
    return sum(p.numel() for p in module.parameters())


def paper_parameters(module: nn.Module) -> float:
    """Returns millions as the thesis's table A.1 counts: weights, both Adam moments and batch norm's moving statistics, over 2^20."""
    return (3 * count_parameters(module) + _moving_statistics(module)) / 2**20


def _moving_statistics(module: nn.Module) -> int:
    return sum(buffer.numel() for name, buffer in module.named_buffers() if "running" in name)


def _paper_total(model: Kinet) -> float:
    """Returns both streams counted that way: a frozen static stream has no moments, and is counted once."""
    frozen = count_parameters(model.static) + _moving_statistics(model.static)
    return paper_parameters(model.dynamic) + frozen / 2**20


def macs(model: Kinet, points: torch.Tensor) -> dict[str, int]:
    """Returns multiply-adds of the matrix products of one clip (B=1), by stream, and of the fits (counted by hand).

    Neighbor search, batch norm, activations and the small inverses are not in it; each is named in `uncounted`. Where the
    static stream has neighborhoods of its own, its layers' second pass, at the dynamic stream's, is the dynamic stream's.
    """
    groups = model.group(points)
    stages, both = _tapped(model, groups)
    own = groups[: len(groups) // 2] if model.config.own_static_groups else groups  # they come first
    static = both if own is groups else _tapped(model, own)[1]
    written = getattr(model.static, "macs_as_written", lambda: static)()
    dynamic = both - static + _linear_macs(model.dynamic, stages) + _fit_macs(model, stages)
    return {"static": static, "static_as_written": written, "dynamic": dynamic, "total": static + dynamic}


def _tapped(model: Kinet, groups: list[Grouping]) -> tuple[list[Stage], int]:
    """Returns what the dynamic stream reads of the static network, and the multiply-adds that it takes."""
    from torch.utils.flop_counter import FlopCounterMode

    with torch.no_grad(), reference_only(), FlopCounterMode(display=False) as counter:
        stages, _ = model.static.taps(groups)
    return stages, counter.get_total_flops() // 2


def _linear_macs(dynamic: Kinematics, stages: list[Stage]) -> int:
    """Returns multiply-adds of the dynamic stream's linear layers that are called as such: all but the units' reductions."""
    counts: list[int] = []

    def count(layer: nn.Linear, _: tuple, out: torch.Tensor) -> None:
        """Counts the multiply-adds of one call of a layer."""
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
        unread = config.weighting == "none" or number == len(shapes)  # no weights come from the last deviations
        per_neighbor = size * (size + 1) // 2 + size + (0 if unread else size)
        total += centroids * unit.groups * (neighbors * per_neighbor + size * size)
        total += centroids * neighbors * unit.reduce.weight.numel()
    return total if config.normals else 0


def measure(model: Kinet, device: torch.device, with_steps: bool = False) -> dict[str, Any]:
    """Returns everything that `dpc classify profile` prints, as one object."""
    config = model.config
    torch.manual_seed(0)
    points = body_like_clip(config.num_frames, config.points_per_frame).to(device)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
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
        "peak_memory_mb": _peak(device),
        "device": str(device),
        "threads": torch.get_num_threads(),
    }
    if with_steps:
        result |= steps(model, device)
    return result


def _peak(device: torch.device) -> float:
    if device.type == "cuda":
        return round(torch.cuda.max_memory_allocated(device) / 2**20, 1)
    return round(peak_memory() / 2**20, 1)


def render(result: dict[str, Any]) -> str:
    """Returns the object of `measure` as lines for a person."""
    lines = [
        f"Kinet on {result['backbone']}, {result['variant']} variant, {counted(result['classes'], 'class')},"
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
    lines.append(
        f"latency       {times} ms on {result['device']} with {counted(result['threads'], 'thread')}, one clip at a time"
    )
    lines.append(f"peak memory   {result['peak_memory_mb']} MB of the process")
    for key in ("static_step", "dynamic_step", "inference"):
        lines += _step_lines(key.replace("_", " "), result[key]) if key in result else []
    return "\n".join(lines)


def _step_lines(name: str, step: dict[str, Any]) -> list[str]:
    parts = ", ".join(f"{part.replace('_', ' ')} {value}" for part, value in step["ms_per_clip"].items() if value)
    dense, sparse = (100 * step[f"{kind}_products_share"] for kind in ("matrix", "sparse"))
    return [
        f"{name:<13} {step['batch'] / step['seconds']:.3g} clips/s: {step['seconds']} s for {counted(step['batch'], 'clip')} with"
        f" {counted(step['threads'], 'thread')}, {step['seconds_on_one_thread']} s with one,",
        f"              of which {dense:.0f} % in matrix products"
        + (f" and {sparse:.0f} % in sparse ones" if sparse else ""),
        f"  per clip    {parts} ms",
    ]
