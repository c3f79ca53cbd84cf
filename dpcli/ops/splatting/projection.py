"""Projecting Gaussians on a CPU: the autograd function around the kernels of `cpu_projection`."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dpcli.ops.cpu.parallel import parallel_kernels


def project_numba(
    means: Tensor,  # [1 or C, N, 3]
    quats: Tensor,  # [1 or C, N, 4]
    scales: Tensor,  # [1 or C, N, 3]
    opacities: Tensor,  # [1 or C, N]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
    eps2d: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # [C, N, 2], [C, N, 3], [C, N], [C, N, 2] i32
    """Projects as `torch_reference.project_torch`, with gradients of means, quats and scales; those of unseen Gaussians are zero."""
    tensors = [t.contiguous() for t in (means, quats, scales)]
    limits = tuple(float(value) for value in (near_plane, far_plane, radius_clip, eps2d))
    return _Projection.apply(*tensors, opacities.detach().contiguous(), viewmats, Ks, width, height, limits)


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, scales, opacities, viewmats, Ks, width, height, limits):
        kernels = parallel_kernels("dpcli.ops.splatting.cpu_projection")
        cameras = [np.ascontiguousarray(t.detach().numpy(), np.float64) for t in (viewmats, Ks)]
        count = means.shape[1]
        means2d, conics = torch.empty(len(viewmats), count, 2), torch.empty(len(viewmats), count, 3)
        depths = torch.empty(len(viewmats), count)
        radii = torch.empty(len(viewmats), count, 2, dtype=torch.int32)
        inputs = [t.detach().numpy() for t in (means, quats, scales, opacities)]
        outputs = [t.numpy() for t in (means2d, conics, depths, radii)]
        kernels.project(*inputs, *cameras, width, height, *limits, *outputs)
        ctx.cameras, ctx.size = cameras, (width, height)
        ctx.save_for_backward(means, quats, scales, conics, radii)
        ctx.mark_non_differentiable(radii)
        return means2d, conics, depths, radii

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, to_means2d, to_conics, to_depths, _):
        kernels = parallel_kernels("dpcli.ops.splatting.cpu_projection")
        *inputs, conics, radii = ctx.saved_tensors
        gradients = [np.zeros(t.shape, np.float32) for t in inputs]  # wakes no threads of torch's
        incoming = [t.contiguous().numpy() for t in (to_means2d, to_conics, to_depths)]
        inputs = [t.detach().numpy() for t in inputs]
        kernels.project_backward(
            *inputs, *ctx.cameras, *ctx.size, conics.detach().numpy(), radii.numpy(), *incoming, *gradients
        )
        return *(torch.from_numpy(g) for g in gradients), None, None, None, None, None, None
