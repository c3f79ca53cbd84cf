"""The core of a kinematic unit: reduce a neighborhood's features, group them, and fit a weighted plane to each group.

`fit_reduced` has a plain torch form (the reference, and the path on a GPU) and a CPU form that goes through the centroids
in pieces that stay in the cache, from the features to the deviations. Both give the same numbers; tests compare them in
value and gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from dpcli.classify.network.st_surface import deviations, fit_surface, solve_rule
from dpcli.ops.backend import chosen_backend
from dpcli.ops.cpu.cache_blocks import TASKS, ranges, share_tasks, steps
from dpcli.ops.small_inverses import GUARDS, KERNEL_SIZE, correct_guarded_gradients
from dpcli.runtime.mixed_precision import is_reduced

_PIECE = 1 << 20  # bytes of reduced features
_LANES = 8  # groups that the kernels take together
_NOTHING = np.empty(0, np.float32)


@dataclass(frozen=True)
class Fit:
    """Says how planes are fitted: groups of `size` features, and `fit_surface`'s solver and guard."""

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
    """Fits planes A f + b = t through K groups of d features f of each centroid's n neighbors (thesis eq. 3.5, 3.6).

    f = relu(W a + b') of the activation a, in L groups; with `relative` one more, the neighbor's coordinates (and zeros,
    where d > 3). A neighbor weighs sigmoid(logits), or 1. Returns the coefficients [A, b] (B,M,K,d+1) and the deviations
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
    coefficients = planes.view(*shape[:2], fit.size + 1, layout.groups)[..., : layout.used].transpose(2, 3)
    return coefficients, away.view(*shape, layout.groups)[..., : layout.used] if fit.deviations else None


def fit_reduced_reference(
    activation: Tensor,
    linear: tuple[Tensor, Tensor],
    relative: Tensor | None,
    times: Tensor,
    logits: Tensor | None,
    fit: Fit,
) -> tuple[Tensor, Tensor | None]:
    """Computes `fit_reduced` layer by layer."""
    features = torch.relu(torch.nn.functional.linear(activation, *linear))
    if relative is not None:
        padding = relative.new_zeros(*relative.shape[:-1], fit.size - 3)
        features = torch.cat([features, relative, padding], -1)
    grouped = features.view(*features.shape[:3], features.shape[3] // fit.size, fit.size)
    weights = None if logits is None else torch.sigmoid(logits)
    coefficients = fit_surface(grouped, times, weights, fit.solver, fit.guard)
    return coefficients, deviations(coefficients, grouped, times) if fit.deviations else None


def _fast(activation: Tensor, size: int) -> bool:
    plain = activation.dtype == torch.float32 and not (activation.requires_grad and torch.is_grad_enabled())
    return plain and size < KERNEL_SIZE and not is_reduced(activation) and chosen_backend(activation.device) == "numba"


@dataclass(frozen=True)
class _Layout:
    """Describes the columns of the reduced features as the kernels want them.

    They go feature after feature, each over all groups, whose number is filled up to a multiple of _LANES. The group of
    coordinates, if any, follows the learned ones.
    """

    learned: int
    coordinates: bool
    size: int

    @property
    def used(self) -> int:
        """Returns the number of groups that hold something."""
        return self.learned + self.coordinates

    @property
    def groups(self) -> int:
        """Returns the number of groups, those included that only fill up."""
        return -(-self.used // _LANES) * _LANES

    @property
    def width(self) -> int:
        """Returns the number of columns of a row of features."""
        return self.size * self.groups

    @property
    def entries(self) -> int:
        """Returns how many numbers a fit is made of: half the normal matrix, and the right side."""
        return (self.size + 1) * (self.size + 2) // 2 + self.size + 1

    def spread(self, rows: Tensor) -> Tensor:
        """Returns rows (L*d,...) of learned features, group after group, as (width,...); zeros elsewhere. Differentiable."""
        columns = torch.full((self.size, self.groups), len(rows))
        columns[:, : self.learned] = torch.arange(len(rows)).view(self.learned, self.size).t()
        return torch.cat([rows, rows.new_zeros(1, *rows.shape[1:])])[columns.view(-1)]

    @cached_property
    def floor(self) -> np.ndarray:
        """Returns the least value that a feature of each group may have: ReLU's 0, or for coordinates any."""
        floor = np.zeros(self.groups, np.float32)
        floor[self.learned : self.used] = np.finfo(np.float32).min
        return floor

    @cached_property
    def places(self) -> np.ndarray:
        """Returns the places where a fit's normal matrix (d+1,d+1) and right side (d+1) stand among its entries: (d+1,d+2) i64."""
        size = self.size
        starts = np.cumsum([0, *(a + 3 for a in range(size))])  # a's products with 0..a, with 1, with the time
        places = np.empty((size + 1, size + 2), np.int64)
        for a in range(size + 1):
            for b in range(a):
                places[a, b] = places[b, a] = starts[a] + b if a < size else starts[b] + b + 1
            places[a, a] = starts[a] + (a if a < size else 0)
            places[a, -1] = starts[a] + (a + 2 if a < size else 1)
        return places


class _Case:
    """Holds a call's inputs and sizes, and what is made of the inputs on the way to the planes."""

    def __init__(self, tensors: tuple[Tensor | None, ...], neighbors: int, layout: _Layout, fit: Fit) -> None:
        from dpcli.ops.cpu import small_inverses, surface_fit

        self.row_kernels, self.solve_kernels = surface_fit, small_inverses
        self.neighbors, self.layout = neighbors, layout
        self.rule = (layout.places, layout.groups, *solve_rule(fit.solver, fit.guard))
        self.activation, weight, bias, near, times, logits = tensors
        self.weight, self.bias = weight.t(), bias.numpy()
        self.times = times.contiguous().numpy()
        self.near, self.logits = (_NOTHING if part is None else _flat(part) for part in (near, logits))
        self.count = len(self.times) // neighbors
        self.step = max(1, min(self.count, _PIECE // (4 * neighbors * layout.width)))
        self.sizes = (layout.size, layout.groups, neighbors)

    def rows(self, low: int, high: int) -> slice:
        """Returns the rows of centroids low..high-1."""
        return slice(low * self.neighbors, high * self.neighbors)

    def made(self, centroids: int) -> tuple[Tensor, Tensor, Tensor]:
        """Returns buffers for the features, weights and moments of so many centroids."""
        rows, groups = centroids * self.neighbors, self.layout.groups
        weights = torch.empty(rows if len(self.logits) else 0, groups)
        return torch.empty(rows, self.layout.width), weights, torch.empty(centroids, self.layout.entries, groups)

    def parts(self, made: tuple[Tensor, Tensor, Tensor], low: int, high: int) -> tuple[Tensor, Tensor, Tensor]:
        """Returns what was made of centroids low..high-1."""
        features, weights, moments = made
        rows = self.rows(low, high)
        return features[rows], weights[rows], moments[low:high]

    def begin(self, low: int, high: int, made: tuple[Tensor, Tensor, Tensor]) -> None:
        """Writes the activated features, weights and moments of a piece into its part of `made`."""
        rows, groups = self.rows(low, high), self.layout.groups
        torch.mm(self.activation[rows], self.weight, out=made[0])
        features, weights, moments = map(_flat, made)
        self.row_kernels.fit_rows(
            features,
            self.bias,
            self.layout.floor,
            _cut(self.near, rows, 3),
            self.layout.learned,
            self.times[rows],
            _cut(self.logits, rows, groups),
            weights,
            moments,
            *self.sizes,
        )

    def correct(
        self, moment: np.ndarray, plane: np.ndarray, to_plane: np.ndarray, to_matrix: np.ndarray, moved: np.ndarray
    ) -> None:
        """Sets the gradients of the fits of a piece whose determinant the guard moved."""
        groups, size = self.layout.groups, self.layout.size + 1
        correct_guarded_gradients(
            moment.reshape(-1, self.layout.entries, groups),
            self.layout.places,
            plane.reshape(-1, size, groups),
            (self.rule[3], GUARDS[self.rule[4]]),
            to_plane.reshape(-1, size, groups),
            to_matrix.reshape(-1, size, size, groups),
            moved.reshape(-1, groups),
        )


def _flat(tensor: Tensor) -> np.ndarray:
    return tensor.contiguous().numpy().reshape(-1)


def _cut(flat: np.ndarray, rows: slice, width: int) -> np.ndarray:
    """Returns some rows of a flat array; nothing of nothing."""
    return flat[rows.start * width : rows.stop * width]


class _SurfaceFit(torch.autograd.Function):
    """Maps activation (R,C), weight (width,C), bias (width), near (R,3), times (R), logits (R,groups) -> planes (M,d+1,groups)
    and deviations (R,groups), or (0)."""

    @staticmethod
    def forward(ctx, activation, weight, bias, near, times, logits, neighbors, layout, fit):
        tensors = tuple(
            None if one is None else one.detach() for one in (activation, weight, bias, near, times, logits)
        )
        case = _Case(tensors, neighbors, layout, fit)
        planes = torch.empty(case.count, layout.size + 1, layout.groups)
        away = torch.empty(len(times) if fit.deviations else 0, layout.groups)
        out = _flat(away)
        kept = case.made(case.count) if any(ctx.needs_input_grad) else None

        def work(_: int, piece: tuple[int, int], room: tuple[Tensor, Tensor, Tensor] | None) -> None:
            """Goes through a piece of the centroids in a thread."""
            made = case.parts(room or kept, *((0, piece[1] - piece[0]) if room else piece))
            case.begin(*piece, made)
            found, rows = _flat(planes[slice(*piece)]), case.rows(*piece)
            case.solve_kernels.solve_planes(_flat(made[2]), *case.rule, found)
            if fit.deviations:
                case.row_kernels.deviation_rows(
                    _flat(made[0]), case.times[rows], found, _cut(out, rows, layout.groups), *case.sizes
                )

        share_tasks(steps(0, case.count, case.step), lambda: None if kept else case.made(case.step), work)
        if kept:
            ctx.save_for_backward(*tensors, planes, *kept)
            ctx.rest = (neighbors, layout, fit)
        return planes, away

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_planes, grad_away):
        *tensors, planes, features, weights, moments = ctx.saved_tensors
        case, layout, made = _Case(tuple(tensors), *ctx.rest), ctx.rest[1], (features, weights, moments)
        to_planes, to_away = _flat(grad_planes), _NOTHING if grad_away is None else _flat(grad_away)
        to_logits = None if tensors[5] is None else torch.empty_like(tensors[5])
        logits = _NOTHING if to_logits is None else _flat(to_logits)
        tasks = ranges(case.count, TASKS)
        sums = [(torch.zeros_like(tensors[1]), torch.zeros(1, layout.width)) for _ in tasks]

        def work(number: int, task: tuple[int, int], room: _Gradients) -> None:
            """Goes through a piece of the centroids in a thread."""
            to_weight, to_bias = sums[number]
            for low, high in steps(*task, case.step):
                rows, (some, weight, moment) = case.rows(low, high), map(_flat, case.parts(made, low, high))
                plane = slice(*(end * (layout.size + 1) * layout.groups for end in (low, high)))
                away = _cut(to_away, rows, layout.groups)
                to_plane, to_matrix, to_right, moved = room.of_fits(high - low)
                to_plane[:] = to_planes[plane]
                if len(away):
                    case.row_kernels.deviation_back(some, away, to_plane, *case.sizes)
                case.solve_kernels.solve_planes_back(moment, *case.rule, to_plane, to_matrix, to_right, moved)
                case.correct(moment, _flat(planes)[plane], to_plane, to_matrix, moved)
                to_features = room.features[: rows.stop - rows.start]
                case.row_kernels.fit_back(
                    some,
                    weight,
                    case.times[rows],
                    _flat(planes)[plane],
                    away,
                    to_matrix,
                    to_right,
                    _flat(to_features),
                    _cut(logits, rows, layout.groups),
                    *case.sizes,
                )
                torch.addmm(to_weight, to_features.t(), case.activation[rows], out=to_weight)
                torch.addmm(to_bias, room.ones[:, : len(to_features)], to_features, out=to_bias)

        share_tasks(tasks, lambda: _Gradients(case), work)
        to_weight, to_bias = (torch.stack(parts).sum(0) for parts in zip(*sums))
        return None, to_weight, to_bias[0], None, None, to_logits, None, None, None


class _Gradients:
    """Holds the gradients of a thread's piece."""

    def __init__(self, case: _Case) -> None:
        rows, self.size = case.step * case.neighbors, (case.layout.size + 1) * case.layout.groups
        self.features, self.ones = torch.empty(rows, case.layout.width), torch.ones(1, rows)
        self.planes, self.right = (np.empty(case.step * self.size, np.float32) for _ in range(2))
        self.matrix = np.empty(case.step * self.size * (case.layout.size + 1), np.float32)
        self.moved, self.groups = np.empty(case.step * case.layout.groups, np.bool_), case.layout.groups

    def of_fits(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Returns buffers for the gradients of so many centroids' planes, normal matrices and right sides, and for which of
        their determinants a guard moved."""
        numbers = count * self.size
        return (
            self.planes[:numbers],
            self.matrix[: numbers * len(self.matrix) // len(self.planes)],
            self.right[:numbers],
            self.moved[: count * self.groups],
        )
