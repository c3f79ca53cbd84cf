"""A scene in the formats of others: 3DGS .ply and .splat (one, or one a frame), our `clouds`, cameras and metrics."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.generate4d.out.packed_splats import write_compressed_ply, write_spz
from dpcli.generate4d.out.splat_files import TO_PLAYER, Splats, camera_list, write_splat, write_splat_ply
from dpcli.path_names import frame_names
from dpcli.runtime.whole_file import (
    check_replaced,
    not_writable,
    refuse_broken_link,
    refuse_replacing,
    whole_file,
    write_whole,
)
from dpcli.store import CloudSequence
from dpcli.store.gaussians import GaussianScene, opacity_of

POINT_OPACITY = 0.3  # least opacity of a Gaussian that is a point of the object
_SINGLE = {"ply": write_splat_ply, "splat": write_splat, "compressed.ply": write_compressed_ply, "spz": write_spz}


def opaque_indices(scene: GaussianScene, min_opacity: float) -> np.ndarray:
    """Returns the indices i64 (M) of Gaussians of at least that opacity (0..1). Raises DataError when there is none."""
    kept = np.flatnonzero(opacity_of(scene.opacity_logit) >= min_opacity)
    if not len(kept):
        raise DataError(f"no Gaussian is {min_opacity:g} opaque or more; the most opaque has {scene.opacity.max():.3g}")
    return kept


def keep_opaque(scene: GaussianScene, min_opacity: float) -> GaussianScene:
    """Returns the scene without Gaussians below that opacity; frames, parts, control points and cameras stay."""
    kept = opaque_indices(scene, min_opacity)
    if len(kept) == scene.num_gaussians:
        return scene
    of_gaussian = ("mean", "log_scale", "quaternion", "opacity_logit", "sh", "part", "part_probability")
    of_frame = ("frame_mean", "frame_quaternion", "rigid_weight")
    return replace(
        scene,
        **{key: getattr(scene, key)[kept] for key in of_gaussian},
        **{key: getattr(scene, key)[:, kept] for key in of_frame},
    )


def export_file(
    scene: GaussianScene, path: Path, form: str, *, time: float | None = None, axes: str = "player"
) -> None:
    """Writes one .ply, .splat, .compressed.ply or .spz: the canonical Gaussians, or those at `time` seconds.

    An .spz has y up, as the scene, whatever the axes. Raises DataError when it can't be written.
    """
    _SINGLE[form](path, Splats.of(scene, time, "keep" if form == "spz" else axes))


def export_sequence(
    scene: GaussianScene, folder: Path, form: str, *, axes: str = "player", force: bool = False
) -> list[Path]:
    """Writes frame0001.ply (or .splat), ... into `folder`, cameras and metrics as .json beside it; returns the frames' paths.

    Players show a folder as a clip when it holds nothing but files of such names: see `tables_beside`. The folder appears
    whole. Raises UsageError when it exists and `force` is off, which would replace it.
    """
    check_replaced(folder, ("frame*.ply", "frame*.splat", "frame*.spz", "cameras.json", "metrics.json"))
    for path in (folder, *tables_beside(folder)):
        refuse_replacing(path, force)
    if folder.is_file():
        raise UsageError(f"{folder}: is a file, expected a folder for the frames")
    names = frame_names(range(1, scene.num_frames + 1), f".{form}", "frame")
    try:
        with whole_file(folder) as part:
            _make_folder(part, folder)
            for name, time in zip(names, scene.time.tolist(), strict=True):
                export_file(scene, part / name, form, time=time, axes=axes)
        cameras, metrics = tables_beside(folder)
        write_json(cameras, camera_list(scene, axes))
        write_json(metrics, scene.metrics)
    except OSError as error:
        raise not_writable(folder, error) from None
    return [folder / name for name in names]


def tables_beside(folder: Path) -> tuple[Path, Path]:
    """Returns where the cameras and metrics of a folder of frames are written: `frames_cameras.json` beside `frames`.

    >>> tables_beside(Path("frames"))[0].name
    'frames_cameras.json'
    """
    return folder.with_name(f"{folder.name}_cameras.json"), folder.with_name(f"{folder.name}_metrics.json")


def _make_folder(part: Path, folder: Path) -> None:
    refuse_broken_link(folder)
    try:
        part.mkdir()
    except OSError as error:
        raise DataError(f"{folder}: cannot be made ({error.strerror}); create {folder.parent} first") from None


def write_json(path: Path, content: Any) -> None:
    """Writes readable JSON, equal bytes for equal content, whole or not at all. Raises DataError when it can't be written."""
    write_whole(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode("utf-8"))


def as_sequence(
    scene: GaussianScene,
    name: str,
    *,
    min_opacity: float = POINT_OPACITY,
    points: int | None = None,
    rng: np.random.Generator | None = None,
    axes: str = "player",
) -> CloudSequence:
    """Returns the Gaussians' means as a point cloud video: T frames of the same M points.

    Kept: those of at least `min_opacity`; of them `points` drawn without replacement by `rng`, if there are more. `track`
    is the index of the Gaussian, `part` its rigid part, `pose` the parts' motions, canonical to frame. axes player:
    x right, y down, z away from the reference camera at azimuth 0, as `clouds` have them.
    """
    kept = opaque_indices(scene, min_opacity)
    if points is not None and points < len(kept):
        if rng is None:
            raise UsageError(f"{points} of {len(kept)} points: a generator must draw them")
        kept = np.sort(rng.choice(kept, points, replace=False))
    turn = np.eye(4)
    if axes == "player":
        turn[:3, :3] = TO_PLAYER
    frames = scene.frame_mean[:, kept] * np.float32(turn.diagonal()[:3])
    count = scene.num_frames
    per_point = {"color": scene.color[kept], "part": scene.part[kept], "track": kept.astype(np.int64)}
    pose = turn @ scene.part_motion.astype(np.float64) @ turn if scene.num_parts else None  # turn is its own inverse
    return CloudSequence.from_frames(
        name, list(frames), time=scene.time, pose=pose, **{key: [value] * count for key, value in per_point.items()}
    )
