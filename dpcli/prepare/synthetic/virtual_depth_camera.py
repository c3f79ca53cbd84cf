"""A virtual depth camera that sees capsules: exact ray casting, one z-buffer, and the noise of a real sensor."""

from __future__ import annotations

import numpy as np

from dpcli.prepare.decode.pinhole_camera import Intrinsics, pixel_rays


def render(
    starts: np.ndarray, ends: np.ndarray, radii: np.ndarray, intrinsics: Intrinsics, height: int, width: int
) -> tuple[np.ndarray, np.ndarray]:
    """Renders one frame: capsules with axes starts-ends f64 (K,3) and radii (K), in camera axes, meters.

    -> depth f32 (H,W), inf where nothing is seen; part i16 (H,W), -1 there.
    """
    depth = np.full((height, width), np.inf, np.float32)
    part = np.full((height, width), -1, np.int16)
    rays = pixel_rays(height, width, intrinsics).reshape(height, width, 3)
    for k, (a, b, radius) in enumerate(zip(starts, ends, radii, strict=True)):
        rows, columns = bounding_box(a, b, radius, intrinsics, height, width)
        hit = intersect(rays[rows, columns], a, b, radius)
        window = depth[rows, columns]
        nearer = hit < window
        window[nearer] = hit[nearer]
        part[rows, columns][nearer] = k
    return depth, part


def intersect(rays: np.ndarray, a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """Returns the depth of the first hit of rays (...,3) of unit z from the origin with a capsule; f32 (...), inf = no
    hit.

    A ray meets the capsule where it enters the cylinder around a-b between both ends, or else the sphere at the
    nearer end. With unit z the ray parameter is the depth. The origin must lie outside the capsule.
    """
    x, y = rays[..., 0].astype(np.float64), rays[..., 1].astype(np.float64)
    rr = x * x + y * y + 1
    axis = b - a
    length2 = float(axis @ axis)
    along_ray = x * axis[0] + y * axis[1] + axis[2]
    ray_a = x * a[0] + y * a[1] + a[2]
    axis_a, a2 = float(axis @ a), float(a @ a)
    # |component of (t ray - a) perpendicular to the axis|^2 = radius^2, multiplied by length2: p t^2 - 2 q t + s = 0
    p = length2 * rr - along_ray**2
    q = length2 * ray_a - axis_a * along_ray
    s = length2 * (a2 - radius**2) - axis_a**2
    discriminant = q * q - p * s
    with np.errstate(invalid="ignore", divide="ignore"):
        t = (q - np.sqrt(discriminant)) / p
        height = t * along_ray - axis_a  # position along the axis, times length2
    upper = height > length2
    ray_c = np.where(upper, x * b[0] + y * b[1] + b[2], ray_a)
    c2 = np.where(upper, float(b @ b), a2)
    with np.errstate(invalid="ignore"):
        cap = (ray_c - np.sqrt(ray_c**2 - rr * (c2 - radius**2))) / rr
    t = np.where((height >= 0) & ~upper, t, cap)
    return np.where(np.isfinite(t) & (t > 0) & (discriminant >= 0), t, np.inf).astype(np.float32)


def bounding_box(
    a: np.ndarray, b: np.ndarray, radius: float, k: Intrinsics, height: int, width: int
) -> tuple[slice, slice]:
    """Returns rows and columns of the image that a capsule can touch (conservative); the whole image when it is very
    near.
    """
    low, high = np.minimum(a, b) - radius, np.maximum(a, b) + radius
    if low[2] <= 1e-3:
        return slice(0, height), slice(0, width)
    edges = []
    for axis, focal, center, size in ((1, k.fy, k.cy, height), (0, k.fx, k.cx, width)):
        first = focal * min(low[axis] / low[2], low[axis] / high[2]) + center
        last = focal * max(high[axis] / low[2], high[axis] / high[2]) + center
        edges.append(slice(int(np.clip(np.floor(first), 0, size)), int(np.clip(np.ceil(last) + 1, 0, size))))
    return edges[0], edges[1]


def add_noise(depth: np.ndarray, rng: np.random.Generator, strength: float, missing: float) -> np.ndarray:
    """Adds sensor noise to depth f32 (P) in meters; non-positive values mean a lost pixel.

    Axial noise grows with distance as measured on a Kinect (Nguyen et al. 2012: 1.2 mm + 1.9 mm (z - 0.4 m)^2),
    times ``strength``; a fraction ``missing`` of the pixels is lost.
    """
    deviation = strength * (0.0012 + 0.0019 * (depth - 0.4) ** 2)
    noisy = depth + deviation * rng.standard_normal(len(depth), np.float32)
    noisy[rng.random(len(depth), np.float32) < missing] = 0
    return noisy
