"""The rasterizer: its definition, every kind of scene on both backends, modes, cameras, bad input."""

from __future__ import annotations

import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dpcli.ops.rotations import normalize_quaternion, quaternion_to_matrix
from dpcli.ops.splatting import rasterization as splatting
from dpcli.ops.splatting import torch_reference as splatting_torch
from dpcli.ops.splatting.rasterization import rasterization, rasterization_reference
from dpcli.ops.splatting.torch_reference import sh_basis
from tests.support.ops_helpers import BACKENDS, backend
from tests.support.splatting_helpers import assert_renders, brute_force, cameras, render, scene, straight

KINDS = ("mixed", "opaque", "behind", "ties", "faint", "large")
FRONT = torch.eye(4)[None]


def one(opacity: float = 0.6, scale: float = 0.1, depth: float = 2.0, color=(1.0, 0.5, 0.25)) -> list[torch.Tensor]:
    """One round Gaussian straight ahead."""
    return [
        torch.tensor([[0, 0, depth]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), scale),
        torch.tensor([opacity]),
        torch.tensor([color]),
    ]


def lens(size: int = 9, focal: float = 20.0) -> torch.Tensor:
    return torch.tensor([[[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]]])


@pytest.mark.parametrize("name", BACKENDS)
def test_one_gaussian_by_hand(name: str) -> None:
    with backend(name):
        colors, alphas, notes = rasterization(*one(), FRONT, lens(), 9, 9)
    variance = (20 * 0.1 / 2) ** 2 + 0.3  # at the axis the Jacobian is focal / depth
    for row, column in ((4, 4), (4, 5), (2, 3), (4, 7), (0, 0)):
        alpha = 0.6 * math.exp(-((row - 4) ** 2 + (column - 4) ** 2) / (2 * variance))
        alpha = alpha if alpha >= 1 / 255 else 0.0
        assert float(alphas[0, row, column, 0]) == pytest.approx(alpha, abs=1e-6)
        assert colors[0, row, column].tolist() == pytest.approx([alpha, 0.5 * alpha, 0.25 * alpha], abs=1e-6)
    assert float(alphas[0, 0, 0, 0]) == 0 and float(alphas[0, 4, 7, 0]) > 0
    assert notes["means2d"].tolist() == [[[4.5, 4.5]]] and notes["depths"].tolist() == [[2.0]]
    radius = math.ceil(math.sqrt(2 * math.log(255 * 0.6)) * math.sqrt(variance))
    assert notes["radii"].tolist() == [[[radius, radius]]]


@pytest.mark.parametrize("name", BACKENDS)
def test_opaque_is_capped_and_pixels_stop(name: str) -> None:
    stack = [
        torch.cat([a, b, c, d])
        for a, b, c, d in zip(
            one(1.0, depth=2.0, color=(1.0, 0, 0)),
            one(0.5, depth=1.0, color=(0, 1.0, 0)),
            one(1.0, depth=3.0, color=(0, 0, 1.0)),
            one(1.0, depth=4.0, color=(1.0, 1.0, 1.0)),
            strict=True,
        )
    ]
    with backend(name):
        colors, alphas, _ = rasterization(*stack, FRONT, lens(), 9, 9)
    # 0.5, then 0.999 of the rest leaves 5e-4; 0.999 of that would leave 5e-7: the pixel stops before it
    assert colors[0, 4, 4].tolist() == pytest.approx([0.4995, 0.5, 0], abs=1e-6)
    assert float(alphas[0, 4, 4, 0]) == pytest.approx(0.9995, abs=1e-6)


@pytest.mark.parametrize("name", BACKENDS)
def test_equal_depths_keep_the_order_of_indices(name: str) -> None:
    red, green = one(0.8, color=(1.0, 0, 0)), one(0.8, color=(0, 1.0, 0))
    with backend(name):
        for first, second, winner in ((red, green, 0), (green, red, 1)):
            pair = [torch.cat(t) for t in zip(first, second, strict=True)]
            colors = rasterization(*pair, FRONT, lens(), 9, 9)[0][0, 4, 4]
            assert float(colors[winner]) == pytest.approx(0.8) and float(colors[1 - winner]) == pytest.approx(0.16)


@pytest.mark.parametrize("seed", range(4))
def test_reference_matches_written_out_loops(seed: int) -> None:
    tensors, (views, lenses) = scene(12, channels=2, seed=seed, scale=0.15), cameras(2, 13, 11)
    colors, alphas, _ = rasterization_reference(*tensors, views, lenses, 13, 11, tile_size=5)
    for camera in range(2):
        picture, cover = brute_force(tensors, views[camera], lenses[camera], 13, 11)
        np.testing.assert_allclose(colors[camera].numpy(), picture, atol=1e-7)
        np.testing.assert_allclose(alphas[camera, ..., 0].numpy(), cover, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("count", "size"), [(1, (7, 5)), (60, (33, 18)), (400, (48, 64))])
def test_kernel_matches_reference(kind: str, count: int, size: tuple[int, int]) -> None:
    """Pictures and gradients of means, quaternions, scales, opacities, colors and projected means."""
    views = straight if kind == "ties" else cameras
    assert_renders(rasterization, scene(count, kind, seed=count), views(2, *size), size)


@pytest.mark.parametrize("channels", [1, 3, 7])
@pytest.mark.parametrize("mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
def test_channels_and_modes(channels: int, mode: str) -> None:
    views, size = cameras(2, 24, 20), (24, 20)
    background = torch.rand(2, channels)
    tensors = scene(80, channels=channels)
    if mode in ("D", "ED"):  # colors play no part, so they have no gradient to compare
        colors, alphas, _ = rasterization(
            *(t.float() for t in tensors), *(v.float() for v in views), *size, backgrounds=background, render_mode=mode
        )
        want = rasterization_reference(*tensors, *views, *size, render_mode="RGB+" + mode)[0][..., -1:]
        assert colors.shape == (2, 20, 24, 1)
        assert ((colors - want).abs() > 1e-4).double().mean() < 2e-3
    else:
        assert_renders(rasterization, tensors, views, size, backgrounds=background, render_mode=mode)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spherical_harmonics(degree: int) -> None:
    tensors = scene(80)
    generator = torch.Generator().manual_seed(degree)
    tensors[4] = torch.randn(80, 16, 3, generator=generator).double() * 0.3
    assert_renders(rasterization, tensors, cameras(2, 24, 20), (24, 20), sh_degree=degree)
    shown = [t.float() for t in (*tensors, *cameras(2, 24, 20))]
    cut = [*shown[:4], shown[4][:, : (degree + 1) ** 2], *shown[5:]]
    a, b = (rasterization(*x, 24, 20, sh_degree=degree)[0] for x in (shown, cut))
    assert torch.equal(a, b)  # what lies beyond the degree plays no part


def test_harmonics_are_orthonormal_and_signed_as_in_3dgs() -> None:
    height, weights = np.polynomial.legendre.leggauss(8)
    angle = 2 * np.pi * np.arange(16) / 16
    z, a = (torch.from_numpy(x).ravel() for x in np.meshgrid(height, angle, indexing="ij"))
    flat = torch.sqrt(1 - z * z)
    basis = sh_basis(torch.stack([flat * torch.cos(a), flat * torch.sin(a), z], -1), 3)
    weight = torch.from_numpy(np.repeat(weights, 16)) * 2 * np.pi / 16
    assert torch.allclose((basis * weight[:, None]).T @ basis, torch.eye(16, dtype=torch.float64), atol=1e-12)
    first = sh_basis(torch.eye(3, dtype=torch.float64), 1)[:, 1:]
    assert (torch.sign(first) == -torch.eye(3)[:, [1, 2, 0]] * torch.tensor([1, -1, 1])).all()  # -y, z, -x


def test_each_camera_may_see_its_own_gaussians() -> None:
    """A batch over times equals pictures made one by one; shared inputs get the sum of the gradients."""
    (views, lenses), size = cameras(3, 20, 20), (20, 20)
    tensors = scene(50)
    moved = [torch.stack([tensors[i] + 0.05 * step for step in range(3)]) for i in (0, 1)]
    together = render(rasterization, [*moved, *tensors[2:]], (views, lenses), size, torch.float32)
    for option in (2, 3, 4):  # nor does it matter whether what is shared comes once or per camera
        spread = [*moved, *tensors[2:]]
        spread[option] = spread[option].expand(3, *spread[option].shape).contiguous()
        again = render(rasterization, spread, (views, lenses), size, torch.float32)
        assert torch.equal(again[0], together[0])
        name = ("means", "quats", "scales", "opacities", "colors")[option]
        torch.testing.assert_close(again[2][name].sum(0), together[2][name], rtol=1e-4, atol=1e-4)
    for c in range(3):
        alone = rasterization(
            *(t[c].float() for t in moved),
            *(t.float() for t in tensors[2:]),
            views[c : c + 1].float(),
            lenses[c : c + 1].float(),
            *size,
        )
        assert torch.equal(alone[0][0], together[0][c]) and torch.equal(alone[1][0], together[1][c])
    assert_renders(rasterization, [*moved, *tensors[2:]], (views, lenses), size)


def test_world_may_turn_and_quaternions_may_scale() -> None:
    (views, lenses), size, tensors = cameras(1, 32, 24), (32, 24), scene(100)
    means, quats, *rest = tensors
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3], turn[:3, 3] = (
        quaternion_to_matrix(normalize_quaternion(torch.tensor([0.3, -0.5, 0.7, 0.2]).double())),
        torch.tensor([3.0, -1.0, 2.0]),
    )
    w, u = torch.tensor([0.3]).double(), torch.tensor([-0.5, 0.7, 0.2]).double()
    product = [
        quats[:, :1] * w - (quats[:, 1:] * u).sum(-1, keepdim=True),
        w * quats[:, 1:] + quats[:, :1] * u + torch.linalg.cross(u.expand(100, 3), quats[:, 1:]),
    ]
    turned = [means @ turn[:3, :3].T + turn[:3, 3], -3 * torch.cat(product, -1), *rest]
    there = views @ torch.linalg.inv(turn)
    a, b = (rasterization_reference(*t, v, lenses, *size)[0] for t, v in ((tensors, views), (turned, there)))
    torch.testing.assert_close(a, b, rtol=0, atol=1e-9)
    torch.testing.assert_close(quaternion_to_matrix(torch.zeros(1, 4)), torch.eye(3)[None])


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("count", [0, 3])
def test_nothing_to_see(name: str, count: int) -> None:
    tensors = scene(count)
    tensors[0] = tensors[0] * 0 + torch.tensor([0, 0, -5.0])
    background = torch.tensor([[0.25, 0.5, 1.0]])
    leaves = [t.float().requires_grad_() for t in tensors]
    with backend(name):
        colors, alphas, notes = rasterization(*leaves, FRONT, lens(), 9, 9, backgrounds=background)
        (colors.sum() + alphas.sum()).backward()
    assert torch.equal(colors, background.expand(1, 9, 9, 3)) and not alphas.any() and not notes["radii"].any()
    assert all(leaf.grad is None or not leaf.grad.any() for leaf in leaves)


def test_planes_and_radius_clip() -> None:
    for options, seen in (
        ({}, True),
        ({"near_plane": 2.5}, False),
        ({"far_plane": 1.5}, False),
        ({"radius_clip": 50}, False),
    ):
        for function in (rasterization, rasterization_reference):
            assert bool(function(*one(), FRONT, lens(), 9, 9, **options)[1].any()) == seen
    assert not rasterization(*one(opacity=0.0039), FRONT, lens(), 9, 9)[1].any()


def test_huge_and_tiny_stay_finite() -> None:
    tensors = scene(6)
    tensors[2] = torch.tensor([[1e-20] * 3, [1e15] * 3, [1e-20, 1e4, 1e4], [0.0] * 3, [1e4, 1e-6, 1.0], [30.0] * 3])
    colors, alphas, gradients = render(rasterization, tensors, cameras(1, 16, 16), (16, 16), torch.float32)
    assert all(torch.isfinite(t).all() for t in (colors, alphas, *gradients.values()))
    assert alphas.max() <= 1 and alphas.min() >= 0


def test_float64_and_the_other_backend_take_the_reference() -> None:
    tensors, (views, lenses) = scene(30), cameras(1, 16, 16)
    exact = rasterization_reference(*tensors, views, lenses, 16, 16)[0]
    assert torch.equal(rasterization(*tensors, views, lenses, 16, 16)[0], exact)
    single = [t.float() for t in (*tensors, views, lenses)]
    with backend("torch"):
        assert torch.equal(rasterization(*single, 16, 16)[0], rasterization_reference(*single, 16, 16)[0])


def test_gsplat_gets_what_its_functions_ask_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """No GPU here: stand-ins with gsplat 1.5.3's signatures that composite with the reference."""
    tensors, views = scene(30), cameras(2, 20, 18)
    inputs = [t[None] for t in tensors]
    projected = splatting_torch.project_torch(*inputs[:4], *views, 20, 18, 0.01, 1e10, 0.0, 0.3)
    means2d, conics, depths, radii = projected

    def tiles(means2d, radii, depths, tile_size, tile_width, tile_height, packed):
        assert (tile_size, tile_width, tile_height, packed) == (16, 2, 2, False) and radii.dtype == torch.int32
        assert means2d.shape == radii.shape == (2, 30, 2) and depths.shape == (2, 30)
        return None, "keys", "ids"

    def pixels(means2d, conics, colors, opacities, image_width, image_height, tile_size, isect_offsets, flatten_ids):
        assert (isect_offsets, flatten_ids) == (("keys", 2, 2, 2), "ids")
        assert colors.shape == (2, 30, 3) and opacities.shape == (2, 30) and colors.is_contiguous()
        return splatting_torch.pixels_torch(
            means2d, conics, colors, opacities, radii, depths, image_width, image_height
        )

    fake = SimpleNamespace(isect_tiles=tiles, isect_offset_encode=lambda *args: args, rasterize_to_pixels=pixels)
    monkeypatch.setitem(sys.modules, "gsplat", fake)
    out, alphas = splatting._pixels_gsplat(means2d, conics, inputs[4], inputs[3], radii, depths, 20, 18, 16)
    want = rasterization_reference(*tensors, *views, 20, 18)
    assert torch.equal(out, want[0]) and torch.equal(alphas, want[1])


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        ({"means": torch.zeros(1, 2)}, "means must have shape"),
        ({"means": torch.full((1, 3), float("nan"))}, "means holds NaN"),
        ({"opacities": torch.zeros(1, 1, 1)}, "opacities must have shape"),
        ({"colors": torch.zeros(2, 3)}, "colors must have shape"),
        ({"colors": torch.zeros(1, 3, 3), "sh_degree": 1}, "needs 4 coefficients"),
        ({"sh_degree": 4}, "sh_degree must be"),
        ({"viewmats": torch.eye(4)}, "viewmats"),
        ({"viewmats": FRONT * float("nan")}, "viewmats holds NaN"),
        ({"Ks": lens() / 0}, "Ks holds NaN"),
        ({"backgrounds": torch.zeros(1, 2)}, "backgrounds must have shape"),
        ({"backgrounds": torch.full((1, 3), float("inf"))}, "backgrounds holds NaN"),
        ({"render_mode": "depth"}, "render_mode must be one of"),
    ],
)
def test_bad_input(broken: dict, message: str) -> None:
    good = dict(zip(("means", "quats", "scales", "opacities", "colors"), one(), strict=True))
    with pytest.raises(ValueError, match=message):
        rasterization(**{**good, "viewmats": FRONT, "Ks": lens(), "width": 9, "height": 9, **broken})
