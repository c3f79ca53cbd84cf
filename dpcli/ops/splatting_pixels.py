"""From projected Gaussians to pixels on a CPU: the autograd function around the kernels of `kernels_splat`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dpcli.ops.backend import key_indices, ordered_keys
from dpcli.ops.parallel import parallel_kernels


def pixels_numba(
    means2d: Tensor,  # [C, N, 2]
    conics: Tensor,  # [C, N, 3]
    colors: Tensor,  # [1 or C, N, D]
    opacities: Tensor,  # [1 or C, N]
    radii: Tensor,  # [C, N, 2] i32
    depths: Tensor,  # [C, N]
    width: int,
    height: int,
) -> tuple[Tensor, Tensor]:  # [C, H, W, D], [C, H, W, 1]
    """Composited colours (no background) and alphas, float32; as `splatting_torch.pixels_torch`, with gradients."""
    tensors = [t.contiguous() for t in (means2d, conics, colors, opacities)]
    out, alphas = _Pixels.apply(*tensors, radii.contiguous(), depths.detach(), width, height)
    return out, alphas[..., None]


@dataclass
class _Lists:
    """Which Gaussians each tile holds, nearest first; the arrays of `kernels_splat`."""

    tasks: np.ndarray
    tile_start: np.ndarray
    pair_start: np.ndarray
    gaussian: np.ndarray
    place: np.ndarray
    packed: np.ndarray
    box: np.ndarray
    across: int


def _lists(kernels, means2d, conics, opacities, radii: np.ndarray, depths: Tensor, width: int, height: int) -> _Lists:
    cameras, count = radii.shape[:2]
    packed, box = np.empty((cameras, count, 6), np.float32), np.empty((cameras, count, 4), np.int32)
    kernels.pack(means2d, conics, opacities, radii, width, height, packed, box)
    across, down = -(-width // kernels.WIDE), -(-height // kernels.TALL)
    tile_pairs, pairs = np.zeros((cameras, across * down), np.int64), np.zeros((cameras, count), np.int64)
    kernels.count_pairs(box, across, tile_pairs, pairs)
    tile_start, pair_start = (np.concatenate([[0], np.cumsum(a)]) for a in (tile_pairs, pairs))
    gaussian, place = np.empty(tile_start[-1], np.int32), np.empty(tile_start[-1], np.int64)
    kernels.fill_pairs(_by_depth(depths), box, across, tile_start, pair_start, gaussian, place)
    tasks = np.argsort(-tile_pairs.reshape(-1), kind="stable")[: np.count_nonzero(tile_pairs)]
    return _Lists(tasks, tile_start, pair_start, gaussian, place, packed, box, across)


def _by_depth(depths: Tensor) -> np.ndarray:
    """Per camera the Gaussians from near to far, ties by index; (C,N) i64. Those behind a camera are in no list."""
    keys = ordered_keys(depths.clamp(min=0)).numpy()
    keys.sort(axis=1)
    return key_indices(torch.from_numpy(keys)).numpy()


class _Pixels(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, conics, colors, opacities, radii, depths, width, height):
        import numba

        kernels = parallel_kernels("kernels_splat")
        arrays = [t.detach().numpy() for t in (means2d, conics, opacities)]
        lists = _lists(kernels, *arrays, radii.numpy(), depths, width, height)
        # numpy's zeros come from fresh pages, and wake no threads of torch's
        out = np.zeros((len(means2d), height, width, colors.shape[2]), np.float32)
        alphas = np.zeros(out.shape[:3], np.float32)
        ends = np.empty((len(lists.tile_start) - 1, kernels.TALL, 2, kernels.WIDE), np.float32)
        ctx.lists, ctx.ends, ctx.workers = lists, ends, numba.get_num_threads()
        work = (
            lists.tasks,
            ctx.workers,
            np.zeros(1, np.int64),
            lists.tile_start,
            lists.gaussian,
            lists.packed,
            lists.box,
        )
        kernels.forward(*work, colors.detach().numpy(), lists.across, out, alphas, ends)
        ctx.save_for_backward(conics, colors, opacities)
        return torch.from_numpy(out), torch.from_numpy(alphas)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_out, grad_alphas):
        kernels = parallel_kernels("kernels_splat")
        conics, colors, opacities = ctx.saved_tensors
        lists = ctx.lists
        sums = np.empty((len(lists.gaussian), 6 + colors.shape[2]), np.float32)
        work = (
            lists.tasks,
            ctx.workers,
            np.zeros(1, np.int64),
            lists.tile_start,
            lists.gaussian,
            lists.packed,
            lists.box,
        )
        incoming = [g.contiguous().numpy() for g in (grad_out, grad_alphas)]
        to_color = ctx.needs_input_grad[2]
        kernels.backward(*work, colors.detach().numpy(), lists.across, ctx.ends, *incoming, to_color, sums)
        to_means, to_conics = torch.empty(*conics.shape[:2], 2), torch.empty_like(conics)
        to_opacities, to_colors = torch.zeros_like(opacities), torch.zeros_like(colors)
        grads = (to_means, to_conics, to_opacities, to_colors)
        kernels.gather_gradients(
            lists.pair_start, lists.place, sums, conics.detach().numpy(), opacities.detach().numpy(),
            *(g.numpy() for g in grads),
        )  # fmt: skip
        return to_means, to_conics, to_colors, to_opacities, None, None, None, None
