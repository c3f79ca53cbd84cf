"""Table 5.2 of the thesis on animated meshes: rows (a) to (e), each fitted and scored by `dpc` commands.

    python -m dpcli.reproduce.scenes.table_5_2 MESHES OUT [--clips Cow:Gallop,...] [--size 128] [--prior views] [--jobs 2]

MESHES: a folder of .glb files (searched below it). With --prior views every fit sees the input view and four more views of
the animation, with another prior the input view alone; scores are from four azimuths that no fit sees. What is done already
is not done again.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Mapping, Sequence
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
CLIPS = "Cow:Gallop,Fox:Walk,Trex:TRex_Run,Spider:Spider_Walk"


dpc = partial(runs.dpc, threads=1)  # a clip each in as many processes as there are cores


def film(meshes: Path, clip: str, out: Path, size: int) -> Path:
    """Returns the views file of `Model:Clip`; `dpc prepare` passes over what is there."""
    model, motion = clip.split(":")
    found = sorted(meshes.rglob(f"{model}.glb"))
    if not found:
        sys.exit(f"{meshes}: no {model}.glb in it")
    path = out / f"{model}-{motion}.h5"
    cameras = ("--yaw", 90, "--train-azimuths", "15,-75,105,195", "--azimuths", "60,-30,150,240")
    dpc("prepare", "animation", found[0], "--clip", motion, "-o", path, "--size", size, *cameras)
    return path


def score(views: Path, name: str, settings: Sequence[str], given: argparse.Namespace) -> dict:
    """Returns the scores of one fit to one clip, made where that was not done before by the same words.

    name: of the fit, in its files' names; settings: what it changes, each `NAME=VALUE`.
    """
    prior = "" if given.prior == "views" else given.prior
    scene = given.out / f"{views.stem}{name}{prior}seed{given.seed}.h5"
    dense, sparse = given.steps
    settings = [f"dense_steps={dense}", f"sparse_steps={sparse}", "max_gaussians=6000", *settings]
    words = [word for value in settings for word in ("--set", value)]
    words = ["--preset", "quick", "--prior", given.prior, "--seed", given.seed, *words]

    def work() -> dict:
        dpc("generate4d", "fit", views, "-o", scene, *words)
        text = dpc("evaluate", "video", scene, "--truth", views, "--metrics", "psnr,ssim,parts,tracks", "--json")
        told = json.loads(text)
        return {**told["metrics"], "counts": told["denominators"]}

    return runs.once(scene.with_suffix(".json"), [runs.digest(views), *words], work)


def mean_score(values: list[dict], *keys: str) -> float:
    """Returns the mean over clips of the number that the keys lead to."""
    total = 0.0
    for value in values:
        for key in keys:
            value = value[key]
        total += value
    return total / len(values)


def table(scores: dict[str, list[dict]], clips: int) -> str:
    """Returns Markdown, one line per row, means over clips; the thesis's values stand beside, on its own data and protocol."""
    lines = [
        f"Means over {clips} clips; views that no fit sees. Thesis: its own data, reference view.",
        "",
        "| row | PSNR novel views | SSIM novel views | PSNR reference | parts, ARI | tracks, EPE / diameter | thesis PSNR | thesis SSIM |",
        "|---|---|---|---|---|---|---|---|",
    ]
    thesis = {row["method"].split()[-1]: row["values"] for row in runs.thesis_rows("5.2")}
    for row, values in scores.items():
        psnr, ssim = thesis[row[:3]][:2]
        lines.append(
            f"| {row} | {mean_score(values, 'per_role', 'test', 'psnr'):.2f} | {mean_score(values, 'per_role', 'test', 'ssim'):.4f} |"
            f" {mean_score(values, 'per_role', 'reference', 'psnr'):.2f} | {mean_score(values, 'parts', 'adjusted_rand_index'):.3f} |"
            f" {mean_score(values, 'tracks', 'epe_of_diameter'):.4f} | {psnr} | {ssim} |"
        )
    return "\n".join(lines)


def _clips(text: str) -> list[str]:
    clips = text.split(",")
    if not all(all(clip.partition(":")[::2]) for clip in clips):
        raise argparse.ArgumentTypeError(f"{text!r}: expected MODEL:CLIP,... such as Cow:Gallop,Fox:Walk")
    return clips


def _steps(text: str) -> list[int]:
    try:
        dense, sparse = map(int, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: expected two numbers, DENSE,SPARSE such as 300,500") from None
    return [dense, sparse]


def parser_of(description: str | None) -> argparse.ArgumentParser:
    """Returns the words that a program of fits to animated meshes takes."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--clips", type=_clips, default=CLIPS, metavar="MODEL:CLIP,...")
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--steps", type=_steps, default="300,500", metavar="DENSE,SPARSE")
    parser.add_argument("--prior", default="views")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    return parser


def fit_all(given: argparse.Namespace, fits: Mapping[str, tuple[str, Sequence[str]]]) -> dict[str, list[dict]]:
    """Returns the scores of all clips for each fit. fits: row -> name in the files, settings (see `score`)."""
    given.out.mkdir(parents=True, exist_ok=True)
    views = [film(given.meshes, clip, given.out, given.size) for clip in given.clips]
    work = {
        row: [partial(score, path, name, settings, given) for path in views] for row, (name, settings) in fits.items()
    }
    return runs.side_by_side(work, given.jobs)


def main() -> None:
    """Fits and scores all rows, and prints the table."""
    given = parser_of(__doc__).parse_args()
    rows = {row: (row[:3], [f"{switch}=false" for switch in off]) for row, off in OFF.items()}
    text = table(fit_all(given, rows), len(given.clips))
    (given.out / "table.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
