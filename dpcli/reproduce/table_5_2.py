"""Table 5.2 of the thesis on animated meshes: rows (a) to (e), each fitted and scored by `dpc` commands.

    python -m dpcli.reproduce.table_5_2 MESHES OUT [--clips Cow:Gallop,...] [--size 128] [--jobs 2]

MESHES: a folder of .glb files (searched below it). Every fit sees the input view and four more views of the animation;
scores are from four azimuths that no fit sees. What is done already is not done again.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from dpcli.reproduce import runs

OFF = {  # settings that a row switches off
    "(a) non-rigid motion only": ("rigid", "sparse"),
    "(b) + rigid motion, spatial cue": ("temporal", "fusion", "sparse"),
    "(c) + temporal cue": ("fusion", "sparse"),
    "(d) + weighted fusion": ("sparse",),
    "(e) + dense to sparse": (),
}
THESIS = {"(a)": (22.3, 0.795), "(b)": (25.3, 0.841), "(c)": (28.5, 0.875), "(d)": (29.7, 0.894), "(e)": (30.2, 0.908)}
CLIPS = "Cow:Gallop,Fox:Walk,Trex:TRex_Run,Spider:Spider_Walk"


dpc = partial(runs.dpc, threads=1)  # a clip each in as many processes as there are cores


def film(meshes: Path, clip: str, out: Path, size: int) -> Path:
    """The views file of `Model:Clip`."""
    model, motion = clip.split(":")
    found = sorted(meshes.rglob(f"{model}.glb"))
    if not found:
        sys.exit(f"{meshes}: no {model}.glb in it")
    path = out / f"{model}-{motion}.h5"
    if not path.exists():
        dpc(
            "prepare",
            "animation",
            found[0],
            "--clip",
            motion,
            "-o",
            path,
            "--size",
            size,
            "--yaw",
            90,
            "--train-azimuths",
            "15,-75,105,195",
            "--azimuths",
            "60,-30,150,240",
        )
    return path


def score(views: Path, row: str, out: Path, steps: tuple[int, int], seed: int) -> dict:
    """Fit one row to one clip and score it; from the file when that was done before."""
    scene = out / f"{views.stem}{row[:3]}seed{seed}.h5"
    result = scene.with_suffix(".json")
    if not result.exists():
        if not scene.exists():
            settings = [f"dense_steps={steps[0]}", f"sparse_steps={steps[1]}", "most_gaussians=6000"]
            settings += [f"{switch}=false" for switch in OFF[row]]
            words = [word for value in settings for word in ("--set", value)]
            dpc(
                "generate4d", "fit", views, "-o", scene, "--preset", "quick", "--prior", "views", "--seed", seed, *words
            )
        text = dpc("evaluate", "video", scene, "--truth", views, "--metrics", "psnr,ssim,parts,tracks", "--json")
        result.write_text(text)
    return json.loads(result.read_text())["metrics"]


def _mean(values: list[dict], *keys: str) -> float:
    """Mean over clips of the number that the keys lead to."""
    total = 0.0
    for value in values:
        for key in keys:
            value = value[key]
        total += value
    return total / len(values)


def table(scores: dict[str, list[dict]], clips: int) -> str:
    """Markdown, one line per row, means over clips; the thesis's values beside, on its own data and protocol."""
    lines = [
        f"Means over {clips} clips; views that no fit sees. Thesis: its own data, reference view.",
        "",
        "| row | PSNR new views | SSIM new views | PSNR reference | parts, ARI | tracks, EPE / diameter | thesis PSNR | thesis SSIM |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row, values in scores.items():
        psnr, ssim = THESIS[row[:3]]
        lines.append(
            f"| {row} | {_mean(values, 'per_role', 'test', 'psnr'):.2f} | {_mean(values, 'per_role', 'test', 'ssim'):.4f} |"
            f" {_mean(values, 'per_role', 'reference', 'psnr'):.2f} | {_mean(values, 'parts', 'adjusted_rand_index'):.3f} |"
            f" {_mean(values, 'tracks', 'epe_of_diameter'):.4f} | {psnr} | {ssim} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Fits and scores the rows that the command line asks for, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("meshes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--clips", default=CLIPS)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--steps", default="300,500")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    steps = tuple(int(word) for word in given.steps.split(","))
    views = [film(given.meshes, clip, given.out, given.size) for clip in given.clips.split(",")]
    with ThreadPoolExecutor(given.jobs) as pool:
        running = {row: [pool.submit(score, path, row, given.out, steps, given.seed) for path in views] for row in OFF}
        scores = {row: [job.result() for job in jobs] for row, jobs in running.items()}
    text = table(scores, len(views))
    (given.out / "table.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
