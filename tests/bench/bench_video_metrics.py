"""Speed of PSNR + SSIM: ours against torchmetrics and scikit-image, and against our float64 reference.

    python -m tests.bench.bench_video_metrics [--frames 1000] [--side 512] [--others 20]

Ours is the whole streaming path of `dpc evaluate video` behind the decoder: 8-bit RGBA in, composited on white, PSNR
and SSIM, one frame per thread. The others get float tensors that are ready, conversion not counted. All compute SSIM
11x11, sigma 1.5; every rate is checked to be of the same number, or the bench fails. The others run on fewer frames
(their rate doesn't depend on it), in turn with blocks of ours; minimum time per frame counts, since the machine may be
busy.
"""

from __future__ import annotations

import argparse
import importlib.util
import resource
import sys
import time
from collections.abc import Callable

import numpy as np
import torch

from dpcli.evaluate.results import merge_statistics
from dpcli.evaluate.video.frame_pass import in_threads
from dpcli.evaluate.video.picture_statistics import picture_compute
from dpcli.evaluate.video.protocol import VideoProtocol, score_frame
from dpcli.evaluate.video.sources.source import Picture
from dpcli.runtime.progress import Progress, log
from tests.support.picture_metrics import ssim_reference

_BLOCK = 25  # frames timed at once


def pictures(side: int) -> tuple[np.ndarray, np.ndarray]:
    """A smooth object on a transparent ground, u8 (H,W,4), and a noisy copy."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[-1 : 1 : side * 1j, -1 : 1 : side * 1j]
    truth = np.empty((side, side, 4), np.uint8)
    truth[..., :3] = 127 + 120 * np.sin(7 * x[..., None] + np.arange(3) * y[..., None] * 5)
    truth[..., 3] = 255 * (x * x + y * y < 0.5)
    noisy = truth.copy()
    noisy[..., :3] = np.clip(truth[..., :3] + rng.normal(0, 12, (side, side, 3)), 0, 255)
    return noisy, truth


def ours(pair: tuple[np.ndarray, np.ndarray], frames: int, border: str) -> tuple[float, float]:
    protocol = VideoProtocol("bench", border=border)
    jobs = (
        (lambda f=f: score_frame(f, Picture(rgba=pair[0]), Picture(rgba=pair[1]), protocol, ("psnr", "ssim")))
        for f in range(frames)
    )
    found = picture_compute(merge_statistics(in_threads(jobs, Progress("bench", None))))
    return found.psnr, found.ssim


def others(pair: tuple[np.ndarray, np.ndarray]) -> dict[str, tuple[str, Callable[[], tuple[float, float]]]]:
    """name -> (SSIM border, function of one frame)."""
    planes = [Picture(rgba=rgba).over((1, 1, 1)) for rgba in pair]
    made: dict[str, tuple[str, Callable]] = {}
    if importlib.util.find_spec("torchmetrics"):
        from torchmetrics.functional.image import peak_signal_noise_ratio as tm_psnr
        from torchmetrics.functional.image import structural_similarity_index_measure as tm_ssim

        p, t = (torch.from_numpy(plane)[None] for plane in planes)
        made["torchmetrics"] = (
            "reflect",
            lambda: (float(tm_psnr(p, t, data_range=1.0)), float(tm_ssim(p, t, data_range=1.0))),
        )
    if importlib.util.find_spec("skimage"):
        from skimage.metrics import peak_signal_noise_ratio as sk_psnr
        from skimage.metrics import structural_similarity as sk_ssim

        a, b = planes
        how = {
            "gaussian_weights": True,
            "sigma": 1.5,
            "use_sample_covariance": False,
            "channel_axis": 0,
            "data_range": 1,
        }
        made["scikit-image"] = ("valid", lambda: (sk_psnr(b, a, data_range=1), float(sk_ssim(b, a, **how))))
    made["our reference"] = ("valid", lambda: (np.nan, ssim_reference(*(np.moveaxis(p, 0, -1) for p in planes))))
    return made


def timed(function: Callable[[], tuple[float, float]]) -> tuple[float, tuple[float, float]]:
    start = time.perf_counter()
    value = function()
    return time.perf_counter() - start, value


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--side", type=int, default=512)
    parser.add_argument("--others", type=int, default=20)
    asked = parser.parse_args()
    log.level = 0
    pair = pictures(asked.side)
    expected = {border: ours(pair, 2, border) for border in ("valid", "reflect")}  # compiles
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    whole, _ = timed(lambda: ours(pair, asked.frames, "valid"))
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    print(
        f"{asked.frames} frames of {asked.side}x{asked.side} RGB: {whole:.2f} s = {asked.frames / whole:.0f} frames/s; "
        f"memory grew by {grown:.0f} MiB; {torch.get_num_threads()} torch threads"
    )
    print(f"{'':16} {'frames/s':>9} {'ours':>7} {'ratio':>6}  SSIM agrees to")
    for name, (border, function) in others(pair).items():
        function()
        best = {"ours": np.inf, "theirs": np.inf}
        for _ in range(asked.others):
            seconds, (psnr, ssim) = timed(function)
            best["theirs"] = min(best["theirs"], seconds)
            best["ours"] = min(best["ours"], timed(lambda b=border: ours(pair, _BLOCK, b))[0] / _BLOCK)
        apart = abs(ssim - expected[border][1])
        if apart > 1e-4 or abs(psnr - expected[border][0]) > 1e-3:
            sys.exit(f"{name} finds another value: {psnr} {ssim}, ours {expected[border]}")
        print(
            f"{name:16} {1 / best['theirs']:9.1f} {1 / best['ours']:7.1f} {best['theirs'] / best['ours']:5.1f}x  {apart:.0e}"
        )


if __name__ == "__main__":
    main()
