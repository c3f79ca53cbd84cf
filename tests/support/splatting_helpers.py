"""What the tests and the bench of the rasterizer share: scenes, cameras, written-out compositing, the checker."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from dpcli.ops.cameras import DEFAULT_FOVY, orbit_pose, pinhole
from dpcli.ops.splatting.rasterization import rasterization_reference

NAMES = ("means", "quats", "scales", "opacities", "colors")


def cameras(count: int, width: int, height: int) -> tuple[Tensor, Tensor]:
    """viewmats (C,4,4) and Ks (C,3,3) f64 around the origin."""
    poses = np.stack([orbit_pose(0.3 + 0.9 * i, 0.25 - 0.2 * i, 2.0) for i in range(count)])
    return torch.from_numpy(poses), torch.from_numpy(pinhole(DEFAULT_FOVY, width, height)).expand(count, 3, 3)


def straight(count: int, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Cameras side by side with exact depths: z + 2, in any precision."""
    poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    poses[:, 0, 3], poses[:, 2, 3] = 0.25 * torch.arange(count), 2
    return poses, cameras(count, width, height)[1]


def scene(count: int, kind: str = "mixed", channels: int = 3, seed: int = 0, scale: float = 0.05) -> list[Tensor]:
    """[means, quats, scales, opacities, colors] f64 (values of float32), needles and discs of any opacity in the unit ball.

    kind: `mixed`, or `opaque` (nearly, so pixels stop early), `behind` (half of them behind the first camera or far off
    the picture), `ties` (on four depths of cameras that look `straight`), `faint` (about the skipped 1/255), `large`.
    """
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    means = (random(count, 3) - 0.5) * 1.2
    scales = scale * torch.exp(2 * random(count, 3) - 1.5) * (8 if kind == "large" else 1)
    opacities = {"opaque": 0.9 + 0.1 * random(count), "faint": 0.02 * random(count)}.get(kind, random(count))
    if kind == "behind":
        means[::2] *= 6
    if kind == "ties":
        means[:, 2] = torch.floor(4 * random(count)) / 8
    quats = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    tensors = [means, quats, scales, opacities, random(count, channels)]
    return [t.float().double() for t in tensors]


def render(
    function: Callable, tensors: list[Tensor], views: tuple[Tensor, Tensor], size: tuple[int, int], dtype, **options
):
    """Colors, alphas and {name: gradient} of a fixed random loss, inputs cast to `dtype`."""
    leaves = [t.to(dtype, copy=True).requires_grad_() for t in tensors]
    colors, alphas, notes = function(*leaves, *(v.to(dtype) for v in views), *size, **options)
    generator = torch.Generator().manual_seed(9)
    weights = [torch.randn(t.shape, generator=generator, dtype=torch.float64).to(dtype) for t in (colors, alphas)]
    if notes["means2d"].requires_grad:
        notes["means2d"].retain_grad()
    (colors * weights[0]).sum().add((alphas * weights[1]).sum()).backward()
    gradients = dict(zip(NAMES, (leaf.grad for leaf in leaves), strict=True))
    return colors.detach(), alphas.detach(), gradients | {"means2d": notes["means2d"].grad}


def assert_renders(function: Callable, tensors: list[Tensor], views, size: tuple[int, int], **options) -> None:
    """The checker: `function` (called as `rasterization`) in float32 agrees with the float64 reference.

    Alphas within rounding of 1/255 or of a stop may fall on the other side: few pixels, each by little.
    """
    ours = render(function, tensors, views, size, torch.float32, **options)
    options = {k: v.double() if isinstance(v, Tensor) else v for k, v in options.items()}
    truth = render(rasterization_reference, tensors, views, size, torch.float64, **options)
    for got, want in zip(ours[:2], truth[:2], strict=True):
        assert got.dtype == torch.float32 and got.shape == want.shape
        off = (got.double() - want).abs() / want.abs().clamp(min=1)
        assert (off > 2e-5).double().mean() <= 2e-3 and off.max() <= 0.03, f"off by up to {off.max():.1e}"
    for name, want in truth[2].items():
        got = ours[2][name]
        assert got is not None, f"no gradient of {name}"
        assert torch.isfinite(got).all()
        error, size_of = float((got.double() - want).norm()), float(want.norm())
        assert error <= 2e-3 * size_of + 1e-9, f"gradient of {name} off by {error / max(size_of, 1e-30):.1e}"


def brute_force(
    tensors: list[Tensor], view: Tensor, K: Tensor, width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    """Colors (H,W,D) and alphas (H,W) by the definition, one pixel and one Gaussian at a time, nothing shared with ours.

    The projection's Jacobian is a finite difference of the projection; only for Gaussians inside the picture.
    """
    means, quats, scales, opacities, colors = (t.numpy() for t in tensors)
    view, K = view.numpy(), K.numpy()

    def projected(point: np.ndarray) -> np.ndarray:
        x, y, z = K @ (view[:3, :3] @ point + view[:3, 3])
        return np.array([x / z, y / z])

    def rotated(q: np.ndarray, v: np.ndarray) -> np.ndarray:
        w, u = q[0] / np.linalg.norm(q), q[1:] / np.linalg.norm(q)
        return v + 2 * np.cross(u, np.cross(u, v) + w * v)

    splats = []
    for n in range(len(means)):
        axes = [scales[n, j] * rotated(quats[n], np.eye(3)[j]) for j in range(3)]
        step = 1e-6
        root = np.stack(
            [(projected(means[n] + step * a) - projected(means[n] - step * a)) / (2 * step) for a in axes], 1
        )
        depth = (view[:3, :3] @ means[n] + view[:3, 3])[2]
        splats.append((depth, n, projected(means[n]), np.linalg.inv(root @ root.T + 0.3 * np.eye(2))))
    splats.sort(key=lambda s: s[:2])
    picture, cover = np.zeros((height, width, colors.shape[1])), np.zeros((height, width))
    for row in range(height):
        for column in range(width):
            light = 1.0
            for _, n, center, inverse in splats:
                d = np.array([column + 0.5, row + 0.5]) - center
                alpha = min(0.999, opacities[n] * math.exp(-0.5 * d @ inverse @ d))
                if alpha < 1 / 255:
                    continue
                if light * (1 - alpha) <= 1e-4:
                    break
                picture[row, column] += light * alpha * colors[n]
                light *= 1 - alpha
            cover[row, column] = 1 - light
    return picture, cover
