"""Differentiable rendering of 3D Gaussians, called as gsplat's `rasterization` and with the constants of its 1.5.3.

Projection (`torch_reference`, `projection`) and compositing (`torch_reference`, `pixels`) each have
a torch reference and a fast CPU form; on CUDA compositing is gsplat's own kernel where that package imports.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable

import torch
from torch import Tensor

from dpcli.ops.backend import chosen_backend, is_finite
from dpcli.ops.splatting.torch_reference import pixels_torch, project_torch, sh_colors

_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


def rasterization(
    means: Tensor,  # [N, 3] or [C, N, 3]
    quats: Tensor,  # [N, 4] or [C, N, 4]
    scales: Tensor,  # [N, 3] or [C, N, 3]
    opacities: Tensor,  # [N] or [C, N]
    colors: Tensor,  # [N, D] or [C, N, D]; with sh_degree [N, K, 3] or [C, N, K, 3]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,  # [C, D]
    render_mode: str = "RGB",
    *,
    reference: bool = False,
) -> tuple[Tensor, Tensor, dict]:  # [C, H, W, D], [C, H, W, 1], notes
    """Renders colors, alphas and notes of C pinhole pictures of N Gaussians (Kerbl et al. 2023), with gradients.

    quats w x y z of any length; scales linear (standard deviations, the unit of means); opacities 0..1; viewmats world to
    camera, OpenCV axes; Ks without skew; pixel centers at +0.5. A leading C means that each camera sees its own (say,
    another time). sh_degree 0..3: colors are spherical harmonics, 0.5 is added and negatives are cut.
    render_mode: D is the depth summed by weight, ED that divided by alpha, appended to the colors in RGB+D, RGB+ED;
    behind depth lies no background. Colors are premultiplied: without backgrounds, on black.
    Order: by depth of the means, ties to the lower index. Alphas under 1/255 are skipped, over 0.999 cut (with zero
    gradient); a pixel stops before transmittance 1e-4. tile_size never changes a result, only the reference's speed.
    Notes: means2d (C,N,2) (after retain_grad() its gradient in pixels, for densification), conics (C,N,3), depths (C,N),
    radii (C,N,2) i32, 0 where unseen, opacities, width, height, n_cameras.
    Gradients reach all tensors but Ks; float32 is fast, float64 and `reference` always take the torch reference. Raises
    ValueError on wrong shapes, values that aren't finite, an unknown render_mode.

    >>> mean, size = torch.tensor([[0.0, 0.0, 2.0]]), torch.full((1, 3), 0.2)
    >>> lens = torch.tensor([[[8.0, 0.0, 4.5], [0.0, 8.0, 4.5], [0.0, 0.0, 1.0]]])
    >>> red, turn = torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    >>> colors, alphas, _ = rasterization(mean, turn, size, torch.tensor([0.5]), red, torch.eye(4)[None], lens, 9, 9)
    >>> colors.shape, round(alphas[0, 4, 4].item(), 3), alphas[0, 0, 0].item()  # the middle, and a corner it doesn't reach
    (torch.Size([1, 9, 9, 3]), 0.5, 0.0)
    """
    _check(means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, sh_degree, render_mode)
    means, quats, scales = (t if t.dim() == 3 else t[None] for t in (means, quats, scales))
    opacities = opacities if opacities.dim() == 2 else opacities[None]
    colors = colors if colors.dim() == (3 if sh_degree is None else 4) else colors[None]
    project, pixels = _projection(reference, means, viewmats), _pixels(reference, means, tile_size)
    limits = (near_plane, far_plane, radius_clip, eps2d)
    means2d, conics, depths, radii = project(means, quats, scales, opacities, viewmats, Ks, width, height, *limits)
    features = _features(colors, means, depths, viewmats, sh_degree, render_mode)
    out, alphas = pixels(means2d, conics, features, opacities, radii, depths, width, height)
    notes = {"means2d": means2d, "conics": conics, "depths": depths, "radii": radii, "width": width, "height": height}
    notes |= {"opacities": opacities.expand(len(viewmats), -1), "n_cameras": len(viewmats)}
    return _finished(out, alphas, backgrounds, render_mode), alphas, notes


def rasterization_reference(*arguments, **options) -> tuple[Tensor, Tensor, dict]:
    """Computes `rasterization` in plain torch, as a reference: same arguments, same result to rounding; any device, float64."""
    return rasterization(*arguments, **options, reference=True)


def _finished(out: Tensor, alphas: Tensor, backgrounds: Tensor | None, render_mode: str) -> Tensor:
    """Returns depth divided by alpha where it is to be the expected one, and the background behind the colors."""
    if render_mode.endswith("ED"):
        out = torch.cat([out[..., :-1], out[..., -1:] / alphas.clamp(min=1e-10)], -1)
    if backgrounds is None or render_mode in ("D", "ED"):
        return out
    behind = (1 - alphas) * backgrounds[:, None, None]
    return out + (behind if render_mode == "RGB" else torch.nn.functional.pad(behind, (0, 1)))


def _features(
    colors: Tensor, means: Tensor, depths: Tensor, viewmats: Tensor, sh_degree: int | None, mode: str
) -> Tensor:
    """Returns what is composited: colors, SH evaluated, with or instead of them depth; (1 or C,N,D)."""
    if mode in ("D", "ED"):
        return depths[..., None]
    if sh_degree is not None:
        colors = sh_colors(colors, means, viewmats, sh_degree)
    if mode == "RGB":
        return colors
    return torch.cat([colors.expand(len(depths), -1, -1), depths[..., None]], -1)


def _fast(tensor: Tensor) -> bool:
    return tensor.dtype == torch.float32 and chosen_backend(tensor.device) == "numba"


def _projection(reference: bool, means: Tensor, viewmats: Tensor) -> Callable:
    """Returns the projection to use: the CPU kernel, or the torch reference, which alone has a gradient for cameras."""
    if reference or not _fast(means) or viewmats.requires_grad:
        return project_torch
    from dpcli.ops.splatting.projection import project_numba

    return project_numba


def _pixels(reference: bool, means: Tensor, tile_size: int) -> Callable:
    if not reference and _fast(means):
        from dpcli.ops.splatting.pixels import pixels_numba

        return pixels_numba
    if not reference and means.is_cuda and means.dtype == torch.float32 and gsplat_available():
        return functools.partial(_pixels_gsplat, tile_size=tile_size)
    return functools.partial(pixels_torch, tile_size=tile_size)


@functools.cache
def gsplat_available() -> bool:
    """Returns whether gsplat and its compiled kernels import; says so once on stderr if the package is there but they don't."""
    try:
        from gsplat.cuda._backend import _C
    except ImportError:
        return False
    except Exception as error:  # its first import compiles
        _C = error
    if _C is None or isinstance(_C, Exception):
        print("dpc: gsplat has no compiled CUDA kernels; the slower torch rasterizer is used instead", file=sys.stderr)
        return False
    return True


def _pixels_gsplat(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    radii: Tensor,
    depths: Tensor,
    width: int,
    height: int,
    tile_size: int,
) -> tuple[Tensor, Tensor]:
    from gsplat import isect_offset_encode, isect_tiles, rasterize_to_pixels

    cameras = len(means2d)
    across, down = -(-width // tile_size), -(-height // tile_size)
    _, keys, ids = isect_tiles(means2d, radii, depths, tile_size, across, down, packed=False)
    offsets = isect_offset_encode(keys, cameras, across, down)
    colors, opacities = (t.expand(cameras, *t.shape[1:]).contiguous() for t in (colors, opacities))
    return rasterize_to_pixels(means2d, conics, colors, opacities, width, height, tile_size, offsets, ids)


def _check(means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, sh_degree, render_mode) -> None:
    if render_mode not in _MODES:
        raise ValueError(f"render_mode must be one of {', '.join(_MODES)}, but is {render_mode!r}")
    if sh_degree is not None and sh_degree not in (0, 1, 2, 3):
        raise ValueError(f"sh_degree must be 0..3 or None, but is {sh_degree!r}")
    if viewmats.dim() != 3 or viewmats.shape[1:] != (4, 4) or Ks.shape != (len(viewmats), 3, 3):
        raise ValueError(f"viewmats (C,4,4) and Ks (C,3,3) are {tuple(viewmats.shape)} and {tuple(Ks.shape)}")
    cameras, count = len(viewmats), means.shape[-2] if means.dim() > 1 else 0
    color_shape = (count, colors.shape[-1]) if sh_degree is None else (count, colors.shape[-2], 3)
    tails = {
        "means": (means, (count, 3)),
        "quats": (quats, (count, 4)),
        "scales": (scales, (count, 3)),
        "opacities": (opacities, (count,)),
        "colors": (colors, color_shape),
    }
    for name, (tensor, tail) in tails.items():
        if tuple(tensor.shape) not in (tail, (cameras, *tail)):
            raise ValueError(f"{name} must have shape {tail} or {(cameras, *tail)}, but has {tuple(tensor.shape)}")
    if sh_degree is not None and colors.shape[-2] < (sh_degree + 1) ** 2:
        raise ValueError(
            f"sh_degree {sh_degree} needs {(sh_degree + 1) ** 2} coefficients, but colors has {colors.shape[-2]}"
        )
    if backgrounds is not None and tuple(backgrounds.shape) != (cameras, colors.shape[-1]):
        raise ValueError(
            f"backgrounds must have shape {(cameras, colors.shape[-1])}, but has {tuple(backgrounds.shape)}"
        )
    given = {name: tensor for name, (tensor, _) in tails.items()}
    for name, tensor in {**given, "viewmats": viewmats, "Ks": Ks, "backgrounds": backgrounds}.items():
        if tensor is not None and not is_finite(tensor):
            raise ValueError(f"{name} holds NaN or infinite values")
