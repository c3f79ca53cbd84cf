"""The first Gaussians of a fit: in a sphere, on the surface of a shape prior, or in the visual hull of several views.

A single view says nothing about depth: a fit that starts from a sphere settles on any shape with that picture, most of
them flat. A shape prior, at least the inflated silhouette, says where the surface may be.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from dpcli.errors import DataError
from dpcli.generate4d.config import FitConfig
from dpcli.generate4d.shape.guidance import ShapeGuidance, sample_surface
from dpcli.generate4d.shape.layers import Camera
from dpcli.generate4d.shape.silhouette import Inflated, ball_thickness
from dpcli.generate4d.targets import Targets
from dpcli.runtime.progress import log

_ROUNDS, _CANDIDATES = 200, 20_000  # at most so many draws of so many points look for those inside a hull
# of the sphere they are drawn from; of the rays' distances from the origin beyond which the object leaves it
_SPHERE, _WITHIN = 0.85, 0.8
# pixels of a silhouette, and places on the ray of each, that other silhouettes are asked about
_RAYS, _STEPS = (400, 192)
_SHARED = 0.95  # of a silhouette, at least, lies within all others where their cameras are right


def choose_start(config: FitConfig, targets: Targets) -> str:
    """Returns `sphere`, `inflate` or `hull`: what the settings say, else the hull where more than two views carve one."""
    if config.start != "auto":
        return config.start
    return "hull" if targets.num_views > 2 else "inflate"


def first_points(
    kind: str, config: FitConfig, targets: Targets, rng: np.random.Generator, shape: ShapeGuidance | None = None
) -> tuple[Tensor, Tensor]:  # [N, 3], [N, 3]
    """Returns positions and colors (0..1), f32, of the first Gaussians of the kind that `choose_start` returns.

    shape: whose surface `inflate` covers; None: that of the inflated silhouette.
    """
    if kind == "sphere":
        points = sample_sphere(config.gaussians, config.start_radius, rng)
        return torch.from_numpy(points), torch.full((len(points), 3), 0.5)
    frame = targets.widest_frame()
    if kind == "inflate":
        shape = shape or ShapeGuidance(Inflated(), targets)
        points, colors = sample_surface(shape.layers[frame], shape.camera, config.gaussians, rng)
    else:
        shown = [view for view in range(targets.num_views) if (targets.pictures[view, frame, ..., 3] > 0.5).any()]
        if not shown:
            clearest = float(targets.pictures[:, frame, ..., 3].max())
            raise DataError(
                f"the object is too clear: no alpha of the frame to start from is above {clearest:.2f}, expected 0.5; take --set"
                " start=sphere"
            )
        pictures = [targets.picture(view, frame) for view in shown]  # one that the object has left carves nothing
        cameras = targets.intrinsics[shown], targets.world_to_camera[shown]
        points, colors = carve_hull(pictures, *cameras, config.gaussians, rng)
    return torch.from_numpy(points), torch.from_numpy(colors)


def check_cameras(targets: Targets, where: object) -> None:
    """Warns of views whose silhouettes contradict one another, as those of wrong, mirrored or exchanged cameras do."""
    shares = shared_silhouettes(targets, frame := targets.widest_frame())
    if np.nanmin(np.append(shares, 1.0)) < _SHARED:
        names = ["reference" if view == targets.reference else f"train{view}" for view in range(len(shares))]
        found = ", ".join(f"{name} {share:.0%}" for name, share in zip(names, shares) if np.isfinite(share))
        log.warn(
            f"{where}: the views contradict one another: the shares of the silhouettes in frame {frame} that the other views"
            f" leave possible are {found}, expected nearly 100%; the scene will be blurred. Check the cameras (mirrored? in"
            " another order? another field of view?) and that all views show the same moment"
        )


def shared_silhouettes(targets: Targets, frame: int) -> np.ndarray:  # [V]
    """Returns the share of each view's silhouette whose rays pass, near the object, through all other silhouettes at once.

    Silhouettes are taken one pixel wider. What lies outside a view's picture isn't contradicted by it; a view that shows
    nothing isn't asked, and has NaN.
    """
    from scipy import ndimage

    masks = targets.pictures[:, frame, ..., 3].float().numpy() > 0.5
    shown = [view for view, mask in enumerate(masks) if mask.any()]
    wide = ndimage.binary_dilation(masks, np.ones((1, 3, 3)))
    asked = np.stack([wide, np.ones_like(wide)], -1)
    reach = max(replace(targets, reference=view).object_reach()[0] for view in shown) if shown else 0.0
    shares = np.full(len(masks), np.nan)
    for view in shown:
        camera = Camera(targets.intrinsics[view], targets.world_to_camera[view])
        pixels = np.argwhere(masks[view])
        row, column = pixels[:: max(1, len(pixels) // _RAYS)].T[..., None]
        depth = camera.distance + reach * np.linspace(-1, 1, _STEPS)
        points = camera.to_world(camera.pixel_points(row, column, np.broadcast_to(depth, (len(row), _STEPS))))
        inside = np.ones(points.shape[:2], bool)
        for other in shown:
            matrix, pose = targets.intrinsics[other], targets.world_to_camera[other]
            values, _ = _sample_picture(asked[other], points.reshape(-1, 3), matrix, pose)
            inside &= (values[:, 0] >= values[:, 1]).reshape(inside.shape)  # both are 0 outside the picture
        shares[view] = inside.any(1).mean()
    return shares


def sample_sphere(count: int, radius: float, rng: np.random.Generator) -> np.ndarray:
    """Returns positions f32 (count,3), uniform in the volume of a sphere about the origin."""
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return (direction * radius * np.cbrt(rng.random((count, 1)))).astype(np.float32)


def carve_hull(
    pictures: list[np.ndarray], intrinsics: np.ndarray, poses: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Returns positions and colors (count,3) f32 inside the silhouettes of all views (V pictures (H,W,4), 0..1), rounded.

    The common hull of few silhouettes has corners that no view contradicts: two views at a right angle make a box of every
    body. With u the distance from a silhouette's middle line as a share of its half width, points are kept whose
    u_i^2 + u_j^2 is at most 1 for every two views that look across each other, which makes that box an ellipse.
    A color is the mean over views, weighted toward the view whose camera is nearest to the point. Raises DataError when
    no point lies in all silhouettes.
    """
    across = np.abs(poses[:, 2, :3] @ poses[:, 2, :3].T) < 0.7  # viewing directions at more than 45 degrees
    pairs = list(zip(*np.nonzero(np.triu(across))))
    masked = [np.dstack([picture[..., 3], _share_of_width(picture[..., 3] > 0.5)]) for picture in pictures]
    kept: list[np.ndarray] = []
    reach = max(_ray_reach(picture[..., 3] > 0.5, *camera) for picture, *camera in zip(pictures, intrinsics, poses))
    # two views at a right angle may both look along a diagonal
    radius = _SPHERE if reach <= _WITHIN else np.sqrt(2) * reach
    for _ in range(_ROUNDS):
        points = sample_sphere(_CANDIDATES, radius, rng)
        seen = np.stack(
            [
                _sample_picture(picture, points, matrix, pose)[0]
                for picture, matrix, pose in zip(masked, intrinsics, poses)
            ]
        )
        inside, squared = (seen[..., 0] > 0.5).all(0), seen[..., 1] ** 2
        for i, j in pairs:
            inside &= squared[i] + squared[j] <= 1
        kept.append(points[inside])
        if sum(map(len, kept)) >= count:
            break
    points = np.concatenate(kept)[:count]
    if not len(points):
        raise DataError("the silhouettes of the views have no point in common; are the cameras right?")
    return points, _mean_colors(points, pictures, intrinsics, poses)


def _ray_reach(mask: np.ndarray, intrinsics: np.ndarray, pose: np.ndarray) -> float:
    """Returns how far from the world's origin the rays of a silhouette pass at most; the object reaches at least as far."""
    row, column = np.nonzero(mask)
    rays = Camera(intrinsics, pose).pixel_points(row, column, np.ones(len(row)))
    away = np.linalg.norm(np.cross(rays, pose[:3, 3]), axis=1) / np.linalg.norm(rays, axis=1)
    return float(away.max(initial=0.0))


def _mean_colors(
    points: np.ndarray, pictures: list[np.ndarray], intrinsics: np.ndarray, poses: np.ndarray
) -> np.ndarray:  # [N, 3]
    """Returns the colors of points f32, mean over views, weighted toward the nearest camera."""
    colors, weights = np.zeros_like(points), np.zeros((len(points), 1), np.float32)
    for picture, matrix, pose in zip(pictures, intrinsics, poses):
        values, depth = _sample_picture(picture, points, matrix, pose)
        weight = (np.exp(-8 * (depth - depth.min())) * values[:, 3])[:, None]
        colors, weights = colors + weight * values[:, :3], weights + weight
    return (colors / np.maximum(weights, 1e-8)).astype(np.float32)


def _share_of_width(mask: np.ndarray) -> np.ndarray:
    """Returns u (H,W), f32: 0 on the middle line of a silhouette, 1 on its outline and outside.

    With d the distance from the outline and h the ball thickness, h^2 = 2 R d - d^2 gives the half width R, u = 1 - d / R.
    """
    from scipy import ndimage

    distance = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    width = (ball_thickness(mask) ** 2 + distance**2) / np.maximum(2 * distance, 1e-6)
    return np.where(mask, (1 - distance / np.maximum(width, 1e-6)).clip(0, 1), 1.0).astype(np.float32)


def _sample_picture(
    picture: np.ndarray, points: np.ndarray, intrinsics: np.ndarray, pose: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pixel values (N,channels) under the points, zero outside the picture, and their depths (N)."""
    camera = points @ pose[:3, :3].T + pose[:3, 3]
    depth = np.maximum(camera[:, 2], 1e-6)
    column = np.floor(camera[:, 0] / depth * intrinsics[0, 0] + intrinsics[0, 2]).astype(int)
    row = np.floor(camera[:, 1] / depth * intrinsics[1, 1] + intrinsics[1, 2]).astype(int)
    height, width = picture.shape[:2]
    good = (row >= 0) & (row < height) & (column >= 0) & (column < width) & (camera[:, 2] > 0)
    values = np.zeros((len(points), picture.shape[2]), np.float32)
    values[good] = picture[row[good], column[good]]
    return values, depth


def spread_seeds(points: Tensor, count: int) -> Tensor:
    """Returns `count` of the points (N,3), spread by farthest point sampling, repeated when there are fewer."""
    from dpcli.ops.farthest_point_sampling import fps

    chosen = fps(points.detach()[None], min(count, len(points)))[0]
    return points.detach()[chosen[torch.arange(count) % len(chosen)]]
