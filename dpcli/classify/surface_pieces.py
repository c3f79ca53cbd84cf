"""The core of a kinematic unit: reduce a neighbourhood's features, group them, and fit a weighted plane to each group.

`fit_reduced` has a plain torch form (the reference, and the path on a GPU) and a CPU form that goes through the centroids
in pieces: the reduced features, the largest thing here, live in the cache and are made again for the gradient. Both give
the same numbers; tests compare them in value and gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from dpcli.classify.st_surface import deviations, fit_surface, solve_rule
from dpcli.ops.backend import chosen_backend
from dpcli.ops.linalg import KERNEL_SIZE
from dpcli.ops.pieces import TASKS, ranges, share_tasks, steps
from dpcli.runtime.precision import is_reduced

_PIECE = 1 << 20  # bytes of reduced features
_LANES = 8  # groups that the kernels take together
_NOTHING = np.empty(0, np.float32)


@dataclass(frozen=True)
class Fit:
    """How planes are fitted: groups of `size` features, and `fit_surface`'s solver and guard."""

    size: int
    solver: str = "inverse"
    guard: str = "signed"
    deviations: bool = True  # whether they are wanted


def fit_reduced(
    activation: Tensor,  # (B,M,n,C)
    linear: tuple[Tensor, Tensor],  # weight (L*d,C), bias (L*d)
    relative: Tensor | None,  # (B,M,n,3)
    times: Tensor,  # (B,M,n)
    logits: Tensor | None,  # (B,M,n,K)
    fit: Fit,
) -> tuple[Tensor, Tensor | None]:
    """Planes A f + b = t through K groups of d features f of each centroid's n neighbours (thesis eq. 3.5, 3.6).

    f = relu(W a + b') of the activation a, in L groups; with `relative` one more, the neighbour's coordinates (and zeros,
    where d > 3). A neighbour weighs sigmoid(logits), or 1. Returns the coefficients [A, b] (B,M,K,d+1) and the deviations
    A f + b - t (B,M,n,K), or None. Differentiable in weight, bias and logits; by the reference, which is taken where the
    activation asks for a gradient, in that, too.
    """
    if not _fast(activation, fit.size):
        return fit_reduced_reference(activation, linear, relative, times, logits, fit)
    shape = activation.shape[:3]
    layout = _Layout(len(linear[0]) // fit.size, relative is not None, fit.size)
    weight, bias = layout.spread(linear[0]), layout.spread(linear[1])
    near = None if relative is None else relative.detach().reshape(-1, 3).contiguous()
    if logits is not None and layout.used < layout.groups:
        logits = torch.nn.functional.pad(logits, (0, layout.groups - layout.used))
    logits = None if logits is None else logits.reshape(-1, layout.groups)
    flat = (activation.detach().reshape(-1, activation.shape[3]), weight, bias, near, times.reshape(-1), logits)
    planes, away = _SurfaceFit.apply(*flat, shape[2], layout, fit)
    coefficients = planes.view(*shape[:2], fit.size + 1, -1)[..., : layout.used].transpose(2, 3)
    return coefficients, away.view(*shape, -1)[..., : layout.used] if fit.deviations else None


def fit_reduced_reference(
    activation: Tensor, linear: tuple[Tensor, Tensor], relative: Tensor | None, times: Tensor, logits: Tensor | None,
    fit: Fit,
) -> tuple[Tensor, Tensor | None]:  # fmt: skip
    """`fit_reduced` layer by layer."""
    features = torch.relu(torch.nn.functional.linear(activation, *linear))
    if relative is not None:
        padding = relative.new_zeros(*relative.shape[:-1], fit.size - 3)
        features = torch.cat([features, relative, padding], -1)
    grouped = features.view(*features.shape[:3], -1, fit.size)
    weights = None if logits is None else torch.sigmoid(logits)
    coefficients = fit_surface(grouped, times, weights, fit.solver, fit.guard)
    return coefficients, deviations(coefficients, grouped, times) if fit.deviations else None


def _fast(activation: Tensor, size: int) -> bool:
    plain = activation.dtype == torch.float32 and not (activation.requires_grad and torch.is_grad_enabled())
    return plain and size < KERNEL_SIZE and not is_reduced(activation) and chosen_backend(activation.device) == "numba"


@dataclass(frozen=True)
class _Layout:
    """Columns of the reduced features as the kernels want them: feature after feature, each over all groups, whose number
    is filled up to a multiple of _LANES. The group of coordinates, if any, follows the learned ones."""

    learned: int
    coordinates: bool
    size: int

    @property
    def used(self) -> int:
        return self.learned + self.coordinates

    @property
    def groups(self) -> int:
        return -(-self.used // _LANES) * _LANES

    @property
    def width(self) -> int:
        """Of a row of features."""
        return self.size * self.groups

    @property
    def entries(self) -> int:
        """Numbers a fit is made of: half the normal matrix, and the right side."""
        return (self.size + 1) * (self.size + 2) // 2 + self.size + 1

    def spread(self, rows: Tensor) -> Tensor:
        """Rows (L*d,...) of learned features, group after group, as (width,...); zeros elsewhere. Differentiable."""
        columns = torch.full((self.size, self.groups), len(rows))
        columns[:, : self.learned] = torch.arange(len(rows)).view(self.learned, self.size).t()
        return torch.cat([rows, rows.new_zeros(1, *rows.shape[1:])])[columns.view(-1)]

    @cached_property
    def floor(self) -> np.ndarray:
        """What a feature of each group is at least: ReLU's 0, or for coordinates anything."""
        floor = np.zeros(self.groups, np.float32)
        floor[self.learned : self.used] = np.finfo(np.float32).min
        return floor

    @cached_property
    def places(self) -> np.ndarray:
        """Where a fit's normal matrix (d+1,d+1) and right side (d+1) stand among its entries: (d+1,d+2) i64."""
        size = self.size
        starts = np.cumsum([0, *(a + 3 for a in range(size))])  # a's products with 0..a, with 1, with the time
        places = np.empty((size + 1, size + 2), np.int64)
        for a in range(size + 1):
            for b in range(a):
                places[a, b] = places[b, a] = starts[a] + b if a < size else starts[b] + b + 1
            places[a, a] = starts[a] + (a if a < size else 0)
            places[a, -1] = starts[a] + (a + 2 if a < size else 1)
        return places


class _Room:
    """What a thread needs for its piece."""

    def __init__(self, case: _Case) -> None:
        layout, centroids = case.layout, case.step
        rows, planes = centroids * case.neighbors, centroids * (layout.size + 1) * layout.groups
        self.features, self.grad = torch.empty(rows, layout.width), torch.empty(rows, layout.width)
        self.weights = np.empty(rows * layout.groups, np.float32)
        self.moments = np.empty(centroids * layout.entries * layout.groups, np.float32)
        self.to_planes, self.to_right = np.empty(planes, np.float32), np.empty(planes, np.float32)
        self.to_matrix = np.empty(planes * (layout.size + 1), np.float32)
        self.ones = torch.ones(1, rows)


class _Case:
    """A call's inputs, and what forward and backward do alike with a piece of them."""

    def __init__(self, tensors: tuple[Tensor | None, ...], neighbors: int, layout: _Layout, fit: Fit) -> None:
        from dpcli.ops import kernels_linalg, kernels_surface

        self.rows_kernels, self.solve_kernels = kernels_surface, kernels_linalg
        self.neighbors, self.layout, self.rule = neighbors, layout, solve_rule(fit.solver, fit.guard)
        self.activation, weight, bias, near, times, logits = tensors
        self.weight, self.bias = weight.t(), bias.numpy()
        self.times = times.contiguous().numpy()
        self.near, self.logits = (_NOTHING if part is None else _flat(part) for part in (near, logits))
        self.count = len(self.times) // neighbors
        self.step = max(1, min(self.count, _PIECE // (4 * neighbors * layout.width)))
        self.sizes = (layout.size, layout.groups, neighbors)

    def rows(self, low: int, high: int) -> slice:
        """The rows of centroids low..high-1."""
        return slice(low * self.neighbors, high * self.neighbors)

    def begin(self, low: int, high: int, room: _Room) -> tuple[np.ndarray, np.ndarray]:
        """A piece's activated features and its fits' moments, flat; weights go into the room."""
        rows, groups = self.rows(low, high), self.layout.groups
        features = torch.mm(self.activation[rows], self.weight, out=room.features[: rows.stop - rows.start])
        features, moments = _flat(features), room.moments[: (high - low) * self.layout.entries * groups]
        self.rows_kernels.fit_rows(
            features, self.bias, self.layout.floor, _cut(self.near, rows, 3), self.layout.learned, self.times[rows],
            _cut(self.logits, rows, groups), room.weights, moments, *self.sizes,
        )  # fmt: skip
        return features, moments

    def planes(self, moments: np.ndarray, out: np.ndarray) -> None:
        self.solve_kernels.solve_planes(moments, self.layout.places, self.layout.groups, *self.rule, out)

    def planes_back(self, moments: np.ndarray, grad: np.ndarray, room: _Room) -> tuple[np.ndarray, np.ndarray]:
        """The gradients at the normal matrices, made symmetric, and at the right sides."""
        found = room.to_matrix[: len(grad) * (self.layout.size + 1)], room.to_right[: len(grad)]
        self.solve_kernels.solve_planes_back(
            moments, self.layout.places, self.layout.groups, *self.rule, grad, *found
        )
        return found


def _flat(tensor: Tensor) -> np.ndarray:
    return tensor.contiguous().numpy().reshape(-1)


def _cut(flat: np.ndarray, rows: slice, width: int) -> np.ndarray:
    """Some rows of a flat array; nothing of nothing."""
    return flat[rows.start * width : rows.stop * width]


class _SurfaceFit(torch.autograd.Function):
    """activation (R,C), weight (width,C), bias (width), near (R,3), times (R), logits (R,groups) -> planes (M,d+1,groups)
    and deviations (R,groups), or (0)."""

    @staticmethod
    def forward(ctx, activation, weight, bias, near, times, logits, neighbors, layout, fit):
        tensors = tuple(None if one is None else one.detach() for one in (activation, weight, bias, near, times, logits))
        case = _Case(tensors, neighbors, layout, fit)
        planes = torch.empty(case.count, layout.size + 1, layout.groups)
        away = torch.empty(len(times) if fit.deviations else 0, layout.groups)
        out = _flat(away)

        def work(_: int, piece: tuple[int, int], room: _Room) -> None:
            features, moments = case.begin(*piece, room)
            found = _flat(planes[slice(*piece)])
            case.planes(moments, found)
            if fit.deviations:
                rows = case.rows(*piece)
                case.rows_kernels.deviation_rows(
                    features, case.times[rows], found, _cut(out, rows, layout.groups), *case.sizes
                )

        share_tasks(steps(0, case.count, case.step), lambda: _Room(case), work)
        ctx.save_for_backward(*tensors, planes)
        ctx.rest = (neighbors, layout, fit)
        return planes, away

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_planes, grad_away):
        *tensors, planes = ctx.saved_tensors
        case, layout = _Case(tuple(tensors), *ctx.rest), ctx.rest[1]
        to_planes = _flat(grad_planes)
        to_away = _flat(grad_away) if grad_away is not None else _NOTHING
        to_logits = None if tensors[5] is None else torch.empty_like(tensors[5])
        logits = _NOTHING if to_logits is None else _flat(to_logits)
        tasks = ranges(case.count, TASKS)
        sums = [(torch.zeros_like(tensors[1]), torch.zeros(1, layout.width)) for _ in tasks]

        def work(number: int, task: tuple[int, int], room: _Room) -> None:
            for low, high in steps(*task, case.step):
                rows = case.rows(low, high)
                features, moments = case.begin(low, high, room)
                plane = slice(low * (layout.size + 1) * layout.groups, high * (layout.size + 1) * layout.groups)
                away, to_plane = _cut(to_away, rows, layout.groups), to_planes[plane]
                if len(away):
                    part = room.to_planes[: len(to_plane)]
                    case.rows_kernels.deviation_back(features, away, part, *case.sizes)
                    part += to_plane
                    to_plane = part
                to_features = room.grad[: rows.stop - rows.start]
                case.rows_kernels.fit_back(
                    features, room.weights if len(logits) else _NOTHING, case.times[rows], _flat(planes)[plane], away,
                    *case.planes_back(moments, to_plane, room), _flat(to_features), _cut(logits, rows, layout.groups),
                    *case.sizes,
                )  # fmt: skip
                to_weight, to_bias = sums[number]
                torch.addmm(to_weight, to_features.t(), case.activation[rows], out=to_weight)
                torch.addmm(to_bias, room.ones[:, : len(to_features)], to_features, out=to_bias)

        share_tasks(tasks, lambda: _Room(case), work)
        to_weight, to_bias = (torch.stack(parts).sum(0) for parts in zip(*sums))
        return None, to_weight, to_bias[0], None, None, to_logits, None, None, None
