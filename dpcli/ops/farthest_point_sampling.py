"""Farthest point sampling (Qi et al., PointNet++, 2017) of batches of clouds."""

from __future__ import annotations

import torch

from dpcli.ops.backend import chosen_backend, positions, run_in_threads


def fps(
    points: torch.Tensor,  # [B, N, 3]
    num_samples: int,
    *,
    start: int = 0,
) -> torch.Tensor:  # [B, num_samples]
    """Samples farthest points: indices (B,S) i64 into each cloud, the first always `start`.

    Each further index maximizes the squared Euclidean distance (float32) to all chosen ones; ties go to the lowest
    index, also among points already chosen, so once every distinct position is taken index 0 repeats.
    Where num_samples exceeds the N points, the sequence repeats from its beginning: index s equals index s mod N.
    Backends: numba (exact bucketed search) on CPU, torch elsewhere; both give the same indices.
    Raises ValueError on wrong shapes, non-finite coordinates, or start beyond a cloud's end.

    >>> line = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 0, 0]]])
    >>> fps(line, 3).tolist()  # the farthest from the first, then the farthest from both
    [[0, 3, 2]]
    """
    points = _checked(points, num_samples, start)
    if chosen_backend(points.device) == "torch" or points.shape[0] == 0:
        return _fps_torch(points, num_samples, start)
    from dpcli.ops.cpu.farthest_point_sampling import fps_kernel

    batch, count, _ = points.shape
    out = torch.empty((batch, num_samples), dtype=torch.int64)
    item_ns = count * (25 + num_samples / 16)  # measured: sorting, and bounding every bucket for every sample
    run_in_threads(fps_kernel, (points.contiguous().numpy(), start, out.numpy()), batch, item_ns)
    return out


def fps_reference(points: torch.Tensor, num_samples: int, *, start: int = 0) -> torch.Tensor:
    """Computes `fps` in plain torch, as a reference: same arguments and indices, a vectorized pass per sample."""
    return _fps_torch(_checked(points, num_samples, start), num_samples, start)


def _checked(points: torch.Tensor, num_samples: int, start: int) -> torch.Tensor:
    points = positions("points", points)
    count = points.shape[1]
    if count == 0:
        raise ValueError(f"points {tuple(points.shape)} hold no point")
    if num_samples < 1:
        raise ValueError(f"num_samples must be at least 1, but is {num_samples}")
    if not 0 <= start < count:
        raise ValueError(f"start must lie in 0..{count - 1}, but is {start}")
    return points


def _fps_torch(points: torch.Tensor, num_samples: int, start: int) -> torch.Tensor:
    batch, count, _ = points.shape
    xyz = points.transpose(1, 2).contiguous()
    nearest = points.new_full((batch, count), float("inf"))
    last = torch.full((batch, 1), start, dtype=torch.int64, device=points.device)
    chosen = [last]
    for _ in range(min(num_samples, count) - 1):
        # few operations: a GPU waits for each of them to be launched, so often that a step of training is mostly this loop
        away = (xyz - xyz.gather(2, last[:, None].expand(-1, 3, -1))).square_()
        nearest = torch.minimum(nearest, away[:, 0] + away[:, 1] + away[:, 2])
        last = nearest.argmax(1, keepdim=True)
        chosen.append(last)
    return torch.cat(chosen, 1)[:, torch.arange(num_samples, device=points.device) % count]
