"""Animated glTF models into views: one object filmed by virtual cameras, with true tracks and rigid parts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.path_names import file_names
from dpcli.prepare.meshes.animated_mesh import AnimatedMesh
from dpcli.prepare.meshes.filming import Filming, film
from dpcli.prepare.meshes.gltf import Gltf, read_gltf, well_formed
from dpcli.prepare.meshes.gltf_extensions import name_unread, refuse_required
from dpcli.prepare.meshes.gltf_mesh import bake
from dpcli.prepare.meshes.gltf_nodes import choose_clip, clip_names, clips_apart, read_clip
from dpcli.prepare.views.views_pipeline import Clip, digest_of
from dpcli.runtime.progress import log
from dpcli.runtime.provenance import file_digest


def list_clips(path: Path) -> list[tuple[str, float | None]]:
    """Returns (name, seconds) of every clip of a file; None, with a warning, for one that is broken or moves nothing.

    Raises DataError when the file is broken, or has no clip.
    """
    with well_formed(path):
        file = read_gltf(path)
        choose_clip(file, None)
        return [(name, _seconds(file, index)) for index, name in enumerate(clip_names(file))]


def _seconds(file: Gltf, index: int) -> float | None:
    try:
        with well_formed(file.path):
            clip = read_clip(file, index)
    except DataError as error:
        log.warn(str(error))
        return None
    return clip.end - clip.start


def clip_outputs(path: Path, output: str) -> list[tuple[str, str]]:
    """Returns (clip, file) for every clip of a model: OUT.h5 becomes OUT_Walk.h5, OUT_Run.h5, ...

    Names are those of `file_names`. Clips that are broken, or move nothing, are passed over with a warning. Raises
    DataError when none is left.
    """
    clips = list_clips(path)
    if all(seconds is None for _, seconds in clips):
        raise DataError(f"{path}: none of its clips ({len(clips)}) can be read")
    place, ends = Path(output), file_names([name.split("|")[-1] for name, _ in clips], "clip")
    made = ((clip, place.with_name(f"{place.stem}_{end}{place.suffix}")) for clip, end in zip(clips, ends))
    return [(name, str(file)) for (name, seconds), file in made if seconds is not None]


def load_animation(path: Path, clip: str | None, frames: int) -> AnimatedMesh:
    """Reads a clip (None: the file's first) of a .glb or .gltf at `frames` evenly spaced times, in the file's own
    units.
    """
    with well_formed(path):
        file = read_gltf(path)
        refuse_required(file)
        name_unread(file)
        chosen, names = choose_clip(file, clip), clip_names(file)
        if clip is None and len(names) > 1:
            log.info(f"{path}: clip {names[0]!r}, the first of {len(names)}; --list names them, --clip chooses")
        if apart := clips_apart(file, chosen):
            others = ", ".join(map(repr, apart[:3])) + (f" and {len(apart) - 3} more" if len(apart) > 3 else "")
            log.warn(
                f"{path}: what {counted(len(apart), 'other clip')} ({others}) {'moves' if len(apart) == 1 else 'move'} stands "
                f"still in {names[chosen]!r}; if they belong together, export them as one (in Blender: Animation mode "
                "'Active actions merged', or 'Scene' without 'Split Animation by Object')"
            )
        return bake(file, chosen, frames)


def load_still(path: Path) -> AnimatedMesh:
    """Reads a .glb or .gltf as it stands, as a mesh of one frame, in the file's own units."""
    with well_formed(path):
        refuse_required(file := read_gltf(path))
        return bake(file, None, 1)


def names_of_clips(path: Path) -> tuple[str, ...]:
    """Returns the names of a file's clips, none for a model that stands still. Raises DataError for a broken file."""
    with well_formed(path):
        return tuple(clip_names(read_gltf(path)))


def animation_clip(path: Path, clip: str | None, frames: int, filming: Filming, jobs: int = 1) -> Clip:
    """Returns the Clip that `film` makes of `load_animation`."""
    return film(load_animation(path, clip, frames), filming, jobs)


def animation_config(path: Path, clip: str | None, frames: int, filming: Filming) -> dict[str, Any]:
    """Returns what decides the content, for the file's provenance."""
    with well_formed(path):
        name = clip_names(file := read_gltf(path))[choose_clip(file, clip)]
        beside = file.files_beside()
    digests = {"digest": file_digest(path)[:16], **({"files_beside_digest": digest_of(beside)} if beside else {})}
    return {"input": path.name, **digests, "clip": name, "frames": frames, **filming.config}
