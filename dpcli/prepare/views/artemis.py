"""ARTEMIS (the DFA data set): animals filmed by a ring of cameras, with the bones that move them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.ops.cameras import orbit_of
from dpcli.path_names import first_names
from dpcli.prepare.bounding_sphere import bounding_sphere
from dpcli.prepare.decode.color_frames import read_rgba
from dpcli.prepare.reader import ON_ERROR, require_known
from dpcli.prepare.views.artemis_files import (
    Motion,
    Rig,
    Skin,
    declared_frames,
    find_motion,
    has_skin,
    outer_shell,
    read_poses,
    read_rig,
    read_skin,
)
from dpcli.prepare.views.masks import read_mask
from dpcli.prepare.views.matting import clear_invisible
from dpcli.prepare.views.orbit_world import into_orbit, sphere_of_silhouettes, up_direction
from dpcli.prepare.views.square_crop import Box, crop_around, touches_border, union, visible_box
from dpcli.prepare.views.video import spread_frames
from dpcli.prepare.views.views_pipeline import Clip, digest_of
from dpcli.runtime.progress import log
from dpcli.runtime.seeds import PrepareStream, generator
from dpcli.store.views import ViewsHeader

TEST_AZIMUTHS = (15.0, -75.0, 105.0, 195.0)  # of the usual video-to-4D benchmark, relative to the input view
_INSIDE = 0.7  # of the true tracks have to fall on the object; else cameras and bones disagree


@dataclass(frozen=True, kw_only=True)
class ArtemisOptions:
    """Says what is taken of an animal.

    Empty `cameras`: the nearest to TEST_AZIMUTHS; reference None: the lowest number. Raises UsageError on values that make
    no sense.
    """

    motion: str
    frames: int = 32
    size: int = 512
    border: float = 0.2
    reference: int | None = None
    cameras: tuple[int, ...] = ()
    train_cameras: tuple[int, ...] = ()
    tracks: int = 4096
    fps: float = 30.0
    on_error: str = "stop"
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.border <= 0.9:
            raise UsageError(f"--border {self.border:g}: expected 0 to 0.9")
        if not 0 < self.fps < 10_000:
            raise UsageError(f"--fps {self.fps:g}: expected frames per second, above 0")
        require_known(self, on_error=ON_ERROR)


def artemis_config(animal: Path, options: ArtemisOptions) -> dict[str, Any]:
    """Returns options and a digest of cameras and bones, for provenance (the pictures are too many to read twice)."""
    motion = find_motion(animal, options.motion)
    small = [animal / "CamPose.inf", animal / "Intrinsic.inf"]
    small += sorted((animal / "bones" / options.motion).glob("Bones_*.inf"))
    return {
        **asdict(options),
        "frames_found": len(motion.folders),
        "input_digest": digest_of(p for p in small if p.is_file()),
    }


def artemis_clip(animal: Path, options: ArtemisOptions) -> Clip:
    """Reads one motion as views: the reference camera first, then test cameras, then further training cameras.

    The world is turned (the ring's axis becomes y, the reference camera azimuth 0), shifted and scaled so that the
    object's bounding sphere over all frames has radius 0.75 around the origin: from the skinned voxels where the
    folder has them, else from the silhouettes of the first frame. Each camera has one square crop around the object over all frames.
    """
    motion, rig = find_motion(animal, options.motion), read_rig(animal)
    declared = declared_frames(animal).get(motion.name, 0)
    if declared > len(motion.folders):
        log.warn(
            f"{animal}: {len(motion.folders)} of the {declared} frames of {motion.name} are there; is the copy whole?"
        )
    frames = [list(motion.folders)[row] for row in spread_frames(len(motion.folders), options.frames)]
    reference = _pick_reference(motion, frames[0], rig, options.reference)
    skin = _sampled_skin(animal, options) if options.tracks and has_skin(animal) else None
    track = None if skin is None else _tracks(animal, motion, frames, skin)
    if skin is None and options.tracks:
        log.warn(f"{animal}: no volumes/ or bones/: no true tracks; the object's size comes from its silhouettes")
    sphere = bounding_sphere(track) if track is not None else _sphere(motion, frames[0], rig)
    world = into_orbit(up_direction(rig.poses), rig.poses[reference], *sphere)
    poses = np.stack([world.pose(pose) for pose in rig.poses])
    test = _choose(motion, frames[0], poses, reference, options)
    roles = ["reference", *["test"] * len(test), *["train"] * len(options.train_cameras)]
    views = [reference, *test, *options.train_cameras]
    wanted = frames
    frames, boxes = _plan_clip(motion, wanted, views, options.on_error)
    crops = [crop_around(box, options.border) for box in boxes]
    if track is not None:
        track = track[np.isin(wanted, frames)]
        _check_tracks(motion, frames[0], views[0], rig, track[0])
    header = ViewsHeader(
        f"{animal.resolve().name}-{options.motion}",
        np.stack(
            [crop.intrinsics(rig.intrinsics[view], options.size) for crop, view in zip(crops, views, strict=True)]
        ),
        poses[views],
        (np.array(frames) - frames[0]) / options.fps,
        roles,
        0,
        (options.size, options.size),
    )

    def pictures() -> Iterator[tuple[int, int, np.ndarray]]:
        for number, view in enumerate(views):
            for row, frame in enumerate(frames):
                yield number, row, crops[number].apply(_picture(motion, frame, view), options.size)

    moved = None if track is None else world.points(track).astype(np.float32)
    return Clip(header, pictures, moved, None if skin is None else skin.heaviest.astype(np.int16))


def _present(motion: Motion, frame: int, count: int) -> list[int]:
    """Returns cameras that have a picture of this frame."""
    found = []
    for camera in range(count):
        try:
            motion.image(frame, camera)
            found.append(camera)
        except DataError:
            continue
    return found


def _pick_reference(motion: Motion, frame: int, rig: Rig, wanted: int | None) -> int:
    present = _present(motion, frame, len(rig.poses))
    if not present:
        raise DataError(f"{motion.folders[frame]}: no picture img_0000.jpg to img_{len(rig.poses) - 1:04d}.jpg")
    if wanted is not None and wanted not in present:
        raise UsageError(f"--reference {wanted}: cameras with pictures are {_ranges(present)}")
    return present[0] if wanted is None else wanted


def _ranges(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers)) if len(numbers) < 40 else f"{numbers[0]} ... {numbers[-1]} ({len(numbers)})"


def _choose(motion: Motion, frame: int, poses: np.ndarray, reference: int, options: ArtemisOptions) -> list[int]:
    """Returns the test cameras; the log says which and where they stand.

    Raises UsageError on cameras that aren't there.
    """
    present = [camera for camera in _present(motion, frame, len(poses)) if camera != reference]
    azimuth = {camera: np.rad2deg(orbit_of(poses[camera])[0]) for camera in (*present, reference)}
    for option, wanted in (("--cameras", options.cameras), ("--train-cameras", options.train_cameras)):
        wrong = [camera for camera in wanted if camera not in present]
        if wrong:
            raise UsageError(f"{option} {wrong[0]}: expected of {_ranges(present)} (the reference is {reference})")
    both = [*options.cameras, *options.train_cameras]
    if len(set(both)) < len(both):
        raise UsageError("--cameras, --train-cameras: a camera is named twice")
    test = list(options.cameras) or nearest_azimuths(
        {camera: azimuth[camera] for camera in present if camera not in options.train_cameras}
    )
    where = ", ".join(f"{camera} ({azimuth[camera]:.0f})" for camera in test)
    log.info(f"{motion.name}: reference camera {reference}; test cameras (azimuth, degrees) {where or 'none'}")
    return test


def nearest_azimuths(azimuth: dict[int, float], wanted: Sequence[float] = TEST_AZIMUTHS) -> list[int]:
    """Returns for each wanted azimuth (degrees) in turn the nearest camera that is still free; the lower number of
    equals.
    """
    free = dict(sorted(azimuth.items()))
    chosen = []
    for angle in wanted:
        if free:
            best = min(free, key=lambda camera: abs((free[camera] - angle + 180) % 360 - 180))
            chosen.append(best)
            del free[best]
    return chosen


def _sampled_skin(animal: Path, options: ArtemisOptions) -> Skin:
    """Draws at most --tracks voxels of the outer shell, without repeats, in the file's order."""
    bones = len(read_poses(animal / "bones" / "Bones_0000.inf"))
    skin = read_skin(animal, bones)
    shell = outer_shell(skin.points)
    if len(shell) > options.tracks:
        shell = np.sort(generator(options.seed, PrepareStream.TRACKS).choice(shell, options.tracks, replace=False))
    return skin.choose(shell)


def _tracks(animal: Path, motion: Motion, frames: list[int], skin: Skin) -> np.ndarray:
    """Returns the tracks f64 (T,M,3) in the folder's own world."""
    rest = read_poses(animal / "bones" / "Bones_0000.inf")
    places = []
    for frame in frames:
        path = animal / "bones" / motion.name / f"Bones_{frame:04d}.inf"
        bones = read_poses(path)
        if len(bones) != len(rest):
            raise DataError(f"{path}: {len(bones)} bones, the rest pose has {len(rest)}")
        places.append(skin.at(bones, rest))
    return np.stack(places)


def _sphere(motion: Motion, frame: int, rig: Rig) -> tuple[np.ndarray, float]:
    """Returns center and radius of the object from the silhouettes of all cameras at one frame."""
    cameras, boxes = [], []
    for camera in _present(motion, frame, len(rig.poses)):
        box = visible_box(read_mask(motion.alpha(frame, camera)))
        if box is not None:
            cameras.append(camera)
            boxes.append(box)
    if not boxes:
        raise DataError(f"{motion.folders[frame]}: no object in any camera's alpha")
    return sphere_of_silhouettes(rig.intrinsics[cameras], rig.poses[cameras], boxes)


def _picture(motion: Motion, frame: int, camera: int) -> np.ndarray:
    color, alpha = read_rgba(motion.image(frame, camera)), read_mask(motion.alpha(frame, camera))
    if color.shape[:2] != alpha.shape:
        here, there = (f"{shape[1]}x{shape[0]}" for shape in (alpha.shape, color.shape))
        raise DataError(f"{motion.alpha(frame, camera)}: {here}, its picture is {there}; expected the same size")
    return clear_invisible(np.dstack([color[..., :3], alpha]))


def _plan_clip(motion: Motion, frames: list[int], views: list[int], on_error: str) -> tuple[list[int], list[Box]]:
    """Returns frames that are whole in all chosen cameras, and the object's box over them in each."""
    good, boxes, cut_off = [], [], []
    for frame in frames:
        try:
            row = []
            for view in views:
                motion.image(frame, view)
                alpha = read_mask(motion.alpha(frame, view))
                row.append(visible_box(alpha))
                if row[-1] is None:
                    raise DataError(f"{motion.alpha(frame, view)}: no object, the alpha is empty")
                if touches_border(alpha):
                    cut_off.append(f"frame {frame} of camera {view}")
        except DataError as error:
            if on_error == "stop":
                raise DataError(f"{error}\n--on-error skip leaves the frame out") from None
            log.warn(f"frame {frame} left out: {error}")
            continue
        good.append(frame)
        boxes.append(row)
    if not good:
        raise DataError(
            f"{motion.name}: none of its frames ({len(frames)}) is whole in all of cameras {_ranges(views)}"
        )
    if cut_off:
        log.warn(f"the object leaves the picture in {first_names(cut_off, 8)}")
    if len(good) == 1:
        log.warn(f"{motion.name}: one frame only; this makes a still object, motion needs two or more")
    return good, [union([row[at] for row in boxes]) for at in range(len(views))]


def _check_tracks(motion: Motion, frame: int, view: int, rig: Rig, points: np.ndarray) -> None:
    """Warns when the skinned voxels do not project into the silhouette: then cameras or bones are of another convention."""
    alpha = read_mask(motion.alpha(frame, view))
    seen = points @ rig.poses[view][:3, :3].T + rig.poses[view][:3, 3]
    pixel = seen @ rig.intrinsics[view].T
    u, v = np.floor(pixel[:, :2] / np.where(np.abs(pixel[:, 2:]) > 1e-9, pixel[:, 2:], 1)).T
    inside = (seen[:, 2] > 0) & (u >= 0) & (u < alpha.shape[1]) & (v >= 0) & (v < alpha.shape[0])
    hit = alpha[v[inside].astype(int), u[inside].astype(int)] > 0
    share = hit.sum() / len(points)
    if share < _INSIDE:
        log.warn(
            f"{motion.name}: only {share:.0%} of the voxels fall on the object in camera {view}, frame {frame}: "
            "cameras and bones seem to disagree; use the tracks with care"
        )
