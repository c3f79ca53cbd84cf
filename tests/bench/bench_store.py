"""Speed of the file and of the way to it: conversion against decoding alone, random clips, compressions.

    python -m tests.bench.bench_store [MSRACTION] [--videos 160] [--jobs 2]

Sources of 16-bit PNG folders and FFV1 .avi are made here, 320 x 240 with a person's share of pixels; MSRACTION names a
folder of MSR-Action3D for the compressions (its first videos; without it the made ones). Everything is warm: read from
the page cache; the fastest of two. Other work on the machine slows the side that needs two cores more.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from dpcli.store import CloudSequence, CloudsReader, CloudsWriter

FRAMES, HEIGHT, WIDTH = 40, 240, 320


def make_depth(seed: int) -> np.ndarray:
    """u16 (T,H,W), millimeters: a smooth moving shape with sensor noise on an empty background."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    video = np.zeros((FRAMES, HEIGHT, WIDTH), np.uint16)
    for t in range(FRAMES):
        x, y = WIDTH * (0.35 + 0.3 * t / FRAMES), HEIGHT / 2
        distance = ((u - x) / (0.14 * WIDTH)) ** 2 + ((v - y) / (0.42 * HEIGHT)) ** 2
        depth = 2500 - 200 * np.sqrt(np.clip(1 - distance, 0, 1)) + rng.normal(0, 4, distance.shape)
        video[t] = np.where(distance < 1, depth, 0)
    return video


def write_sources(folder: Path, videos: int) -> dict[str, Path]:
    """`png`: a folder of folders of 16-bit PNG; `avi`: a folder of FFV1 videos of the same frames, 16 bits."""
    import cv2

    from tests.support.prepare_helpers import write_video

    for number in range(videos):
        depth = make_depth(number)
        place = folder / "png" / f"v{number:03}"
        place.mkdir(parents=True)
        for t, frame in enumerate(depth):
            cv2.imwrite(str(place / f"{t:04}.png"), frame)
        write_video(folder / "avi" / f"v{number:03}.avi", depth)
    return {"png": folder / "png", "avi": folder / "avi"}


def decode(path: Path) -> int:
    """Frames of one video, decoded as the reader decodes them and dropped."""
    from dpcli.prepare.decode.depth_files import read_image, read_video

    if path.is_dir():
        return sum(read_image(image) is not None for image in sorted(path.iterdir()))
    return len(read_video(path)[0])


def decode_plain(path: Path) -> int:
    """The same as a script of one's own would: OpenCV's imread, file by file."""
    import cv2

    if path.is_dir():
        return sum(cv2.imread(str(image), cv2.IMREAD_UNCHANGED) is not None for image in sorted(path.iterdir()))
    return decode(path)


def _one_thread() -> None:
    import cv2

    cv2.setNumThreads(1)


def decoding_alone(source: Path, jobs: int, decode: Callable[[Path], int] = decode) -> float:
    """Seconds to decode every video in `jobs` processes that run already and have imported what they need."""
    paths = sorted(source.iterdir())
    with ProcessPoolExecutor(jobs, get_context("forkserver"), initializer=_one_thread) as pool:
        list(pool.map(decode, paths[: 2 * jobs]))
        start = time.perf_counter()
        list(pool.map(decode, paths))
        return time.perf_counter() - start


def conversion(source: Path, output: Path, jobs: int, *extra: str) -> float:
    """Seconds of the whole command."""
    words = [sys.executable, "-m", "dpcli", "prepare", "depth", str(source), "-o", str(output), "-q"]
    output.unlink(missing_ok=True)  # to give a large old file back takes a while, too
    start = time.perf_counter()
    subprocess.run([*words, "--jobs", str(jobs), *extra], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start


def bench_conversion(folder: Path, videos: int, jobs: int) -> None:
    print(f"conversion against decoding alone, {videos} videos of {FRAMES} frames {WIDTH}x{HEIGHT}, --jobs {jobs}")
    sources = write_sources(folder, videos)
    for name, source in sources.items():
        plain = min(decoding_alone(source, jobs, decode_plain) for _ in range(2))
        alone = min(decoding_alone(source, jobs) for _ in range(2)) if name == "png" else plain
        print(f"  {name}: decoding alone by OpenCV {plain:5.2f} s, as the reader does it {alone:5.2f} s")
        for kept, words in (("all points", ()), ("2,048 a frame", ("--points", "2048", "--sampling", "random"))):
            started = min(conversion(source, folder / "few.h5", jobs, "--limit", str(jobs), *words) for _ in range(2))
            whole = min(conversion(source, folder / "all.h5", jobs, *words) for _ in range(2))
            steady = (whole - started) * videos / max(videos - jobs, 1)
            print(
                f"  {name}, {kept}: conversion {whole:5.2f} s of which {started:4.2f} s to start and end; without those "
                f"{steady / plain:4.2f}x OpenCV's decoding (target 1.1-1.3), {steady / alone:4.2f}x the reader's; "
                f"with them {whole / plain:4.2f}x and {whole / alone:4.2f}x"
            )


def _clips(path: Path, seed: int, seconds: float) -> tuple[int, float]:
    rng, count, reader = np.random.default_rng(seed), 0, CloudsReader(path)
    start = time.perf_counter()
    while time.perf_counter() - start < seconds:
        index = int(rng.integers(len(reader)))
        first = int(rng.integers(reader.frame_counts[index] - 24 + 1))
        count += len(reader.read(index, slice(first, first + 24)).points) == 24 * 2048
    return count, time.perf_counter() - start


def bench_clips(folder: Path, processes: int = 2) -> None:
    rng = np.random.default_rng(0)
    for compression in ("none", "lzf", "gzip"):
        path = folder / f"clips-{compression}.h5"
        with CloudsWriter(path, compression=compression) as writer:
            for k in range(40):
                frames = [rng.normal(size=(2048, 3)).astype(np.float32) for _ in range(60)]
                writer.write(CloudSequence.from_frames(f"v{k}", frames))
        _clips(path, 0, 1.0)
        with ProcessPoolExecutor(processes, get_context("forkserver")) as pool:
            results = list(pool.map(_clips, [path] * processes, range(processes), [3.0] * processes))
        rate = sum(count / seconds for count, seconds in results)
        print(
            f"  --compression {compression}: {rate:6.0f} random clips of 24 frames x 2,048 points per second, "
            f"{processes} processes (target >= 300)"
        )


def depth_sequences(raw: Path | None, count: int) -> list[CloudSequence]:
    """Clouds of depth videos in raster order."""
    if raw is None:
        from dpcli.prepare.decode.pinhole_camera import Intrinsics

        camera, found = Intrinsics(280, 280, WIDTH / 2, HEIGHT / 2), []
        for seed in range(count):
            depth = make_depth(seed)
            t, v, u = np.nonzero(depth)
            z = depth[t, v, u] / 1000
            points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], 1)
            frames = np.split(points.astype(np.float32), np.cumsum(np.bincount(t))[:-1])
            found.append(CloudSequence.from_frames(f"v{seed}", frames))
        return found
    from dpcli.prepare.actions.msraction3d import MSRAction3D

    reader = MSRAction3D(raw)
    items = reader.items()
    rng = np.random.default_rng(0)
    return [reader.read(item, rng).sequence for item in items[:: max(1, len(items) // count)][:count]]


def bench_compression(folder: Path, raw: Path | None, count: int) -> None:
    sequences = depth_sequences(raw, count)
    size = sum(sequence.points.nbytes for sequence in sequences)
    print(
        f"compression of depth clouds in raster order, {len(sequences)} videos of "
        f"{'MSR-Action3D' if raw else 'made depth'}, {size / 1e6:.0f} MB of points"
    )
    for compression in ("none", "lzf", "gzip"):
        path = folder / f"{compression}.h5"
        start = time.perf_counter()
        with CloudsWriter(path, compression=compression, force=True) as writer:
            for sequence in sequences:
                writer.write(sequence)
        written = time.perf_counter() - start
        start = time.perf_counter()
        with CloudsReader(path) as reader:
            for index in range(len(reader)):
                reader.read(index)
        read = time.perf_counter() - start
        print(
            f"  {compression:5}: ratio {size / path.stat().st_size:4.2f}, write {size / written / 1e6:6.0f} MB/s, "
            f"read {size / read / 1e6:6.0f} MB/s"
        )


def bench_small_samples(folder: Path, samples: int = 1000) -> None:
    """What safety costs per sample: 4 frames of 512 points, as the articulated sets have."""
    frames = [np.random.default_rng(0).normal(size=(512, 3)).astype(np.float32) for _ in range(4)]
    for resume in (False, True):
        start = time.perf_counter()
        with CloudsWriter(folder / "small.h5", force=True, resume=resume) as writer:
            for k in range(samples):
                writer.write(CloudSequence.from_frames(f"s{k}", frames))
        seconds = time.perf_counter() - start
        print(
            f"  {samples} samples of 4 x 512 points, {'with' if resume else 'without'} a journal: {samples / seconds:6.0f}/s"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("raw", type=Path, nargs="?", help="a folder of MSR-Action3D")
    parser.add_argument("--videos", type=int, default=160)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    raw = options.raw
    if raw is not None and (raw / "msraction3d").is_dir():
        raw = raw / "msraction3d"
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as folder:
        bench_conversion(Path(folder), options.videos, options.jobs)
    with tempfile.TemporaryDirectory() as folder:
        print("random clips, warm cache")
        bench_clips(Path(folder))
        bench_compression(Path(folder), raw, 8)
        print("the writer")
        bench_small_samples(Path(folder))


if __name__ == "__main__":
    main()
