"""Kinematic units in pieces give the reference's planes, deviations and gradients, to float32's rounding."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dpcli.classify.network import st_surface
from dpcli.classify.network import st_surface_cpu as module
from dpcli.classify.network.backbones.interface import Grouping
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network.st_surface import surface_normal
from dpcli.classify.network.st_surface_cpu import Fit, _Layout, fit_reduced, fit_reduced_reference
from dpcli.ops.cpu.small_inverses import solve_planes, solve_planes_back
from dpcli.ops.small_inverses import GUARDS, correct_guarded_gradients, small_inverse


def unit(size, learned, coordinates, weighted, dtype, neighbors=24, dead=False):
    """Inputs of a unit: 2 clouds, 37 centroids, 24 channels; random directions for the gradients of both outputs."""
    g = torch.Generator().manual_seed(size + 10 * learned)
    rand = lambda *shape: torch.randn(*shape, generator=g, dtype=torch.float64).to(dtype)  # noqa: E731
    groups, rows = learned + coordinates, (2, 37, neighbors)
    activation = rand(*rows, 24).relu()
    weight, bias = rand(learned * size, 24) * 0.3, rand(learned * size) * 0.3
    if dead:  # one feature of the first group, and all of the second
        bias[[0, *range(size, 2 * size)]] = -100.0
    relative = rand(*rows, 3) if coordinates else None
    times = torch.randint(-1, 2, rows, generator=g).to(dtype)
    logits = rand(*rows, groups).requires_grad_() if weighted else None
    along = rand(2, 37, groups, size + 1), rand(*rows, groups)
    return (activation, (weight.requires_grad_(), bias.requires_grad_()), relative, times, logits), along


def outputs(function, case, fit):
    """Planes, deviations if any, and the gradients of weight, bias and logits."""
    arguments, along = case
    planes, away = function(*arguments, fit)
    total = (planes * along[0]).sum() + (0 if away is None else (away * along[1]).sum())
    leaves = [*arguments[1], *([] if arguments[4] is None else [arguments[4]])]
    return [planes.detach(), *([] if away is None else [away.detach()]), *torch.autograd.grad(total, leaves)]


def compare(size, learned, coordinates, weighted, fit):
    """As near to float64 as the reference in float32 is: nearly singular fits, which `inverse` has, lose digits in both."""
    case = (size, learned, coordinates, weighted)
    ours, plain = (outputs(f, unit(*case, torch.float32), fit) for f in (fit_reduced, fit_reduced_reference))
    exact = outputs(fit_reduced_reference, unit(*case, torch.float64), fit)
    assert len(ours) == len(exact)
    for number, (a, b, c) in enumerate(zip(ours, plain, exact)):
        assert c.abs().max() > 1e-3, "a zero would pass any tolerance"
        error, usual = (a.double() - c).abs(), (b.double() - c).abs()
        assert error.median() < 1e-5 * c.abs().median(), f"output {number}"  # measured 4e-6
        nearly_all = int(0.99 * (error.numel() - 1)) + 1
        error, usual = (part.flatten().kthvalue(nearly_all).values for part in (error, usual))
        assert error < 3 * usual + 3e-6 * c.abs().max(), f"output {number}"


CASES = [
    (4, 8, False, False, "ridge"),
    (3, 10, True, True, "ridge"),
    (4, 5, True, True, "ridge"),
    (1, 9, False, True, "ridge"),
    (4, 16, False, True, "inverse"),
    (2, 9, False, True, "inverse"),
    (3, 7, True, False, "inverse"),
    (6, 3, True, True, "ridge"),
]


@pytest.mark.parametrize("deviations", [True, False])
@pytest.mark.parametrize("size, learned, coordinates, weighted, solver", CASES)
def test_pieces_give_the_reference(size, learned, coordinates, weighted, solver, deviations, monkeypatch):
    monkeypatch.setattr(module, "_PIECE", 1 << 14)  # several pieces a task, the last not full
    compare(size, learned, coordinates, weighted, Fit(size, solver, deviations=deviations))


def repeated(size, distinct, dtype, twin):
    """Normals and a weight's gradient of fits whose 32 neighbors are `distinct` points again and again."""
    g = torch.Generator().manual_seed(10 * size + distinct)
    pick = torch.arange(32) % distinct
    activation = torch.rand(1, 500, distinct, size, generator=g)[:, :, pick].to(dtype)
    times = torch.randint(-1, 2, (1, 500, distinct), generator=g)[:, :, pick].to(dtype)
    logits = torch.randn(1, 500, 32, 1, generator=g).to(dtype)
    weight = torch.eye(size, dtype=dtype).requires_grad_()
    planes, _ = twin(activation, (weight, torch.zeros(size, dtype=dtype)), None, times, logits, Fit(size, "ridge"))
    normals = surface_normal(planes)
    return normals.detach().double(), torch.autograd.grad(normals[..., 0].sum(), weight)[0].double()


@pytest.mark.parametrize("twin", [fit_reduced, fit_reduced_reference])
def test_no_clouds_give_no_surfaces(twin):
    (activation, linear, relative, times, logits), _ = unit(4, 5, True, True, torch.float32)
    planes, away = twin(activation[:0], linear, relative[:0], times[:0], logits[:0], Fit(4, "ridge"))
    assert planes.shape == (0, 37, 6, 5) and away.shape == (0, 37, 24, 6)


def check_repeated(size, distinct, twin):
    exact, exact_gradient = repeated(size, distinct, torch.float64, fit_reduced_reference)
    normals, gradient = repeated(size, distinct, torch.float32, twin)
    assert (normals - exact).norm(dim=-1).max() < 2e-3
    assert (gradient - exact_gradient).abs().max() < 1e-2 * exact_gradient.abs().max()


@pytest.mark.parametrize("twin", [fit_reduced, fit_reduced_reference])
@pytest.mark.parametrize("distinct", [1, 2, 3])
@pytest.mark.parametrize("size", [1, 3, 4, 7])
def test_a_ridge_is_right_where_neighbors_repeat(size, distinct, twin):
    """Rank-deficient fits, as sparse clouds have them: the ridge alone holds the determinant, at 1e-3 to the power of the rank missing."""
    check_repeated(size, distinct, twin)


def test_an_inverse_by_the_determinant_is_not(monkeypatch):
    monkeypatch.setattr(
        st_surface, "small_solve", lambda m, r: (small_inverse(m, guard="none") * r[..., None, :]).sum(-1)
    )
    with pytest.raises(AssertionError):
        check_repeated(4, 1, fit_reduced_reference)


@pytest.mark.parametrize("broken", ["floor", "places", "weights"])
def test_a_wrong_twin_is_noticed(broken, monkeypatch):
    if broken == "floor":  # the coordinates lose their negative half
        monkeypatch.setattr(_Layout, "floor", property(lambda self: np.zeros(self.groups, np.float32)))
    elif broken == "places":
        right = _Layout.places.func
        monkeypatch.setattr(_Layout, "places", property(lambda self: right(self)[:, ::-1].copy()))
    else:
        monkeypatch.setattr(module, "_cut", lambda flat, rows, width: flat[: (rows.stop - rows.start) * width])
        monkeypatch.setattr(module, "_PIECE", 1 << 14)
    with pytest.raises(AssertionError):
        compare(3, 10, True, True, Fit(3, "ridge"))


def test_sums_repeat_on_any_number_of_threads(monkeypatch):
    monkeypatch.setattr(module, "_PIECE", 1 << 13)
    results = []
    for count in (1, 2, 3):
        monkeypatch.setattr(torch, "get_num_threads", lambda count=count: count)
        results.append(outputs(fit_reduced, unit(4, 12, False, True, torch.float32), Fit(4, "ridge")))
    for one, two, three in zip(*results):
        assert torch.equal(one, two) and torch.equal(one, three)


@pytest.mark.parametrize("solver, guard", [("inverse", "signed"), ("inverse", "release"), ("ridge", "signed")])
def test_dead_features_are_as_the_reference_has_them(solver, guard):
    """A group without a live feature gives the normal of no slope, and sends nothing back."""
    fit = Fit(4, solver, guard)
    case = unit(4, 6, False, True, torch.float32, dead=True)
    ours, theirs = outputs(fit_reduced, case, fit), outputs(fit_reduced_reference, case, fit)
    assert (ours[0][:, :, 1, :4] == 0).all() and (theirs[0][:, :, 1, :4] == 0).all()
    for value in ours:
        assert torch.isfinite(value).all()
    for a, b in zip((ours[0][:, :, 2:], ours[2][8:], ours[3][8:]), (theirs[0][:, :, 2:], theirs[2][8:], theirs[3][8:])):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4 * float(b.abs().max()))
    assert (ours[2][4:8] == 0).all() and (ours[2][0] == 0).all()


@pytest.mark.parametrize("where", ["activation", "logits"])
def test_nan_is_not_hidden(where):
    """A loss that runs away must be seen, not rounded to a weight or a ReLU's zero."""
    arguments, _ = unit(4, 8, False, True, torch.float32)
    with torch.no_grad():
        (arguments[0] if where == "activation" else arguments[4])[1, 5, 3] = float("nan")
    planes, away = fit_reduced(*arguments, Fit(4, "ridge"))
    assert planes[1, 5].isnan().all() and away[1, 5].isnan().any()
    assert planes[0].isfinite().all() and planes[1, :5].isfinite().all() and planes[1, 6:].isfinite().all()


@pytest.mark.parametrize("guard", ["signed", "release"])
@pytest.mark.parametrize("least", [1e-6, 1.0, 1e3])
@pytest.mark.parametrize("size", range(1, 8))
def test_guarded_solutions_and_gradients_against_autograd(size, least, guard):
    """With least determinants that act nowhere, here and there, and everywhere; in one block and in two."""
    n, count, groups, layout = size + 1, 5, 8, _Layout(8, False, size)
    g = torch.Generator().manual_seed(size)
    design = torch.randn(count, groups, 12, n, generator=g)
    design[..., -1] = 1
    matrix = (0.1 * design).transpose(-1, -2) @ design
    right, grad = torch.randn(count, groups, n, generator=g), torch.randn(count, groups, n, generator=g)
    grad[0], grad[1, :, :-1] = 0, 0  # planes that nothing depends on, and such whose last coefficient alone counts
    moments = np.zeros((count, layout.entries, groups), np.float32)
    for i in range(n):
        moments[:, layout.places[i, n]] = right[..., i]
        for j in range(n):
            moments[:, layout.places[i, j]] = matrix[..., i, j]
    rule, flat = (layout.places, groups, 0.0, least, GUARDS.index(guard)), moments.reshape(-1)
    planes = np.empty((count, n, groups), np.float32)
    solve_planes(flat, *rule, planes.reshape(-1))
    leaves = matrix.double().requires_grad_(), right.double().requires_grad_()
    expected = (small_inverse(leaves[0], min_det=least, guard=guard) * leaves[1][..., None, :]).sum(-1)
    torch.testing.assert_close(
        torch.from_numpy(planes).transpose(1, 2).double(), expected.detach(), rtol=1e-4, atol=1e-5
    )
    to_matrix, to_right = np.empty((count, n, n, groups), np.float32), np.empty((count, n, groups), np.float32)
    given = grad.transpose(1, 2).contiguous().numpy().reshape(-1)
    moved = np.empty((count, groups), np.bool_)
    solve_planes_back(flat, *rule, given, to_matrix.reshape(-1), to_right.reshape(-1), moved.reshape(-1))
    correct_guarded_gradients(
        moments, layout.places, planes, (least, guard), given.reshape(count, n, groups), to_matrix, moved
    )
    wanted = torch.autograd.grad((expected * grad).sum(), leaves)
    wanted = wanted[0] + wanted[0].transpose(-1, -2), wanted[1]
    found = (
        torch.from_numpy(to_matrix).permute(0, 3, 1, 2).double(),
        torch.from_numpy(to_right).transpose(1, 2).double(),
    )
    for a, b in zip(found, wanted):
        assert (a - b).abs().max() < 2e-4 * b.abs().max() + 1e-12


def test_an_activation_that_wants_a_gradient_gets_it(monkeypatch):
    """Explanations ask for one; the kernels have none, so the reference runs."""
    (activation, *others), _ = unit(4, 8, False, True, torch.float32)
    monkeypatch.setattr(module._SurfaceFit, "apply", lambda *a: pytest.fail("the pieces ran"))
    planes, _ = fit_reduced(activation.requires_grad_(), *others, Fit(4))
    assert torch.autograd.grad(planes.sum(), activation)[0].abs().max() > 0


@pytest.mark.parametrize("variant", ["thesis", "release"])
def test_a_whole_network_is_the_same_without_the_kernels(variant, monkeypatch):
    """To the rounding of the plain network, which is more in `release`: it counts time from the clip's start."""
    sizes = {
        "num_classes": 4,
        "num_frames": 4,
        "points_per_frame": 64,
        "centroids": (48, 24),
        "neighbors": 12,
        "widths": ((16, 24), (24, 32), (32, 64)),
        "solver": "ridge",
    }
    config = KinetConfig.release(**sizes) if variant == "release" else KinetConfig(**sizes)
    torch.manual_seed(0)
    model = Kinet(config).eval()
    points = torch.randn(3, 4, 64, 3) * 0.4
    with torch.inference_mode():
        ours = model(points)
    monkeypatch.setenv("DPC_BACKEND", "torch")
    with torch.no_grad():
        plain, stages = model(points), model.group(points)
        stages = [
            Grouping(
                *(part if part is None or part.dtype == torch.long else part.double() for part in vars(g).values())
            )
            for g in stages
        ]
        taps, static = model.double().static.taps(stages)
        exact = static, model.dynamic(taps)
    for a, b, c in zip(ours, plain, exact):
        error, usual = (a - c).abs(), (b - c).abs()
        assert error.median() < 5 * usual.median() + 1e-6 and error.max() < 0.02 * c.abs().max()
