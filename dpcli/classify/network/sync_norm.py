"""Batch norm over the clips of all processes, so that a run shared by several is the run of one with the same batch.

torch's own synchronized batch norm needs GPUs; this one asks for nothing but a sum over processes.
"""

from __future__ import annotations

import torch
import torch.distributed as dist
from torch import Tensor, nn


class SyncNorm(nn.BatchNorm1d):
    """Normalizes as a BatchNorm1d whose training statistics are those of all processes' rows together: (R,C), (B,C,L) or (B,C,H,W)."""

    def forward(self, values: Tensor) -> Tensor:
        """Returns the normalized values, of the same shape."""
        if not self.training:
            return nn.functional.batch_norm(
                values, self.running_mean, self.running_var, self.weight, self.bias, False, 0.0, self.eps
            )
        rows = values.transpose(0, 1).flatten(1).to(self.running_mean.dtype)  # (C, everything else)
        # Two passes as torch does: squares about the common mean keep digits that a difference of sums would lose.
        rows_of_all = _summed(rows.new_full((1,), rows.shape[1]))
        count = rows_of_all.clamp(min=1)
        mean = _summed(rows.sum(1)) / count
        var = _summed((rows - mean[:, None]).square().sum(1)) / count
        if rows_of_all > 0:
            self._remember(mean.detach(), var.detach() * count / (count - 1).clamp(min=1))
        scale = self.weight * torch.rsqrt(var + self.eps)
        shape = (1, -1) + (1,) * (values.dim() - 2)
        return values * scale.view(shape) + (self.bias - mean * scale).view(shape)

    @torch.no_grad()
    def _remember(self, mean: Tensor, var: Tensor) -> None:
        self.num_batches_tracked += 1
        self.running_mean.lerp_(mean, self.momentum)
        self.running_var.lerp_(var, self.momentum)


class _Sum(torch.autograd.Function):
    """Computes a sum over processes; its gradient is the sum of the processes' gradients."""

    @staticmethod
    def forward(ctx, values: Tensor) -> Tensor:
        total = values.clone()
        dist.all_reduce(total)
        return total

    @staticmethod
    def backward(ctx, gradient: Tensor) -> Tensor:
        total = gradient.clone()
        dist.all_reduce(total)
        return total


def _summed(values: Tensor) -> Tensor:
    return _Sum.apply(values)


def has_synchronized_norms(module: nn.Module) -> bool:
    """Returns whether a norm inside waits for all processes, each of which must then call the module equally often."""
    return any(isinstance(one, SyncNorm) for one in module.modules())


def synchronize_norms(module: nn.Module) -> nn.Module:
    """Replaces every batch norm inside by one over all processes, with the same parameters, statistics and names."""
    for name, child in module.named_children():
        if isinstance(child, nn.modules.batchnorm._BatchNorm) and not isinstance(child, SyncNorm):
            shared = SyncNorm(child.num_features, child.eps, child.momentum).train(child.training)
            shared.weight, shared.bias = child.weight, child.bias
            shared.running_mean, shared.running_var = child.running_mean, child.running_var
            shared.num_batches_tracked = child.num_batches_tracked
            setattr(module, name, shared)
        else:
            synchronize_norms(child)
    return module
