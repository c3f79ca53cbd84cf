"""The torch reference of `splatting`: projection, spherical harmonics, compositing tile by tile. Any device, any float.

Constants are gsplat 1.5.3's. Gradients are autograd's.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dpcli.ops.rotations import normalize_quaternion, quaternion_to_matrix

MIN_ALPHA = 1 / 255  # what contributes less is skipped
MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4  # a pixel stops before the Gaussian that would take it to this or below
MAX_EXTENT = 3.33  # standard deviations
FRUSTUM = 0.3  # the Jacobian is evaluated at most this many half pictures outside the picture

_SH = (
    (0.28209479177387814,),
    (-0.4886025119029199, 0.4886025119029199, -0.4886025119029199),
    (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396),
    (
        -0.5900435899266435,
        2.890611442640554,
        -0.4570457994644658,
        0.3731763325901154,
        -0.4570457994644658,
        1.445305721320277,
        -0.5900435899266435,
    ),
)


def project_torch(
    means: Tensor,  # [1 or C, N, 3]
    quats: Tensor,  # [1 or C, N, 4]
    scales: Tensor,  # [1 or C, N, 3]
    opacities: Tensor,  # [1 or C, N]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
    eps2d: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # [C, N, 2], [C, N, 3], [C, N], [C, N, 2] i32
    """Returns means2d in pixels, conics (xx, xy, yy of the inverse 2D covariance), depths, and radii, 0 of what isn't seen.

    EWA splatting: the covariance J W R S S R^T W^T J^T + eps2d I, J the projection's Jacobian. Unseen: outside the near
    and far planes, opacity under 1/255, no pixel of the picture within min(3.33, sqrt(2 ln(255 opacity))) standard
    deviations, radius_clip pixels or less in both directions.
    """
    rotation, shift = viewmats[:, None, :3, :3], viewmats[:, None, :3, 3]
    camera = (rotation @ means[..., None])[..., 0] + shift
    depths = camera[..., 2]
    before = (depths >= near_plane) & (depths <= far_plane)
    x, y, z = torch.where(before[..., None], camera, camera.new_tensor([0.0, 0.0, 1.0])).unbind(-1)
    fx, fy, cx, cy = (Ks[:, None, i, j] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    tx = z * _clamped(x / z, -cx / fx, (width - cx) / fx, width / fx)
    ty = z * _clamped(y / z, -cy / fy, (height - cy) / fy, height / fy)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * tx / z**2, zero, fy / z, -fy * ty / z**2], -1).unflatten(-1, (2, 3))
    root = jacobian @ rotation @ quaternion_to_matrix(normalize_quaternion(quats, 1e-12)) * scales[..., None, :]
    covariance = root @ root.mT
    xx, xy, yy = covariance[..., 0, 0] + eps2d, covariance[..., 0, 1], covariance[..., 1, 1] + eps2d
    det = xx * yy - xy * xy
    valid = before & (det > 0) & torch.isfinite(det) & (opacities >= MIN_ALPHA)
    det = torch.where(valid, det, 1)
    conics = torch.where(valid[..., None], torch.stack([yy, -xy, xx], -1) / det[..., None], 0)
    radii = _radii(means2d, xx, yy, opacities, valid, width, height, radius_clip)
    return means2d, conics, depths, radii


def _clamped(tangent: Tensor, low: Tensor, high: Tensor, extent: Tensor) -> Tensor:
    margin = FRUSTUM * 0.5 * extent
    return torch.minimum(torch.maximum(tangent, low - margin), high + margin)


@torch.no_grad()
def _radii(means2d, xx, yy, opacities, valid, width: int, height: int, radius_clip: float) -> Tensor:
    extent = torch.sqrt(2 * torch.log(255 * opacities.clamp(min=MIN_ALPHA))).clamp(max=MAX_EXTENT)
    radii = torch.ceil(extent[..., None] * torch.stack([xx, yy], -1).clamp(min=0).sqrt())
    size = radii.new_tensor([width, height])
    seen = ((means2d + radii > 0) & (means2d - radii < size)).all(-1) & (radii > radius_clip).any(-1) & valid
    return torch.where(seen[..., None], radii, 0).clamp(max=1 << 30).to(torch.int32)


def sh_colors(coefficients: Tensor, means: Tensor, viewmats: Tensor, degree: int) -> Tensor:
    """Returns colors (1 or C,N,3) of SH coefficients (1 or C,N,K,3) seen from the cameras: max(0, 0.5 + sum c_k
    Y_k(direction)).

    means (1 or C,N,3); real harmonics of degree 0..3 as in 3D Gaussian splatting, direction from camera to Gaussian.
    """
    if degree == 0:
        return (0.5 + _SH[0][0] * coefficients[..., 0, :]).clamp(min=0)
    centers = -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]
    direction = torch.nn.functional.normalize(means - centers[:, None], dim=-1)
    basis = sh_basis(direction, degree)
    return (0.5 + (basis[..., None] * coefficients[..., : basis.shape[-1], :]).sum(-2)).clamp(min=0)


def sh_basis(direction: Tensor, degree: int) -> Tensor:
    """Returns the real spherical harmonics (...,(degree+1)^2) of unit directions (...,3), degree 0..3."""
    x, y, z = direction.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    bands = [
        [torch.ones_like(x)],
        [y, z, x],
        [x * y, y * z, 2 * zz - xx - yy, x * z, xx - yy],
        [
            y * (3 * xx - yy),
            x * y * z,
            y * (4 * zz - xx - yy),
            z * (2 * zz - 3 * xx - 3 * yy),
            x * (4 * zz - xx - yy),
            z * (xx - yy),
            x * (xx - 3 * yy),
        ],
    ]
    terms = [c * t for band in range(degree + 1) for c, t in zip(_SH[band], bands[band], strict=True)]
    return torch.stack(terms, -1)


def pixels_torch(
    means2d: Tensor,  # [C, N, 2]
    conics: Tensor,  # [C, N, 3]
    colors: Tensor,  # [1 or C, N, D]
    opacities: Tensor,  # [1 or C, N]
    radii: Tensor,  # [C, N, 2] i32
    depths: Tensor,  # [C, N]
    width: int,
    height: int,
    tile_size: int = 16,
) -> tuple[Tensor, Tensor]:  # [C, H, W, D], [C, H, W, 1]
    """Returns colors (no background) and alphas by alpha blending (eq. 5.1). Front to back by depth, ties to the lower index."""
    cameras = len(means2d)
    shared = (t.expand(cameras, *t.shape[1:]) for t in (colors, opacities))
    each = zip(means2d, conics, *shared, radii, depths, strict=True)
    pictures = [_one_camera(*arrays, width, height, tile_size) for arrays in each]
    return torch.stack([p[0] for p in pictures]), torch.stack([p[1] for p in pictures])


def _one_camera(means2d, conics, colors, opacities, radii, depths, width: int, height: int, tile_size: int):
    order = torch.argsort(depths.detach(), stable=True)
    order = order[(radii[order] > 0).all(-1)]
    arrays = [t[order] for t in (means2d, conics, colors, opacities)]
    low, high = arrays[0].detach() - radii[order], arrays[0].detach() + radii[order]
    strips = []
    for top in range(0, height, tile_size):
        bottom, tiles = min(top + tile_size, height), []
        for left in range(0, width, tile_size):
            right = min(left + tile_size, width)
            inside = (low[:, 0] < right) & (high[:, 0] > left) & (low[:, 1] < bottom) & (high[:, 1] > top)
            tiles.append(_tile(*(t[inside] for t in arrays), (left, right), (top, bottom)))
        strips.append(torch.cat(tiles, 1))
    picture = torch.cat(strips, 0)
    return picture[..., :-1], picture[..., -1:]


def _tile(means2d, conics, colors, opacities, columns: tuple[int, int], rows: tuple[int, int]) -> Tensor:
    """Returns colors and alpha (h,w,D+1) of one tile: all its pixels against all its Gaussians, sorted from near to far."""
    at = {"dtype": means2d.dtype, "device": means2d.device}
    y, x = torch.meshgrid(torch.arange(*rows, **at) + 0.5, torch.arange(*columns, **at) + 0.5, indexing="ij")
    dx, dy = x[..., None] - means2d[:, 0], y[..., None] - means2d[:, 1]
    sigma = 0.5 * (conics[:, 0] * dx**2 + conics[:, 2] * dy**2) + conics[:, 1] * dx * dy
    alpha = (opacities * torch.exp(-sigma)).clamp(max=MAX_ALPHA)
    alpha = torch.where(alpha >= MIN_ALPHA, alpha, 0)
    reached = torch.cumprod(1 - alpha.detach(), -1) > MIN_TRANSMITTANCE
    alpha = torch.where(reached, alpha, 0)
    after = torch.cumprod(1 - alpha, -1)
    before = torch.cat([torch.ones_like(x)[..., None], after], -1)
    weights = alpha * before[..., :-1]
    return torch.cat([weights @ colors, 1 - before[..., -1:]], -1)
