"""Inverses of many small matrices at once (thesis A.1.1): closed form to 4x4, by blocks to 16x16, Cholesky beyond; and solutions
without an inverse."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

GUARDS = ("signed", "release", "none")
MIN_DET = 1e-6
KERNEL_SIZE = 8  # largest n of the kernels that fit planes
_CLOSED, _BLOCKS = 4, 16  # of the closed form, and of the block partition


def small_inverse(matrices: Tensor, *, min_det: float = MIN_DET, guard: str = "signed") -> Tensor:
    """Inverts matrices (...,n,n), differentiable; float32 or float64.

    n <= 4: adjugate over determinant, element by element. n <= 16: 2x2 block partition with the Schur complement,
    recursively down to the closed form; without pivoting, so it expects symmetric positive definite matrices, as normal
    equations are. n > 16: Cholesky; reads the lower triangle only.
    guard: what happens to a determinant (in a block partition: of a block) with |det| < min_det. "signed" moves it to
    min_det with its own sign (0 counts as positive), "release" to +min_det, whatever its sign, as the released Kinet
    does, "none" leaves it: a singular matrix then gives inf or nan. A moved determinant carries no gradient.
    Cholesky has no determinant to move: with a guard, a matrix with a pivot below min_det of its trace has that much added
    to its diagonal (a matrix of zeros min_det itself), and that carries no gradient either.
    One form for all devices; the kernels that fit planes on a CPU invert for themselves. Raises ValueError on a wrong shape,
    dtype or guard; torch.linalg.LinAlgError where Cholesky meets a finite matrix that is not even then positive definite.

    >>> small_inverse(torch.tensor([[2.0, 1.0], [1.0, 1.0]])).tolist()
    [[1.0, -1.0], [-1.0, 2.0]]
    """
    _check(matrices, guard)
    return _inverse(matrices, min_det, guard)


def small_solve(matrices: Tensor, right: Tensor) -> Tensor:
    """Solves M x = r for symmetric positive definite matrices (...,n,n) and r (...,n) -> (...,n), differentiable.

    By elimination: right up to a condition of about 1e6 in float32, where a closed-form inverse has long lost the
    determinant to rounding. One form for all devices; where a matrix isn't finite or has no positive pivots, neither is x.

    >>> small_solve(torch.tensor([[2.0, 0.0], [0.0, 4.0]]), torch.tensor([2.0, 2.0])).tolist()
    [1.0, 0.5]
    """
    rows, sides, pivots = [], [], []
    for _ in range(matrices.shape[-1]):
        pivot, row, side = matrices[..., :1, 0], matrices[..., 0, 1:], right[..., :1]
        factor = row / pivot  # by symmetry the column's
        rows.append(row)
        sides.append(side)
        pivots.append(pivot)
        matrices = matrices[..., 1:, 1:] - factor[..., None] * row[..., None, :]
        right = right[..., 1:] - factor * side
    found = right  # (...,0)
    for pivot, row, side in zip(reversed(pivots), reversed(rows), reversed(sides)):
        found = torch.cat([(side - (row * found).sum(-1, keepdim=True)) / pivot, found], -1)
    return found


def correct_guarded_gradients(
    moments: np.ndarray,
    places: np.ndarray,
    planes: np.ndarray,
    guard: tuple[float, str],
    grad: np.ndarray,
    grad_matrix: np.ndarray,
    moved: np.ndarray,
) -> None:
    """Sets the gradients of the fits whose determinant a guard moved, which the kernel `solve_planes_back` leaves wrong.

    moments f32 (centroids,entries,groups); places i64 (n,n+1): which of a fit's entries are its normal matrix and right
    side; planes f32 (centroids,n,groups): the kernel's solutions; guard: least determinant and name; grad f32
    (centroids,n,groups) at the planes; grad_matrix f32 (centroids,n,n,groups), changed in place: G + G'; moved bool
    (centroids,groups). By autograd of the torch twin: a kernel of 190 lines took 0.84 of the time of a step of the
    dynamic stream in preset thesis, and is not worth them.
    """
    centroid, group = np.nonzero(moved)
    if not len(centroid):
        return
    entries, size = moments[centroid, :, group], len(places)
    matrices, right = (torch.from_numpy(entries[:, part]) for part in (places[:, :size], places[:, size]))
    at_inverse = torch.from_numpy(grad[centroid, :, group])[:, :, None] * right[:, None]
    with torch.inference_mode(False), torch.enable_grad():
        leaf = matrices.clone().requires_grad_()
        inverse = _inverse(leaf, *guard)
        found = torch.autograd.grad(inverse, leaf, at_inverse.clone())[0].numpy()
    # of a determinant that is zero but for rounding the twin may see the other sign: no direction is right there
    solved = (inverse.detach() * right[:, None]).sum(-1).numpy()
    found[(solved * planes[centroid, :, group]).sum(1) < 0] = 0
    grad_matrix[centroid, :, :, group] = found + found.transpose(0, 2, 1)


def _check(matrices: Tensor, guard: str) -> None:
    if matrices.ndim < 2 or matrices.shape[-1] != matrices.shape[-2] or matrices.shape[-1] == 0:
        raise ValueError(f"matrices must have shape (...,n,n) with n >= 1, but have {tuple(matrices.shape)}")
    if matrices.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"matrices must be float32 or float64, but are {matrices.dtype}")
    if guard not in GUARDS:
        raise ValueError(f"guard must be one of {', '.join(GUARDS)}, but is {guard!r}")


def _guarded(det: Tensor, min_det: float, guard: str) -> Tensor:
    if guard == "none":
        return det
    floor = torch.full_like(det, min_det)
    if guard == "signed":
        floor = torch.where(det < 0, -floor, floor)
    return torch.where(det.abs() < min_det, floor, det)


def _inverse(m: Tensor, min_det: float, guard: str) -> Tensor:
    n = m.shape[-1]
    if n <= _CLOSED:
        rows = m.reshape(-1, n * n).t().contiguous().unbind(0)  # contiguous: strided entries cost twice the time
        adjugate, det = (_adjugate1, _adjugate2, _adjugate3, _adjugate4)[n - 1](*rows)
        return (torch.stack(adjugate) / _guarded(det, min_det, guard)).t().reshape(m.shape)
    return (_block_inverse if n <= _BLOCKS else _cholesky_inverse)(m, min_det, guard)


def _block_inverse(m: Tensor, min_det: float, guard: str) -> Tensor:
    """Computes [[A,B],[C,D]]^-1 from A^-1 and the inverse of the Schur complement D - C A^-1 B."""
    half = (m.shape[-1] + 1) // 2
    b, c, d = m[..., :half, half:], m[..., half:, :half], m[..., half:, half:]
    a_inverse = _inverse(m[..., :half, :half], min_det, guard)
    left, right = c @ a_inverse, a_inverse @ b
    corner = _inverse(d - left @ b, min_det, guard)
    upper = -right @ corner
    top = torch.cat([a_inverse - upper @ left, upper], -1)
    return torch.cat([top, torch.cat([-corner @ left, corner], -1)], -2)


def _cholesky_inverse(m: Tensor, min_det: float, guard: str) -> Tensor:
    """Inverts by Cholesky's factor; where it is (nearly) singular and a guard is on, of the matrix with a lifted diagonal."""
    if guard != "none":
        with torch.no_grad():
            factor, failed = torch.linalg.cholesky_ex(m)
            trace = m.diagonal(dim1=-2, dim2=-1).sum(-1)
            lift = min_det * torch.where(trace == 0, torch.ones_like(trace), trace)
            small = (failed > 0) | (factor.diagonal(dim1=-2, dim2=-1).square().amin(-1) < lift)
            lift = torch.where(small, lift, torch.zeros_like(lift))
        m = m + torch.diag_embed(lift[..., None].expand(m.shape[:-1]))
    finite = m.isfinite().all(-1).all(-1)[..., None, None]
    known = torch.where(finite, m, torch.eye(m.shape[-1], dtype=m.dtype, device=m.device))
    # what isn't finite stays so, as in the closed form: it shows in the loss instead of raising an error here
    return torch.where(finite, torch.cholesky_inverse(torch.linalg.cholesky(known)), torch.nan)


def _adjugate1(a: Tensor) -> tuple[list[Tensor], Tensor]:
    return [torch.ones_like(a)], a


def _adjugate2(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> tuple[list[Tensor], Tensor]:
    return [d, -b, -c, a], a * d - b * c


def _adjugate3(a, b, c, d, e, f, g, h, i) -> tuple[list[Tensor], Tensor]:  # nine tensors, row by row
    first = [e * i - f * h, c * h - b * i, b * f - c * e]
    second = [f * g - d * i, a * i - c * g, c * d - a * f]
    third = [d * h - e * g, b * g - a * h, a * e - b * d]
    return first + second + third, a * first[0] + b * second[0] + c * third[0]


def _adjugate4(*m: Tensor) -> tuple[list[Tensor], Tensor]:
    """Computes adjugate and determinant by 2x2 minors of the upper two rows (u) and the lower two (v).

    Column pairs: 01 02 03 12 13 23.
    """
    pairs = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
    u = [m[i] * m[4 + j] - m[j] * m[4 + i] for i, j in pairs]
    v = [m[8 + i] * m[12 + j] - m[j + 8] * m[12 + i] for i, j in pairs]
    det = u[0] * v[5] - u[1] * v[4] + u[2] * v[3] + u[3] * v[2] - u[4] * v[1] + u[5] * v[0]
    adjugate: list[Tensor] = [det] * 16
    # Row r of the adjugate leaves out column r: its minors pair the three columns that are left.
    for r, (p, q, s) in enumerate(((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))):
        qs, ps, pq = pairs.index((q, s)), pairs.index((p, s)), pairs.index((p, q))
        for col, (row, w) in enumerate(((1, v), (0, v), (3, u), (2, u))):
            minor = m[4 * row + p] * w[qs] - m[4 * row + q] * w[ps] + m[4 * row + s] * w[pq]
            adjugate[4 * r + col] = minor if (r + col) % 2 == 0 else -minor
    return adjugate, det
