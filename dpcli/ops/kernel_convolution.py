"""The spatial half of an SE(3) convolution: neighbors summed into rotated kernel points, then mixed by weights."""

from __future__ import annotations

import torch
from torch import Tensor

from dpcli.ops.backend import check_rows, chosen_backend, run_in_threads

_FMA_NS = 0.08  # measured: per multiply-add of the kernels, one core
_CENTERS = 64  # whose sums are held at a time: a few MiB, which stay in the cache between the steps


def kernel_convolution(features: Tensor, index: Tensor, weight: Tensor, slot: Tensor, matrix: Tensor) -> Tensor:
    """Computes an SE(3) point convolution (EPN; Chen et al. 2021): sums over neighbors, times the kernel's weights.

    out[b,p,g] = sum_k sum_j weight[b,p,j, slot[g,k]] * features[b, index[b,p,j], g] @ matrix[k]

    features (B,N,G,C); index (B,P,n) i64, the neighbors of every center; weight (B,P,n,D), what each counts at D kernel
    positions that the group permutes; slot (G,D) i64, the position that rotation g makes of kernel point k;
    matrix (D*C,C'), rows kernel point by kernel point. -> (B,P,G,C'). Differentiable in features and matrix only.
    Backends: numba on CPU (skips zero weights; sums are made again for the gradient, so nothing of size P*G*D*C or
    P*G*D*n is kept), torch elsewhere; equal to rounding. Raises ValueError on shapes that don't fit and, on CPU, on an
    index out of range.
    """
    _check(features, index, weight, slot, matrix)
    if features.dtype == torch.float32 and chosen_backend(features.device) == "numba":
        return _KernelConvolution.apply(features, index, weight, slot, matrix)
    return kernel_convolution_reference(features, index, weight, slot, matrix)


def kernel_convolution_reference(
    features: Tensor, index: Tensor, weight: Tensor, slot: Tensor, matrix: Tensor
) -> Tensor:
    """Computes `kernel_convolution` in plain torch, as a reference: same arguments, same result, any precision and device."""
    _check(features, index, weight, slot, matrix)
    rows = torch.arange(len(features), device=features.device)[:, None, None]
    near = features[rows, index].transpose(2, 3)  # [B, P, G, n, C]
    turned = weight.to(features.dtype)[..., slot]  # [B, P, n, G, D]
    return (turned.permute(0, 1, 3, 4, 2) @ near).flatten(-2) @ matrix.to(features.dtype)


def _check(features: Tensor, index: Tensor, weight: Tensor, slot: Tensor, matrix: Tensor) -> None:
    fits = (
        features.ndim == 4
        and index.ndim == 3
        and weight.ndim == 4
        and slot.ndim == 2
        and index.shape[0] == features.shape[0]
        and weight.shape[:3] == index.shape
        and slot.shape == (features.shape[2], weight.shape[3])
        and len(matrix) == weight.shape[3] * features.shape[3]
    )
    if not fits:
        shapes = ", ".join(str(tuple(t.shape)) for t in (features, index, weight, slot, matrix))
        raise ValueError(f"features (B,N,G,C), index (B,P,n), weight (B,P,n,D), slot (G,D), matrix (D*C,C'): {shapes}")
    check_rows(index, features.shape[1])


class _Sums:
    """Computes the kernel sums of one batch, a few centers at a time, and their transpose."""

    def __init__(self, features: Tensor, index: Tensor, weight: Tensor, slot: Tensor) -> None:
        self.features, self.index, self.weight = features, index, weight
        _, _, self.rotations, self.channels = features.shape
        self.orbit = weight.shape[3]
        g = torch.arange(self.rotations)
        # flat sums are (D,G,C); row g,k of the product's left side is (slot[g,k], g)
        self.pick = (slot * self.rotations + g[:, None]).flatten()
        self.put = torch.argsort(self.pick)
        self.cost = index.shape[2] * self.orbit * self.rotations * self.channels * _FMA_NS / 4  # most weights are zero
        self.flat = torch.empty(_CENTERS, self.orbit * self.rotations, self.channels)
        self.turned = torch.empty(_CENTERS, self.orbit * self.rotations, self.channels)

    def pieces(self):
        """Yields every block of centers as (cloud, slice of centers)."""
        for b in range(len(self.index)):
            for start in range(0, self.index.shape[1], _CENTERS):
                yield b, slice(start, min(start + _CENTERS, self.index.shape[1]))

    def forward(self, b: int, piece: slice) -> Tensor:
        """Returns the sums (centers*G, D*C) of a block of centers, in a buffer that the next block overwrites."""
        from dpcli.ops.cpu.kernel_convolution import group_forward

        size = piece.stop - piece.start
        flat, turned = self.flat[:size], self.turned[:size]
        out = flat.view(size, self.orbit, -1)
        arrays = (self.features[b].flatten(1), self.index[b, piece], self.weight[b, piece], out)
        run_in_threads(group_forward, tuple(a.numpy() for a in arrays), size, self.cost)
        torch.index_select(flat, 1, self.pick, out=turned)
        return turned.view(size * self.rotations, -1)

    def backward(self, b: int, piece: slice, grad: Tensor, out: Tensor) -> None:
        """Adds the gradient of a block's sums (centers*G, D*C) into out (B,N,G*C)."""
        from dpcli.ops.cpu.kernel_convolution import group_backward

        size = piece.stop - piece.start
        flat = self.flat[:size]
        torch.index_select(grad.view(size, -1, self.channels), 1, self.put, out=flat)
        arrays = (flat.view(size, self.orbit, -1), self.index[b, piece], self.weight[b, piece], out[b])
        columns = self.rotations * self.channels
        run_in_threads(group_backward, tuple(a.numpy() for a in arrays), columns, self.cost * size / columns)


class _KernelConvolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx, features: Tensor, index: Tensor, weight: Tensor, slot: Tensor, matrix: Tensor) -> Tensor:
        features = features.detach().contiguous()
        index, weight = index.to(torch.int32).contiguous(), weight.detach().float().contiguous()
        ctx.save_for_backward(features, index, weight, slot, matrix)
        sums = _Sums(features, index, weight, slot)
        out = torch.empty(*index.shape[:2], features.shape[2], matrix.shape[1])
        for b, piece in sums.pieces():
            torch.mm(sums.forward(b, piece), matrix.detach(), out=out[b, piece].view(-1, matrix.shape[1]))
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, None, None, None, Tensor | None]:
        features, index, weight, slot, matrix = ctx.saved_tensors
        grad = grad.contiguous()
        sums = _Sums(features, index, weight, slot)
        to_features = torch.zeros(features.flatten(2).shape) if ctx.needs_input_grad[0] else None
        to_matrix = torch.zeros_like(matrix) if ctx.needs_input_grad[4] else None
        turned = torch.empty(_CENTERS * sums.rotations, matrix.shape[0])
        for b, piece in sums.pieces():
            given = grad[b, piece].view(-1, matrix.shape[1])
            if to_matrix is not None:
                to_matrix.addmm_(sums.forward(b, piece).T, given)
            if to_features is not None:
                sums.backward(b, piece, torch.mm(given, matrix.T, out=turned[: len(given)]), to_features)
        return None if to_features is None else to_features.view(features.shape), None, None, None, to_matrix
