"""Speed and memory of `dpc prepare` against what a user would write: NumPy per frame and Open3D's sampling.

    python -m tests.bench.bench_prepare RAW [--subset 20] [--jobs 2]

RAW holds `msraction3d/` and `nvgesture/` (either may be absent). Both sides read the same raw files, keep the same
pixels, sample the same number of points per frame by farthest point sampling and write one HDF5 file. The plain
pipeline runs over every k-th video (`--subset` of them) in one process, as such scripts do; its imports are not
counted, those of `dpc` are. Other work on the machine slows both sides, but the one that needs two cores more.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np

POINTS = {"msraction3d": 2048, "nvgesture": 512}


def run_dpc(name: str, raw: Path, output: Path, jobs: int, *extra: str) -> tuple[float, int, float]:
    """Seconds from start to exit, frames, and peak resident MiB of all processes together of one conversion."""
    command = [sys.executable, "-m", "dpcli", "prepare", name, str(raw), "-o", str(output), "--force", "-q"]
    start, peak = time.perf_counter(), 0.0
    process = subprocess.Popen(
        [*command, "--jobs", str(jobs), *extra], stdout=subprocess.DEVNULL, start_new_session=True
    )
    while process.poll() is None:
        peak = max(peak, resident(process.pid))
        time.sleep(0.1)
    seconds = time.perf_counter() - start
    if process.returncode:
        sys.exit(f"dpc prepare {name} failed")
    with h5py.File(output) as file:
        return seconds, len(file["frame_offsets"]) - 1, peak


def resident(session: int) -> float:
    """MiB that the processes of a session hold; pages that they share are counted once per process (Linux)."""
    total = 0
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            if int(fields[3]) == session:
                total += int(fields[21])
        except (OSError, IndexError):
            continue  # it ended meanwhile
    return total * resource.getpagesize() / 2**20


def plain_msraction3d(items: list, points: int, output: Path) -> int:
    """A script as one writes it: loadmat, one frame at a time, float64, Open3D samples."""
    from scipy.io import loadmat

    frames = 0
    with h5py.File(output, "w") as file:
        for item in items:
            depth = loadmat(item.path)["depth"]
            clouds = []
            for t in range(depth.shape[2]):
                frame = depth[:, :, t]
                v, u = np.nonzero(frame)
                z = frame[v, u].astype(float)
                cloud = np.stack([(u - 160) / 280 * z, (v - 120) / 280 * z, z], axis=1) / 300
                clouds.append(sampled(cloud, points))
            file[item.name] = np.concatenate(clouds).astype(np.float32)
            frames += len(clouds)
    return frames


def plain_nvgesture(items: list, points: int, output: Path) -> int:
    """The same for NvGesture: OpenCV decodes and finds the hand, Open3D samples."""
    import cv2

    frames = 0
    with h5py.File(output, "w") as file:
        for item in items:
            capture, clouds, t = cv2.VideoCapture(str(item.path)), [], 0
            while t < item.extra["stop"]:
                ok, image = capture.read()
                t += 1
                if not ok or t <= item.extra["start"]:
                    continue
                frame = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
                _, mask = cv2.threshold(frame, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
                _, labels, statistics, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
                if len(statistics) < 2:
                    continue
                mask = (labels == 1 + np.argmax(statistics[1:, 4])).astype(np.uint8)
                v, u = np.nonzero(cv2.erode(mask, np.ones((3, 3), np.uint8)))
                if len(v):
                    clouds.append(sampled(np.stack([v, u, frame[v, u]], axis=1).astype(float), points))
            file[item.name] = np.concatenate(clouds).astype(np.float32)
            frames += len(clouds)
    return frames


def sampled(cloud: np.ndarray, points: int) -> np.ndarray:
    """Open3D's farthest point sampling of one frame."""
    from dpcli.ops.open3d_import import load_open3d

    open3d = load_open3d()
    if len(cloud) <= points:
        return cloud
    pcd = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud))
    return np.asarray(pcd.farthest_point_down_sample(points).points)


def compare(name: str, raw: Path, folder: Path, subset: int, jobs: int) -> None:
    """One data set: our pipeline over all of it, the plain one over a subset, their ratio; then memory."""
    from dpcli.prepare.actions.msraction3d import MSRAction3D
    from dpcli.prepare.actions.nvgesture import NvGesture

    points = POINTS[name]
    items = (MSRAction3D if name == "msraction3d" else NvGesture)(raw).items()
    some = items[:: max(1, len(items) // subset)][:subset] if len(items) > 2 * subset else items
    thin = ("--points", str(points), "--sampling", "fps")
    run_dpc(name, raw, folder / "warm.h5", jobs, *thin, "--limit", "2")  # compiles the kernels once
    plain = plain_msraction3d if name == "msraction3d" else plain_nvgesture
    sampled(np.random.default_rng(0).random((100, 3)), 10)  # the imports are not counted against it
    start = time.perf_counter()
    plain_frames = plain(some, points, folder / "plain.h5")
    plain_rate = plain_frames / (time.perf_counter() - start)
    seconds, frames, peak = run_dpc(name, raw, folder / "all.h5", jobs, *thin)
    start_up = run_dpc(name, raw, folder / "two.h5", jobs, *thin, "--limit", "2")[0]
    rate, steady = frames / seconds, frames / (seconds - start_up)
    print(f"{name}: {len(items)} videos, farthest point sampling to {points} points per frame")
    print(f"  plain NumPy + Open3D, {len(some)} videos, {plain_frames} frames: {plain_rate:8.1f} frames/s")
    print(f"  dpc --jobs {jobs}, all {frames} frames, start included:    {rate:8.1f} frames/s")
    print(f"  ratio {rate / plain_rate:.1f} (target >= 5); {steady / plain_rate:.1f} without {start_up:.1f} s of start")
    half = len(items) // 2
    _, _, half_peak = run_dpc(name, raw, folder / "half.h5", jobs, *thin, "--limit", str(half))
    print(f"  peak memory of all processes: {half_peak:.0f} MiB for {half} videos, {peak:.0f} MiB for {len(items)}")
    seconds, frames, _ = run_dpc(name, raw, folder / "keep.h5", jobs)
    print(f"  all points kept: {frames / seconds:.1f} frames/s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("raw", type=Path, help="a folder of msraction3d/ and nvgesture/, or one of them")
    parser.add_argument("--subset", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    found = {name: options.raw / name for name in POINTS if (options.raw / name).is_dir()}
    if not found:  # RAW may be one data set's own folder
        name = "nvgesture" if (options.raw / "Video_data").is_dir() else "msraction3d"
        found = {name: options.raw}
    for name, raw in found.items():
        with tempfile.TemporaryDirectory() as folder:
            compare(name, raw, Path(folder), options.subset, options.jobs)


if __name__ == "__main__":
    main()
