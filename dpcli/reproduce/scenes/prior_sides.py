"""The sides that a shape prior shows, without any fit, of models of body plans that it never learned from.

    python -m dpcli.reproduce.scenes.prior_sides MESHES OUT [--models creatures,FOLDER,...] [--clips animals_pack/Fox.glb:Walk,...]

MESHES: the folder of models. One view of a clip, in profile, obliquely and from the front, becomes layers by each prior; the columns
between fronts and backs are drawn from four azimuths that no prior saw: PSNR on white and IoU of the silhouettes. The
row `oracle` has the true layers.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from dpcli.generate4d.shape.layers import Camera, ShapeLayers, ShapePrior
from dpcli.generate4d.shape.learned import Network
from dpcli.generate4d.shape.silhouette import Flat, Inflated
from dpcli.ops.cameras import DEFAULT_FOVY, DEFAULT_RADIUS, orbit_pose, pinhole
from dpcli.prepare.meshes.animated_mesh import AnimatedMesh, normalized
from dpcli.prepare.meshes.animation import load_animation
from dpcli.prepare.meshes.filming import OBJECT_RADIUS
from dpcli.prepare.meshes.layered_views import split_hits
from dpcli.prepare.meshes.raycast import FrameCaster, world_rays

CLIPS = (
    "animals_pack/Fox.glb:Walk,animals_pack/Fox.glb:Gallop,animals_pack/Cow.glb:Walk,animals_pack/Cow.glb:Gallop,"
    "dinosaurs_pack/Trex.glb:TRex_Run,dinosaurs_pack/Trex.glb:TRex_Attack,easy_enemies_pack/Spider.glb:Spider_Walk,"
    "easy_enemies_pack/Spider.glb:Spider_Attack,fish_pack/Shark.glb:Swim,cute_fish_pack/Shark.glb:0,"
    "further/Robot.glb:Robot_Walking,further/Robot.glb:Robot_Dance"
)
SIDES = (15.0, -75.0, 105.0, -165.0)
ROLES = {"profile": 90.0, "oblique": 45.0, "front": 0.0}  # yaw of the model, degrees


def columns_of(layers: ShapeLayers, camera: Camera, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns points f32 (M,3) in the world and their colors (M,3), `step` apart along each interval inside the object."""
    points, colors = [], []
    for index in range(0, len(layers.depth), 2):
        rows, columns = np.nonzero(layers.presence[index // 2] > 0.5)
        front, back = layers.depth[index : index + 2, rows, columns]
        number = np.ceil(np.maximum(back - front, 0) / step).astype(int) + 1
        which = np.repeat(np.arange(len(rows)), number)
        share = (np.arange(len(which)) - np.repeat(np.cumsum(number) - number, number)) / np.repeat(
            np.maximum(number - 1, 1), number
        )
        depth = front[which] + share * (back - front)[which]
        points.append(camera.to_world(camera.pixel_points(rows[which], columns[which], depth)))
        end = index + (share > 0.5)
        colors.append(layers.color[end, :, rows[which], columns[which]])
    return np.concatenate(points).astype(np.float32), np.concatenate(colors)


def draw_points(points: np.ndarray, colors: np.ndarray, camera: Camera, size: int) -> np.ndarray:
    """Draws points as squares of 2 x 2 pixels, the nearest in front; RGBA f32 (H,W,4)."""
    at = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixel = at[:, :2] / at[:, 2:] * camera.intrinsics[[0, 1], [0, 1]] + camera.intrinsics[:2, 2]
    corner = np.floor(pixel - 0.5).astype(int)
    spread = np.concatenate([corner + shift for shift in ((0, 0), (0, 1), (1, 0), (1, 1))])
    depth, shown = np.tile(at[:, 2], 4), np.tile(colors, (4, 1))
    inside = ((spread >= 0) & (spread < size)).all(1)
    spread, depth, shown = spread[inside], depth[inside], shown[inside]
    order = np.argsort(-depth, kind="stable")  # far to near: of equal places the last one stays
    picture = np.zeros((size, size, 4), np.float32)
    picture[spread[order, 1], spread[order, 0]] = np.concatenate([shown[order], np.ones((len(order), 1))], 1)
    return picture


def true_layers(caster: FrameCaster, camera: Camera, picture: np.ndarray) -> ShapeLayers:
    """Returns the layers of the mesh itself behind a picture (4,H,W), each with its true color."""
    height, width = picture.shape[1:]
    rays = world_rays(camera.intrinsics, camera.world_to_camera, slice(0, height), slice(0, width), 1).reshape(-1, 6)
    ray, hit, triangle, weights = caster.all_hits(rays)
    a, b, c = (caster.positions[caster.mesh.triangles[triangle, k]] for k in range(3))
    entering = np.einsum("na,na->n", np.cross(b - a, c - a), rays[ray, 3:]) < 0
    along = hit * (rays[ray, 3:] @ camera.world_to_camera[2, :3].astype(np.float32))
    seen = np.unique(ray)
    depth = np.full((height * width, 4), np.nan)
    depth[seen] = split_hits(*(torch.from_numpy(x) for x in (ray, along, entering))).numpy()
    color = np.zeros((4, height * width, 3), np.float32)
    shown = caster.surface(triangle, weights, rays[ray, 3:])[:, :3]
    for layer in range(4):
        own = np.flatnonzero(np.isclose(along, depth[ray, layer]))
        color[layer, ray[own]] = shown[own]
    depth = depth.T.reshape(4, height, width)
    presence = (~np.isnan(depth[::2])).astype(np.float32)
    return ShapeLayers(
        np.nan_to_num(depth).astype(np.float32), presence, color.transpose(0, 2, 1).reshape(4, 3, height, width)
    )


def compare(shown: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Returns PSNR on white (dB) and IoU of the silhouettes of two pictures (H,W,4)."""
    on_white = [x[..., :3] * x[..., 3:] + 1 - x[..., 3:] for x in (shown, truth)]
    masks = [x[..., 3] > 0.5 for x in (shown, truth)]
    error = max(float(np.mean((on_white[0] - on_white[1]) ** 2)), 1e-10)
    return -10 * np.log10(error), float((masks[0] & masks[1]).sum() / max((masks[0] | masks[1]).sum(), 1))


def score_clip(mesh: AnimatedMesh, priors: dict[str, ShapePrior], size: int) -> dict[str, dict]:
    """Returns PSNR, IoU and confidence of each prior on a clip, means over frames and sides; and those of the true layers."""
    intrinsics = pinhole(DEFAULT_FOVY, size, size)
    camera = Camera(intrinsics, orbit_pose(0.0, 0.0, DEFAULT_RADIUS))
    others = [Camera(intrinsics, orbit_pose(np.radians(side), 0.0, DEFAULT_RADIUS)) for side in SIDES]
    casters = [FrameCaster(mesh, frame) for frame in range(mesh.num_frames)]

    def look(caster: FrameCaster, own: Camera) -> np.ndarray:
        return caster.picture(own.intrinsics, own.world_to_camera, (size, size)) / np.float32(255)

    truth = [[look(caster, other) for other in others] for caster in casters]
    pictures = np.stack([look(caster, camera).transpose(2, 0, 1) for caster in casters])
    rows: dict[str, list[ShapeLayers]] = {name: prior.layers(pictures, camera) for name, prior in priors.items()}
    rows["oracle"] = [true_layers(caster, camera, picture) for caster, picture in zip(casters, pictures)]
    step = 0.5 * DEFAULT_RADIUS / intrinsics[0, 0]
    found = {}
    for name, clip in rows.items():
        values = [
            compare(draw_points(*columns_of(layers, camera, step), other, size), true)
            for layers, own in zip(clip, truth)
            for other, true in zip(others, own)
        ]
        psnr, iou = np.mean(values, axis=0)
        found[name] = {"psnr": psnr, "iou": iou, "confidence": float(np.mean([x.confidence for x in clip]))}
    return found


def find_model(folder: Path, end: str) -> Path:
    """Returns the first model below a folder whose path ends so; ends the program where there is none."""
    found = [path for path in sorted(folder.rglob(Path(end).name)) if path.as_posix().endswith(f"/{end}")]
    if not found:
        sys.exit(f"{folder}: no {end} below it")
    return found[0]


def table(scores: dict[str, dict[str, dict]]) -> str:
    """Returns markdown: a line per prior, a pair of columns per role; means over clips, with a 95 % interval of the IoU."""
    names = list(next(iter(scores.values())))
    lines = ["| row | " + " | ".join(f"{role}: dB | IoU" for role in ROLES) + " |", "|---" * (1 + 2 * len(ROLES)) + "|"]
    for name in names:
        cells = []
        for role in ROLES:
            own = [value[name] for key, value in scores.items() if key.endswith(role)]
            iou = np.array([one["iou"] for one in own])
            spread = 1.96 * iou.std(ddof=min(1, len(iou) - 1)) / np.sqrt(len(iou))
            cells += [f"{np.mean([one['psnr'] for one in own]):.1f}", f"{iou.mean():.3f} ± {spread:.3f}"]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(load: Callable[[str], ShapePrior] = Network) -> None:
    """Scores all rows on the clips that the command line names, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--clips", default=CLIPS)
    parser.add_argument("--models", default="creatures", help="weights, comma between; empty: none")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--size", type=int, default=128)
    given = parser.parse_args()
    priors: dict[str, ShapePrior] = {"flat": Flat(), "inflated": Inflated()}
    priors |= {f"network {name}": load(name) for name in given.models.split(",") if name}
    scores = {}
    for word in given.clips.split(","):
        path, clip = word.split(":")
        mesh = load_animation(find_model(given.meshes, path), clip, given.frames)
        for role, yaw in ROLES.items():
            scores[f"{word} {role}"] = score_clip(normalized(mesh, OBJECT_RADIUS, np.radians(yaw)), priors, given.size)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "scores.json").write_text(json.dumps(scores, indent=1) + "\n")
    (given.out / "table.md").write_text(table(scores) + "\n")
    print(table(scores))


if __name__ == "__main__":
    main()
