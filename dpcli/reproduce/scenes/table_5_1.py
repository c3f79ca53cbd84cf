"""Table 5.1 of the thesis: 4D scenes of one view, on ARTEMIS or on animated meshes, each row made and scored by `dpc`.

    python -m dpcli.reproduce.scenes.table_5_1 OUT --meshes FOLDER [--clips animals_pack/Fox.glb:Walk,...] [-- --preset fast]
    python -m dpcli.reproduce.scenes.table_5_1 OUT --artemis FOLDER

Meshes are filmed in profile and from the front. The rows `flat` and `inflated` are no fits: every frame's layers, drawn
from the truth's cameras. Scores of the sides are from views that no row sees. What is done already is not done again.
"""

from __future__ import annotations

import argparse
import json
import sys
from functools import partial
from pathlib import Path

import numpy as np

from dpcli.generate4d.shape.guidance import ShapeGuidance
from dpcli.generate4d.shape.layers import ShapePrior
from dpcli.generate4d.shape.silhouette import Flat, Inflated
from dpcli.generate4d.targets import load_targets
from dpcli.reproduce import runs
from dpcli.reproduce.scenes.prior_sides import CLIPS, find_model
from dpcli.store.views import ViewsReader, ViewsWriter

LAYERS: dict[str, ShapePrior] = {"flat": Flat(), "inflated": Inflated()}
FITS = {"none": "no prior", "inflated": "inflated prior", "auto": "prior", "views": "four given views"}
YAW = {"profile": 90, "front": 0}
PICTURES = ("psnr", "psnr_foreground", "ssim", "silhouette_iou")
LEARNED = ("lpips", "fvd", "fid_vid_r3d50", "clip")
THESIS = "MotionStruct4D, thesis: its 25 clips of ARTEMIS-DFA, 512 pixels | 30.68 |  | .925 |  | .134 | 769.39 | 19.67 | .919"

dpc = partial(runs.dpc, threads=1)  # a clip each in as many processes as there are cores


def film_mesh(meshes: Path, word: str, side: str, out: Path, size: int, frames: int) -> Path:
    """Returns the views file of `MODEL.glb:CLIP`, filmed from a side of YAW; `dpc prepare` passes over what is there."""
    model, clip = word.split(":")
    path = out / f"{model.replace('/', '-').removesuffix('.glb')}-{clip}-{side}.h5"
    turned = ("--clip", clip, "--yaw", YAW[side], "--train-azimuths", "60,-30,150,-120")
    words = ("--size", size, "--frames", frames, "--jobs", 1, *turned)
    dpc("prepare", "animation", find_model(meshes, model), "-o", path, *words)
    return path


def film_artemis(folder: Path, out: Path, size: int, frames: int) -> list[Path]:
    """Returns the views file of every motion of every animal below an ARTEMIS folder."""
    made = []
    for animal in sorted(path.parent for path in folder.glob("*/CamPose.inf")):
        for motion in sorted(path.name for path in animal.glob("img/*") if path.is_dir()):
            path = out / f"{animal.name}-{motion}-artemis.h5"
            words = ("--motion", motion, "--size", size, "--frames", frames)
            dpc("prepare", "artemis", animal, "-o", path, *words)
            made.append(path)
    if not made:
        sys.exit(
            f"{folder}: no ANIMAL/CamPose.inf with ANIMAL/img/MOTION in it; expected the folder of ARTEMIS' animals"
        )
    return made


def draw_layers(prior: ShapePrior, views: Path, output: Path) -> None:
    """Writes what all cameras of a views file see of the layers that a prior finds in its reference view."""
    import torch

    with ViewsReader(views) as reader:
        head = reader.header
    guidance = ShapeGuidance(prior, load_targets(views, max(head.size), ()), side=max(head.size))
    poses, lenses = (torch.from_numpy(np.asarray(x)).float() for x in (head.world_to_camera, head.intrinsics))
    with ViewsWriter(output, head) as writer:
        for view, frame in np.ndindex(head.num_views, head.num_frames):
            seen = guidance.splats[frame].draw(poses[view], lenses[view], *head.size)
            seen[..., :3] /= seen[..., 3:].clamp(min=1e-3)
            writer.add(view, frame, (seen.clamp(0, 1) * 255).round().byte().numpy())


def score(views: Path, row: str, words: tuple[str, ...], learned: bool) -> dict:
    """Returns the metrics of a row on a clip; made and scored where that was not done before by the same words."""
    made = views.with_name(f"{views.stem}.{row.replace(' ', '-')}.h5")

    def work() -> dict:
        if row in LAYERS:
            made.unlink(missing_ok=True)
            draw_layers(LAYERS[row], views, made)
        else:
            prior = next(name for name, title in FITS.items() if title == row)
            if prior == "views" and not _has_train(views):
                return {}
            dpc("generate4d", "fit", views, "-o", made, "--prior", prior, *words)
        scene = () if row in LAYERS else ("parts", "tracks", "surface")
        metrics = ",".join((*PICTURES, *(LEARNED if learned else ()), *scene))
        return json.loads(dpc("evaluate", "video", made, "--truth", views, "--metrics", metrics, "--json"))["metrics"]

    return runs.once(made.with_suffix(".json"), [runs.digest(views), row, words, learned], work)


def _has_train(views: Path) -> bool:
    with ViewsReader(views) as reader:
        return "train" in reader.header.role


def _cell(values: list[dict], *keys: str, digits: int = 2, scale: float = 1.0) -> str:
    """Returns the mean over clips of the number that the keys lead to, with its 95 % interval; a dash where none has it."""
    found = []
    for value in values:
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        found += [] if value is None else [scale * value]
    if not found:
        return runs.DASH
    spread = 1.96 * np.std(found, ddof=1) / np.sqrt(len(found)) if len(found) > 1 else np.nan
    return f"{np.mean(found):.{digits}f}" + ("" if np.isnan(spread) else f" ± {spread:.{digits}f}")


def table(scores: dict[str, list[dict]], side: str) -> str:
    """Returns markdown: a line a row, means over clips with 95 % intervals; the thesis's numbers below."""
    sides = [("per_role", "test", name) for name in PICTURES]
    titles = "PSNR | PSNR on object | SSIM | IoU | LPIPS | FVD | FID-VID | CLIP | input PSNR | parts ARI | tracks, % | F-score at 2 %"
    lines = [
        f"Input {side}, {max(map(len, scores.values()))} clips; the first four columns: novel views.",
        "",
        f"| row | {titles} |",
        "|---" * 13 + "|",
    ]
    for row, values in scores.items():
        cells = [_cell(values, *keys, digits=2 if "psnr" in keys[-1] else 3) for keys in sides]
        cells += [_cell(values, name, digits=3) for name in LEARNED]
        cells += [
            _cell(values, "per_role", "reference", "psnr"),
            _cell(values, "parts", "adjusted_rand_index"),
            _cell(values, "tracks", "epe_of_diameter", scale=100),
            _cell(values, "surface", "f_score_2", digits=3),
        ]
        lines.append(f"| {row} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, f"| {THESIS} |  |  |  |  |"])


def main() -> None:
    """Makes and scores all rows on the clips that the command line names, and prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--meshes", type=Path)
    source.add_argument("--artemis", type=Path)
    parser.add_argument("--clips", default=CLIPS, help="MODEL.glb:CLIP, comma between; of --meshes")
    known = (*LAYERS, *FITS.values())
    parser.add_argument("--rows", default=",".join(known), help=f"some of {', '.join(known)}")
    parser.add_argument("--size", type=int, help="pixels; 256 for meshes, 512 for ARTEMIS when left out")
    parser.add_argument("--frames", type=int, default=32)
    parser.add_argument(
        "--learned", action="store_true", help="LPIPS, FVD, FID-VID and CLIP, whose networks must be there"
    )
    parser.add_argument("--jobs", type=int, default=2)
    own, fit = runs.cut(None)
    given = parser.parse_args(own)
    rows = given.rows.split(",")
    runs.refuse_unknown(parser, "--rows", "row", rows, known)
    given.out.mkdir(parents=True, exist_ok=True)
    if given.artemis:
        clips = {"as filmed": film_artemis(given.artemis, given.out, given.size or 512, given.frames)}
    else:
        film = partial(film_mesh, given.meshes, out=given.out, size=given.size or 256, frames=given.frames)
        clips = {side: [film(word, side) for word in given.clips.split(",")] for side in YAW}
    tables = []
    for side, views in clips.items():
        work = {row: [partial(score, one, row, tuple(fit), given.learned) for one in views] for row in rows}
        tables.append(table(runs.side_by_side(work, given.jobs), side))
    runs.write_text(given.out / "table.md", "\n\n".join(tables) + "\n")
    print("\n\n".join(tables))


if __name__ == "__main__":
    main()
