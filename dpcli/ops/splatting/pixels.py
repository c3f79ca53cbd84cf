"""Turns projected Gaussians into pixels on a CPU: the autograd function around the kernels of `cpu_pixels`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dpcli.ops.cpu.parallel import parallel_kernels


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
    """Returns composited colors (no background) and alphas, float32; as `torch_reference.pixels_torch`, with gradients."""
    tensors = [t.contiguous() for t in (means2d, conics, colors, opacities)]
    out, alphas = _Pixels.apply(*tensors, radii.contiguous(), depths.detach().contiguous(), width, height)
    return out, alphas[..., None]


@dataclass
class _Lists:
    """Lists the Gaussians that each tile holds, nearest first, in the arrays of `cpu_tile_lists`."""

    tasks: np.ndarray
    tile_start: np.ndarray
    gaussian: np.ndarray
    packed: np.ndarray
    box: np.ndarray
    pair_start: np.ndarray


def _lists(means2d, conics, opacities, radii, depths: np.ndarray, width: int, height: int, workers: int) -> _Lists:
    shape = radii.shape[:2]
    packed, box = np.empty((*shape, 8), np.float32), np.empty((*shape, 4), np.int32)
    pair_start, counter = np.empty(shape, np.int64), np.zeros(1, np.int64)
    tile_lists = parallel_kernels("dpcli.ops.splatting.cpu_tile_lists").tile_lists
    projected = (means2d, conics, opacities, radii, depths.view(np.int32))
    lists = tile_lists(*projected, width, height, workers, counter, packed, box, pair_start)
    return _Lists(*lists, packed.reshape(-1), box.reshape(-1, 4), pair_start.reshape(-1))


class _Pixels(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, conics, colors, opacities, radii, depths, width, height):
        import numba

        kernels = parallel_kernels("dpcli.ops.splatting.cpu_pixels")
        ctx.workers, ctx.size = numba.get_num_threads(), (*radii.shape[:2], height, width, colors.shape[2])
        arrays = [t.numpy() for t in (means2d, conics, opacities, radii, depths)]
        lists = ctx.lists = _lists(*arrays, width, height, ctx.workers)
        # numpy's zeros come from fresh pages, and wake no threads of torch's
        out = np.zeros((len(radii), height, width, colors.shape[2]), np.float32)
        alphas = np.zeros(out.shape[:3], np.float32)
        ctx.ends = np.empty((len(lists.tile_start) - 1) * kernels.TALL * 2 * kernels.WIDE, np.float32)
        work = (lists.tasks, ctx.workers, np.zeros(1, np.int64), lists.tile_start, lists.gaussian, lists.packed)
        kernels.forward(
            kernels.TABLE,
            *work,
            colors.numpy().reshape(-1),
            ctx.size,
            len(colors) == 1,
            out.reshape(-1),
            alphas.reshape(-1),
            ctx.ends,
        )
        ctx.save_for_backward(conics, colors, opacities)
        return torch.from_numpy(out), torch.from_numpy(alphas)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_out, grad_alphas):
        kernels = parallel_kernels("dpcli.ops.splatting.cpu_pixels")
        conics, colors, opacities = ctx.saved_tensors
        lists, to_color = ctx.lists, ctx.needs_input_grad[2]
        sums = np.empty(len(lists.gaussian) * max(8, 6 + colors.shape[2]), np.float32)
        work = (lists.tasks, ctx.workers, np.zeros(1, np.int64), lists.tile_start, lists.gaussian, lists.packed)
        incoming = [g.contiguous().numpy().reshape(-1) for g in (grad_out, grad_alphas)]
        kernels.backward(
            kernels.TABLE,
            *work,
            lists.box,
            lists.pair_start,
            colors.numpy().reshape(-1),
            ctx.size,
            len(colors) == 1,
            ctx.ends,
            *incoming,
            to_color,
            sums,
        )
        shape = conics.shape[:2]
        to_means, to_conics = np.empty((*shape, 2), np.float32), np.empty((*shape, 3), np.float32)
        to_opacities, to_colors = np.zeros(opacities.shape, np.float32), np.zeros(colors.shape, np.float32)
        kernels.gather_gradients(
            lists.box.reshape(*shape, 4),
            lists.pair_start.reshape(shape),
            sums,
            conics.numpy(),
            opacities.numpy(),
            to_color,
            to_means,
            to_conics,
            to_opacities,
            to_colors,
        )
        grads = (to_means, to_conics, to_colors, to_opacities)
        return *(torch.from_numpy(g) for g in grads), None, None, None, None
