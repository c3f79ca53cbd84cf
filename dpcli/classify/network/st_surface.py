"""The space-time surface (ST-surface): weighted least-squares fit of A f + b = t, its normal (ST-normal), and the deviations.

Equations 3.4 to 3.7 of the thesis: the tangent hyperplane over a neighborhood, for K groups of d features at once. Everything
is differentiable, batched over leading dimensions, and free of parameters. n counts neighbors; times are in frames.

A network calls `fit_reduced` of `st_surface_cpu.py`, which reduces its features and then fits by `fit_surface` and
`deviations` of this module; on a CPU by kernels instead (`ops/cpu`), with the same numbers.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dpcli.ops import small_inverse, small_solve
from dpcli.ops.small_inverses import GUARDS, MIN_DET
from dpcli.runtime.mixed_precision import full_precision

_RIDGE = 1e-3  # of the mean diagonal; large enough for float32's elimination at rank-deficient neighborhoods, small beside the data


@full_precision
def fit_surface(
    features: Tensor,  # (...,n,K,d)
    times: Tensor,  # (...,n)
    weights: Tensor | None = None,  # (...,n,K)
    solver: str = "inverse",
    guard: str = "signed",
) -> Tensor:  # (...,K,d+1)
    """Returns the coefficients [A, b] minimizing sum_j w_j (A f_j + b - t_j)^2 (eq. 3.5) for each group, in closed form (eq. 3.6).

    `inverse` inverts the normal matrix by thesis A.1.1, where a small determinant is replaced as `guard` says;
    `ridge` adds 1e-3 of the mean diagonal to it, which bounds the result where the neighbors don't span the space
    (repeated points, dead features), and solves by elimination. `weights=None` means 1.

    >>> plane = torch.tensor([[0.0], [1.0], [2.0], [4.0]])  # n = 4 neighbors, one group of d = 1 feature
    >>> fit_surface(plane[:, None], 3 * plane[:, 0] + 1).round(decimals=3)  # t = 3 f + 1
    tensor([[3., 1.]])
    """
    design = torch.cat([features, torch.ones_like(features[..., :1])], -1).transpose(-3, -2)
    weighted = design if weights is None else design * weights.transpose(-1, -2)[..., None]
    matrix, right = weighted.transpose(-1, -2) @ design, (weighted * times[..., None, :, None]).sum(-2)
    if solver == "ridge":
        mean = matrix.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
        matrix = matrix + (_RIDGE * mean + 1e-9) * torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
        return small_solve(matrix, right)
    return (small_inverse(matrix, guard=guard) * right[..., None, :]).sum(-1)


def solve_rule(solver: str, guard: str) -> tuple[float, float, int]:
    """Returns a solver and guard of `fit_surface` as the kernels of `ops.cpu` takes them: (ridge, least determinant, guard)."""
    return (_RIDGE, 0.0, GUARDS.index("none")) if solver == "ridge" else (0.0, MIN_DET, GUARDS.index(guard))


def surface_normal(coefficients: Tensor) -> Tensor:
    """Returns the unit normal (A, -1) / ||(A, -1)|| of eq. 3.7: (...,d+1) coefficients -> (...,d+1).

    >>> surface_normal(torch.tensor([0.0, 0.0, 7.0]))  # time doesn't change over the surface
    tensor([ 0.,  0., -1.])
    """
    slopes = coefficients[..., :-1]
    return torch.nn.functional.normalize(torch.cat([slopes, -torch.ones_like(slopes[..., :1])], -1), dim=-1, eps=1e-6)


@full_precision
def deviations(coefficients: Tensor, features: Tensor, times: Tensor) -> Tensor:
    """Returns the fitting deviation A f_j + b - t_j of each neighbor: (...,K,d+1), (...,n,K,d), (...,n) -> (...,n,K)."""
    plane = coefficients[..., None, :, :]
    return (features * plane[..., :-1]).sum(-1) + plane[..., -1] - times[..., None]


@full_precision
def along_normal(coefficients: Tensor, deviations: Tensor) -> Tensor:
    """Returns the deviations e as vectors along the normal, (A,-1) e / ||(A,-1)||^2, as the released code uses them.

    coefficients (...,K,d+1), deviations (...,n,K) -> (...,n,K,d+1).
    """
    slopes = coefficients[..., :-1]
    direction = torch.cat([slopes, -torch.ones_like(slopes[..., :1])], -1)
    scaled = direction / direction.square().sum(-1, keepdim=True)
    return deviations[..., None] * scaled[..., None, :, :]
