"""`dpc prepare clouds` beside a plain loop of Open3D (of laspy for .las): one sequence of many scans, seconds and ratio.

python -m tests.bench.bench_clouds [--scans 100] [--points 100000]

Both begin in a fresh process and end with an HDF5 file of float32 points; the loop does nothing else.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import laspy
import numpy as np

from dpcli.ops.open3d_import import load_open3d

LOOP = """
import sys, h5py, numpy as np
from pathlib import Path
if sys.argv[1].endswith("las"):
    import laspy
    read = lambda path: laspy.read(path).xyz
else:
    from dpcli.ops.open3d_import import load_open3d
    open3d = load_open3d()
    read = lambda path: np.asarray(open3d.io.read_point_cloud(str(path)).points)
clouds = [read(path).astype(np.float32) for path in sorted(Path(sys.argv[1]).iterdir())]
with h5py.File(sys.argv[2], "w") as file:
    file["points"] = np.concatenate(clouds)
"""
FORMATS = ("ply", "ply as text", "pcd", "pcd compressed", "pcd as text", "las")


def write_scan(path: Path, form: str, points: np.ndarray) -> None:
    """Writes points f64 (N,3) in one of FORMATS."""
    if form == "las":
        las = laspy.create(point_format=0)
        las.header.scales = [1e-3] * 3
        las.x, las.y, las.z = points.T
        las.write(str(path))
        return
    open3d = load_open3d()
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    open3d.io.write_point_cloud(str(path), cloud, write_ascii="text" in form, compressed="compressed" in form)


def seconds(command: list[str]) -> float:
    """Returns how long a command takes."""
    start = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - start


def compare(form: str, scans: int, points: int, folder: Path) -> None:
    """Prints the seconds of both for one format, the smaller of two runs each, in turn."""
    raw = folder / form.replace(" ", "_").replace("ply_as_text", "text_ply")
    raw = raw.with_name(raw.name if form != "las" else "scans_las")
    raw.mkdir()
    rng = np.random.default_rng(0)
    for t in range(scans):
        write_scan(raw / f"{t:04d}.{form.split()[0]}", form, rng.normal(0, 20, (points, 3)))
    out = str(folder / "out.h5")
    ours = [sys.executable, "-m", "dpcli", "prepare", "clouds", str(raw), "-o", out, "--force"]
    theirs = [sys.executable, "-c", LOOP, str(raw), out]
    pairs = [(seconds(ours), seconds(theirs)) for _ in range(2)]
    own, other = (min(times) for times in zip(*pairs))
    print(f"{form:15} dpc {own:6.2f} s, loop {other:6.2f} s, ratio {other / own:.2f}", flush=True)


def main() -> None:
    """Compares all formats."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=100)
    parser.add_argument("--points", type=int, default=100_000)
    options = parser.parse_args()
    for form in FORMATS:
        with tempfile.TemporaryDirectory() as folder:
            compare(form, options.scans, options.points, Path(folder))


if __name__ == "__main__":
    main()
