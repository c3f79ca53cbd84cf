"""The cost of a part network: parameters and multiply-adds, the paper's count beside them, time and memory."""

from __future__ import annotations

import statistics
import time
from typing import Any

import torch
from torch import nn

from dpcli.runtime.device import peak_memory
from dpcli.segment.network.config import PartConfig
from dpcli.segment.network.icosahedron import GROUPS
from dpcli.segment.network.kernel_points import kernel_points
from dpcli.segment.network.part_network import PartNetwork


def count_parameters(module: nn.Module) -> int:
    """Returns the number of all trainable numbers."""
    return sum(p.numel() for p in module.parameters())


def paper_parameters(module: nn.Module) -> int:
    """Returns the number of trainable numbers in plain 1x1 layers and layer norms.

    This is how the thesis's 0.25 M and 0.31 M come about: the tool that counted them saw no convolution over space or
    group, no attention, no group norm and no queries.
    """
    inside_attention = {id(m) for a in module.modules() if isinstance(a, nn.MultiheadAttention) for m in a.modules()}
    counted = (nn.Linear, nn.LayerNorm)
    return sum(
        count_parameters(m) for m in module.modules() if isinstance(m, counted) and id(m) not in inside_attention
    )


def convolution_macs(config: PartConfig, points: int) -> dict[str, int]:
    """Returns the multiply-adds of one frame's convolutions, by kind; a neighbor counts whether its weight is zero or not."""
    group, kernel = GROUPS[config.group](), kernel_points(config.kernel, config.group)
    rotations, positions, nearby = len(group), len(kernel.points), len(group.nearby)
    total = {"neighbor_sums": 0, "spatial": 0, "group": 0, "shortcut": 0}
    channels, here = 1, points
    for layer in (layer for block in config.layers for layer in block):
        count = layer.neighbors if config.rule == "first" else min(layer.neighbors, here)  # the former repeats points
        here = -(-here // layer.stride)
        sums = len(kernel.orbit) * count if channels == 1 else positions * count * rotations * channels
        total["neighbor_sums"] += here * sums
        total["spatial"] += here * rotations * positions * channels * layer.channels
        total["group"] += here * rotations * nearby * layer.channels**2
        total["shortcut"] += 0 if channels == 1 else here * rotations * channels * layer.channels
        channels = layer.channels
    return total


def count_macs(model: PartNetwork, points: torch.Tensor) -> dict[str, int]:
    """Returns the multiply-adds of one frame (1,N,3) by part of the network; the motion head's are half of a pair's."""
    from torch.utils.flop_counter import FlopCounterMode

    result = convolution_macs(model.config, points.shape[1])
    levels = model.encoder(points)
    with FlopCounterMode(display=False) as counter:
        mask = model.segmentation(points, levels)
    result["segmentation_head"] = counter.get_total_flops() // 2
    heads = model.config.pool_heads
    result["pooling"] = sum(  # turned coordinates, logits, weighted sums over the group
        level.equivariant[0, ..., 0].numel() * (9 + 3 * heads) + level.equivariant[0].numel() * 2 * heads
        for level in levels
    )
    if model.motion is not None:
        with FlopCounterMode(display=False) as counter:
            coarse, level = mask[:, : levels[-1].points.shape[1]], levels[-1]
            first, second = (model.motion.part_features(level.equivariant, level.points, coarse) for _ in range(2))
            model.motion(first, second)
        result["motion_head"] = counter.get_total_flops() // 4  # of one frame of two; a multiply-add is two operations
    return {**result, "total": sum(result.values())}


def measure_latency(model: PartNetwork, points: torch.Tensor) -> float:
    """Returns the median milliseconds, of 5 times, that the masks of points (B,N,3) take."""
    times = []
    with torch.inference_mode():
        for _ in range(6):  # the first warms up
            started = time.perf_counter()
            model(points)
            if points.device.type == "cuda":
                torch.cuda.synchronize(points.device)
            times.append(1000 * (time.perf_counter() - started))
    return round(statistics.median(times[1:]), 1)


def measure_cost(config: PartConfig, device: torch.device) -> dict[str, Any]:
    """Returns everything that `dpc segment profile` prints, as one object; the weights are random."""
    torch.manual_seed(0)
    model = PartNetwork(config).to(device).eval()
    frames = torch.nn.functional.normalize(torch.randn(4, config.points, 3), dim=-1).to(device) * 0.5
    counts = count_macs(model, frames[:1])
    parts = {name: count_parameters(module) for name, module in model.named_children()}
    attention = sum(count_parameters(m) for m in model.modules() if isinstance(m, nn.MultiheadAttention))
    return {
        "group": config.group,
        "points": config.points,
        "slots": config.slots,
        "parameters": {"total": count_parameters(model), **parts, "attention": attention},
        "paper_style_parameters": {"total": paper_parameters(model), "rule": "1x1 layers and layer norms only"},
        "macs_per_frame": counts,
        "uncounted": "neighbor search, norms, activations, softmax, interpolation between levels",
        "latency_ms": {"four_frames": measure_latency(model, frames)},
        "peak_memory_mb": round(peak_memory() / 2**20, 1),
        "device": str(device),
        "threads": torch.get_num_threads(),
    }
