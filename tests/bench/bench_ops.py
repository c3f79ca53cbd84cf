"""Speed of the operations: ours against the torch reference, and against what a user would take instead.

    python -m tests.bench.bench_ops [--repeat 5]

Every row times the three in turn (median of several, first call not counted) and compares their results in the same
run: ours and the reference must give identical indices, or the bench fails. The shapes are a 16 x 2048 clip of a moving
body about 1.1 tall, as Kinet sees it, and frames as `dpc prepare` thins them.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
import torch

from dpcli import ops
from dpcli.errors import DpcError
from dpcli.ops.kernel_convolution import kernel_convolution, kernel_convolution_reference
from dpcli.ops.open3d_import import load_open3d
from dpcli.ops.rigid import rigid_flow_reference, weighted_kabsch_reference
from dpcli.runtime.tuning import keep_freed_memory
from tests.support.ops_helpers import backend


def median_ms(function: Callable[[], object], repeat: int) -> float:
    """Median of `repeat` calls after a first that isn't counted; of three where a call takes over half a second."""
    times: list[float] = []
    while len(times) < 1 + (repeat if not times or times[0] < 0.5 else 3):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times[1:])


def body(frames: int, count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """A turning ellipsoid shell with 1 cm of noise: points (1,frames*count,3) and their frame numbers."""
    rng = np.random.default_rng(seed)
    shell = rng.normal(size=(frames, count, 3))
    shell /= np.linalg.norm(shell, axis=-1, keepdims=True)
    points = shell * [0.25, 0.55, 0.15] + rng.normal(scale=0.01, size=shell.shape)
    points[..., 0] += np.linspace(0, 0.3, frames)[:, None]
    times = np.repeat(np.arange(frames), count)[None]
    return torch.from_numpy(points.reshape(1, -1, 3).astype(np.float32)), torch.from_numpy(times)


def open3d_fps(points: torch.Tensor, samples: int) -> Callable[[], object] | None:
    try:
        open3d = load_open3d()
    except DpcError:
        return None
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(p.double().numpy())) for p in points]
    return lambda: [cloud.farthest_point_down_sample(samples) for cloud in clouds]


def scipy_ball(
    points: torch.Tensor, times: torch.Tensor, centers: torch.Tensor, center_times: torch.Tensor, radius: float
):
    """A tree per frame, asked for all neighbors: what fills the slots is left to the user."""
    from scipy.spatial import cKDTree

    frames = [points[0][times[0] == t].numpy() for t in range(int(times.max()) + 1)]

    def run() -> None:
        trees = [cKDTree(frame) for frame in frames]
        for t in range(len(frames)):
            asked = centers[0][center_times[0] == t].numpy()
            for near in range(max(0, t - 1), min(len(frames), t + 2)):
                trees[near].query_ball_point(asked, radius, workers=-1)

    return run


def scipy_knn(query: torch.Tensor, points: torch.Tensor, k: int) -> Callable[[], object]:
    from scipy.spatial import cKDTree

    return lambda: [cKDTree(p.numpy()).query(q.numpy(), k, workers=-1) for q, p in zip(query, points, strict=True)]


def fps_rows() -> Iterator[tuple]:
    for batch, count, samples in ((1, 32768, 1024), (16, 2048, 512), (1, 7000, 2048)):
        points = body(1, batch * count)[0].view(batch, count, 3)
        yield (
            f"fps {batch} x {count} -> {samples}",
            lambda p=points, s=samples: ops.fps(p, s),
            lambda p=points, s=samples: ops.fps_reference(p, s),
            ("open3d", open3d_fps(points, samples)),
        )


def ball_rows() -> Iterator[tuple]:
    points, times = body(16, 2048)
    chosen = ops.fps(points, 1024)[0]
    centers, center_times = points[:, chosen], times[:, chosen]
    clip = (points, times, centers, center_times)
    for order, radii in (("first", [0.5, 0.507]), ("nearest", [0.5, 0.507]), ("first", [0.05, 0.05])):
        yield (
            f"ball query 16 x 2048, r {radii[0]}, {order} 64 of 1024",
            lambda r=radii, o=order: ops.space_time_ball_query(*clip, r, 64, order=o),
            lambda r=radii, o=order: ops.space_time_ball_query_reference(*clip, r, 64, order=o),
            ("scipy", scipy_ball(*clip, radii[0])),
        )
    second = ops.fps(centers, 512)[0]
    stage = (centers, center_times, centers[:, second], center_times[:, second])
    yield (
        "ball query 1024 unsorted, r 1.0, first 64 of 512",
        lambda: ops.space_time_ball_query(*stage, [1.0, 1.01], 64),
        lambda: ops.space_time_ball_query_reference(*stage, [1.0, 1.01], 64),
        ("scipy", scipy_ball(*stage, 1.0)),
    )


def knn_rows() -> Iterator[tuple]:
    generator = torch.Generator().manual_seed(0)
    for batch, rows, count, k in ((16, 512, 2048, 32), (1, 20000, 20000, 16), (16, 1024, 512, 3)):
        query, points = (torch.randn(batch, n, 3, generator=generator) for n in (rows, count))
        yield (
            f"knn {batch} x {rows} in {count}, k {k}",
            lambda q=query, p=points, k=k: ops.knn(q, p, k),
            lambda q=query, p=points, k=k: ops.knn_reference(q, p, k),
            ("scipy", scipy_knn(query, points, k)),
        )


def with_gradient(function: Callable, leaf: torch.Tensor) -> Callable[[], torch.Tensor]:
    def run() -> torch.Tensor:
        out = function(leaf)
        return torch.autograd.grad(out, leaf, torch.ones_like(out))[0]

    return run


def under(name: str, function: Callable) -> Callable:
    def run(*args: object) -> object:
        with backend(name):
            return function(*args)

    return run


def value_rows() -> Iterator[tuple]:
    """Forward and backward of what carries gradients."""
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(4, 1024, 128, generator=generator).requires_grad_()
    idx = torch.randint(0, 1024, (4, 512, 64), generator=generator)
    flat = idx.view(4, -1, 1).expand(-1, -1, 128)
    yield (
        "gather 4 x 512 x 64 of 1024 x 128, with gradient",
        with_gradient(lambda f: ops.gather_points(f, idx), features),
        with_gradient(under("torch", lambda f: ops.gather_points(f, idx)), features),
        ("torch.gather", with_gradient(lambda f: f.gather(1, flat).view(*idx.shape, -1), features)),
    )
    gathered = ops.gather_points(features, idx)
    plain, ahead = under("torch", lambda f: ops.gather_points(f, idx))(features), torch.ones_like(gathered)
    yield (
        "gradient of the same alone",
        lambda: torch.autograd.grad(gathered, features, ahead, retain_graph=True)[0],
        lambda: torch.autograd.grad(plain, features, ahead, retain_graph=True)[0],
        ("-", None),
    )
    yield (
        "mean of the same, with gradient",
        with_gradient(lambda f: ops.gather_mean(f, idx), features),
        with_gradient(under("torch", lambda f: ops.gather_mean(f, idx)), features),
        ("torch.gather", with_gradient(lambda f: f.gather(1, flat).view(*idx.shape, -1).mean(2), features)),
    )
    query, points = (torch.randn(16, n, 3, generator=generator) for n in (1024, 512))
    values = torch.randn(16, 512, 88, generator=generator).requires_grad_()
    yield (
        "3-NN interpolation 16 x 512 -> 1024 x 88, with gradient",
        with_gradient(lambda f: ops.three_nn_interpolate(query, points, f), values),
        with_gradient(under("torch", lambda f: ops.three_nn_interpolate(query, points, f)), values),
        ("-", None),
    )


def rigid_rows() -> Iterator[tuple]:
    """What `segment predict` asks of four frames: eight slots' motions, and a layer of its network."""
    generator = torch.Generator().manual_seed(0)
    points, mask = torch.randn(4, 512, 3, generator=generator), torch.rand(4, 512, 8, generator=generator)
    moved = points @ ops.quaternion_to_matrix(torch.tensor([0.8, 0.6, 0.0, 0.0])).mT + 1.0
    motions = weighted_kabsch_reference(points, moved, mask)
    yield (
        "weighted Kabsch 4 x 512, 8 slots",
        lambda: ops.weighted_kabsch(points, moved, mask),
        lambda: weighted_kabsch_reference(points, moved, mask),
        ("-", None),
    )
    yield (
        "rigid flow 4 x 512, 8 slots",
        lambda: ops.rigid_flow(points, mask, *motions),
        lambda: rigid_flow_reference(points, mask, *motions),
        ("-", None),
    )
    index = ops.knn(points[:, ::4], points, 32)[1]
    weight = torch.relu(torch.rand(*index.shape, 13, generator=generator) - 0.75)  # three in four are zero
    slot = torch.stack([torch.randperm(13, generator=generator) for _ in range(12)])
    layer = (index, weight, slot, torch.randn(13 * 32, 64, generator=generator))
    features = torch.randn(4, 512, 12, 32, generator=generator).requires_grad_()
    yield (
        "SE(3) convolution 4 x 512, 12 rotations, with gradient",
        with_gradient(lambda f: kernel_convolution(f, *layer), features),
        with_gradient(lambda f: kernel_convolution_reference(f, *layer), features),
        ("-", None),
    )


def agree(ours: object, reference: object) -> str:
    """Identical indices, or values equal to rounding; anything else ends the bench."""
    pairs = [(ours, reference)] if isinstance(ours, torch.Tensor) else list(zip(ours, reference, strict=True))
    if all(torch.equal(a, b) for a, b in pairs):
        return "identical"
    if any(not a.is_floating_point() for a, b in pairs):
        sys.exit("indices differ from the reference")
    worst = max(float((a - b).abs().max() / b.abs().max()) for a, b in pairs)
    if worst > 1e-3:
        sys.exit(f"values differ from the reference by {worst:.1e} of the largest")
    return f"{worst:.0e}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeat", type=int, default=5)
    repeat = parser.parse_args().repeat
    keep_freed_memory()  # as `dpc` does: else pages that are new to each call take longer than their contents
    print(f"{torch.get_num_threads()} torch threads; median of {repeat} after one call; ms")
    print(f"{'operation':58} {'ours':>8} {'torch':>8} {'ratio':>6} {'results':>9}  instead")
    for rows in (fps_rows, ball_rows, knn_rows, value_rows, rigid_rows):
        for title, ours, reference, (other, theirs) in rows():
            results = agree(ours(), reference())
            fast, slow = median_ms(ours, repeat), median_ms(reference, repeat)
            instead = f"{other} {median_ms(theirs, repeat):.1f}" if theirs else "-"
            print(f"{title:58} {fast:8.2f} {slow:8.1f} {slow / fast:5.1f}x {results:>9}  {instead}", flush=True)


if __name__ == "__main__":
    main()
