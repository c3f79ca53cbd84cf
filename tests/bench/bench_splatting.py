"""Speed of the rasterizer, forward and backward: ours against plain torch, tile by tile, and how both grow.

    OMP_WAIT_POLICY=passive python -m tests.bench.bench_splatting [--repeat 10] [--without-torch]

Passive: torch's and numba's OpenMP threads otherwise spin for each other's cores, which made a step about seven times
slower on a busy two-core machine. Times are the least of several runs after a first (torch's: of two), which is what a
loaded machine shows best. The scene is a cube of random needles and discs. Covered are pairs of a pixel and a Gaussian
whose box holds it. The two must agree to 1e-3 of the largest gradient in all but a few values, or the bench ends.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable

import torch

from dpcli.ops.splatting.rasterization import rasterization, rasterization_reference
from tests.support.splatting_helpers import cameras, scene

ROWS = (
    (1_250, 256),
    (2_500, 256),
    (5_000, 256),
    (10_000, 256),
    (20_000, 256),
    (40_000, 256),
    (10_000, 64),
    (10_000, 128),
    (10_000, 512),
)
REFERENCE = ((2_500, 256), (10_000, 256))  # rows in which plain torch runs too


def step(function: Callable, tensors: list[torch.Tensor], views: list[torch.Tensor], size: int) -> tuple:
    """One rendering with its gradient: results and seconds forward, backward."""
    leaves = [t.clone().requires_grad_() for t in tensors]
    start = time.perf_counter()
    colors, alphas, notes = function(*leaves, *views, size, size)
    middle = time.perf_counter()
    incoming = [torch.ones_like(colors), torch.ones_like(alphas)]  # what a loss would hand over: not timed
    again = time.perf_counter()
    torch.autograd.backward([colors, alphas], incoming)
    times = middle - start, time.perf_counter() - again
    return [colors.detach(), *(leaf.grad for leaf in leaves)], notes, times


def least(function: Callable, *arguments: object, repeat: int) -> tuple:
    """Results, notes and the fastest of `repeat` runs in ms: forward, backward, both."""
    runs = [step(function, *arguments) for _ in range(repeat)]
    forward, backward = min((run[2] for run in runs), key=sum)
    return *runs[-1][:2], (1e3 * forward, 1e3 * backward, 1e3 * (forward + backward))


def covered(notes: dict) -> float:
    """Millions of pixels inside the boxes of the Gaussians."""
    center, radii = notes["means2d"].detach(), notes["radii"]
    low, high = center - radii, center + radii
    size = torch.tensor([notes["width"], notes["height"]])
    return float((torch.minimum(high, size) - low.clamp(min=0)).clamp(min=0).prod(-1).sum()) / 1e6


def agree(ours: list[torch.Tensor], reference: list[torch.Tensor]) -> None:
    for a, b in zip(ours, reference, strict=True):
        off = ((a - b).abs() > 1e-3 * b.abs().max()).double().mean()
        if off > 1e-3:
            sys.exit(f"results differ from the reference in {off:.1%} of the values")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeat", type=int, default=10)
    parser.add_argument(
        "--without-torch", action="store_true", help="leave out the reference, which takes seconds a run"
    )
    options = parser.parse_args()
    print(
        f"{torch.get_num_threads()} threads; least of {options.repeat} runs; ms; covered: millions of pixels in boxes"
    )
    print(
        f"{'Gaussians':>9} {'pixels':>9} {'covered':>7} {'forward':>8} {'backward':>8} {'both':>8} {'torch':>9} {'ratio':>7}"
    )
    for count, size in ROWS:
        tensors = [
            t.float() for t in scene(count, scale=0.9 * count**-0.5)
        ]  # together they cover as much at any number
        views = [v.float() for v in cameras(1, size, size)]
        step(rasterization, tensors, views, size)
        ours, notes, times = least(rasterization, tensors, views, size, repeat=options.repeat)
        line = f"{count:9} {size:4}x{size:<4} {covered(notes):7.2f} " + " ".join(f"{t:8.1f}" for t in times)
        if (count, size) in REFERENCE and not options.without_torch:
            reference, _, slow = least(rasterization_reference, tensors, views, size, repeat=2)
            agree(ours, reference)
            line += f" {slow[2]:9.0f} {slow[2] / times[2]:6.0f}x"
        print(line, flush=True)


if __name__ == "__main__":
    main()
