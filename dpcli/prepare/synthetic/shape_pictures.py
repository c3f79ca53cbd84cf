"""Rounds of pictures with layers for the training of a shape network: of models, moving or still, and of what is made up.

A round is made from the seed and its number alone, so that a training that goes on sees the pictures it would have seen. Its
models are read and posed by one process and may be drawn by another, which has a GPU.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from dpcli.errors import DataError
from dpcli.prepare.meshes.animated_mesh import AnimatedMesh
from dpcli.prepare.meshes.animation import load_animation, load_still, names_of_clips
from dpcli.prepare.meshes.layered_views import LayeredViews, PosedMesh, draw_views, posed
from dpcli.prepare.synthetic.creature_mesh import animated_creature, make_skin
from dpcli.prepare.synthetic.gait import bone_motion
from dpcli.prepare.synthetic.made_thing import made_thing
from dpcli.prepare.synthetic.wild_creature import wild_creature, wild_turns
from dpcli.regular_files import why_unreadable
from dpcli.runtime.progress import log
from dpcli.runtime.seeds import PrepareStream, generator
from dpcli.text_files import read_text

_POSES, _CELLS = 4, 48  # poses of a mesh at a time; cells of the grid a creature's skin is cut from
_THINGS = 0.3  # of what is made up for training; creatures are the rest
_MOST_MISSES = 200  # models in a row that show nothing
_SAID: set[str] = set()  # what was said of models in this process
_MOST_TRIANGLES = 200_000  # larger models are passed over, since one would hold up all others


@dataclass(frozen=True)
class MeshFile:
    """Names a model and its clips; none: it stands still."""

    path: Path
    clips: tuple[str, ...]


@dataclass(frozen=True)
class PosedModels:
    """Holds the models of a round in their poses. count: pictures of the round; views: of each model; warp: see `draw_views`."""

    meshes: tuple[PosedMesh, ...]
    count: int
    views: int
    size: int
    warp: float
    seed: int
    number: int

    def draw(self, device: torch.device | str = "cpu") -> LayeredViews:
        """Draws the pictures of the round, in random order. Raises DataError where no model shows anything."""
        rng = generator(self.seed, PrepareStream.SHAPE_VIEWS, self.number)
        found = draw_views(self.meshes, self.views, self.size, rng, warp=self.warp, device=device)
        if not len(found.rgba):
            raise DataError(f"none of {len(self.meshes)} models shows anything; are they whole?")
        order = np.resize(rng.permutation(len(found.rgba)), self.count)  # what shows nothing is made up for by others
        return LayeredViews(*(part[torch.from_numpy(order).to(device)] for part in found))


@dataclass(frozen=True)
class PictureSource:
    """Makes rounds of pictures. made, moving: shares of made-up creatures and things and of animated models, 0..1; still
    models have the rest. A folder's share grows with the root of its number of models: many of them are alike. views: pictures of each
    model in a round. warp: how far proportions are changed at random. things: share of what is made up.
    """

    files: tuple[MeshFile, ...]
    size: int
    seed: int
    made: float = 0.5
    moving: float = 0.35
    views: int = 6
    warp: float = 0.0
    things: float = _THINGS

    def make(self, number: int, count: int) -> PosedModels:
        """Poses the models of a round of `count` pictures. Raises DataError where no model shows anything."""
        rng = generator(self.seed, PrepareStream.SHAPE_PICTURES, number)
        meshes: list[PosedMesh] = []
        misses = 0
        while len(meshes) * self.views < count:
            with log.each_once(_SAID):
                mesh = self._draw_mesh(rng)
            shown = posed(_recolored(mesh, rng), rng) if mesh is not None else None
            if shown is not None:
                meshes.append(shown)
                continue
            misses += 1
            if misses > _MOST_MISSES and not meshes:
                raise DataError(
                    f"none of {misses} models drawn shows anything; are these {len(self.files)} models whole?"
                )
        return PosedModels(tuple(meshes), count, self.views, self.size, self.warp, self.seed, number)

    def _draw_mesh(self, rng: np.random.Generator) -> AnimatedMesh | None:
        """Draws a mesh in some poses; None where a model can't be read, which is said once per model."""
        kind = rng.random()
        moving = [file for file in self.files if file.clips]
        still = [file for file in self.files if not file.clips]
        if kind < self.made or not self.files:
            return made_thing(rng, _POSES) if rng.random() < self.things else made_creature(rng)
        if moving and (kind < self.made + self.moving or not still):
            return _read(_draw_file(moving, rng), rng)
        return _read(_draw_file(still, rng), rng)


def picture_sources(
    learned: Sequence[MeshFile],
    held: Sequence[MeshFile],
    size: int,
    seed: int,
    *,
    made: float,
    moving: float,
    views: int = 6,
    warp: float = 0.0,
) -> tuple[PictureSource, PictureSource, PictureSource, PictureSource]:
    """Returns the source to learn from and the one to validate on: held-out models alone, moving and still ones in the shares
    of their numbers; what is made up without any. Then those of creatures and of things, which the confidence tells apart: of
    what is learned, models that move or stand still, half of them, and what is made up.
    """
    if held and not learned and made < 1:
        log.warn(f"all {len(held)} models are held out: what is made up is learned alone")
    return (
        PictureSource(tuple(learned), size, seed, made, moving, views, warp),
        PictureSource(
            tuple(held), size, seed, made=0.0, moving=sum(bool(file.clips) for file in held) / max(len(held), 1)
        ),
        PictureSource(tuple(file for file in learned if file.clips), size, seed, 0.5, moving=0.5, things=0.0),
        PictureSource(tuple(file for file in learned if not file.clips), size, seed, 0.5, moving=0.0, things=1.0),
    )


def find_meshes(places: Sequence[Path], held_out: str | None) -> tuple[list[MeshFile], list[MeshFile]]:
    """Returns the models in files and folders, those to learn from and those that the text file `held_out` names.

    A line of it is a path or the end of one; what follows # is not read. Raises DataError where a model can't be read,
    a folder has none, or a line names none.
    """
    paths = [path for place in places for path in _models_in(place)]
    if held_out and not Path(held_out).is_file():
        raise DataError(f"--held-out {held_out}: {why_unreadable(held_out) or 'no such file'}")
    text = read_text(Path(held_out)) if held_out else ""
    named = dict.fromkeys(end for end in (line.split("#")[0].strip() for line in text.splitlines()) if end)
    ends = [_ends(path) & named.keys() for path in paths]
    found = set().union(*ends)
    for end in named:
        if end not in found:
            raise DataError(
                f"{held_out}: {end} is none of the {len(paths)} models; name paths, or ends of paths, below them"
            )
    files = [(MeshFile(path, names_of_clips(path)), held) for path, held in zip(paths, ends)]
    return [file for file, held in files if not held], [file for file, held in files if held]


def _models_in(place: Path) -> list[Path]:
    """Returns the models that a file or folder holds, in order."""
    if place.is_file():
        return [place]
    if not place.is_dir():
        raise DataError(f"{place}: {why_unreadable(place) or 'no such file or folder'}")
    found = sorted(
        path for path in place.rglob("*") if path.suffix.lower() in (".glb", ".gltf") and not path.name.startswith(".")
    )
    if not found:
        raise DataError(f"{place}: no .glb or .gltf file in it; name models or folders of them")
    return found


def _ends(path: Path) -> set[str]:
    """Returns a path and all ends of it that begin with the name of a folder or file."""
    parts = path.as_posix().split("/")
    return {"/".join(parts[place:]) for place in range(len(parts))}


def made_creature(rng: np.random.Generator) -> AnimatedMesh:
    """Makes a creature of random plan in random poses."""
    animal = wild_creature(rng)
    body = make_skin(animal, rng, _CELLS)
    moved = bone_motion(animal, wild_turns(animal, _POSES, rng), np.zeros((_POSES, 3)))
    return animated_creature(animal, body, moved, name="creature", time=np.arange(_POSES, dtype=float))


def _draw_file(files: Sequence[MeshFile], rng: np.random.Generator) -> MeshFile:
    """Draws a model; each counts one over the root of the number of models in its folder."""
    folders = [str(file.path.parent) for file in files]
    number = Counter(folders)
    weight = np.array([number[folder] ** -0.5 for folder in folders])
    return files[int(rng.choice(len(files), p=weight / weight.sum()))]


def _read(file: MeshFile, rng: np.random.Generator) -> AnimatedMesh | None:
    """Reads a model in random poses of a random clip, sometimes stretched a little along its axes."""
    clip = file.clips[int(rng.integers(len(file.clips)))] if file.clips else None
    try:
        mesh = load_still(file.path) if clip is None else load_animation(file.path, clip, _POSES)
    except DataError as error:
        log.warn(f"left out: {error}")
        return None
    if len(mesh.triangles) > _MOST_TRIANGLES:
        log.warn(f"left out: {file.path}: {len(mesh.triangles):,} triangles, expected at most {_MOST_TRIANGLES:,}")
        return None
    stretch = np.exp(0.12 * rng.normal(size=3)).astype(np.float32)
    return replace(mesh, positions=mesh.positions * stretch)


def _recolored(mesh: AnimatedMesh, rng: np.random.Generator) -> AnimatedMesh:
    """Returns the mesh with colors mixed, so that no color tells what a thing is; one time in three as it is."""
    if rng.random() < 1 / 3:
        return mesh
    mix = rng.dirichlet([0.6] * 3, size=3)
    gain = np.exp(0.3 * rng.normal(size=3))
    materials = []
    for material in mesh.materials:
        color = np.array(material.color[:3])
        if material.texture is None:
            color = rng.random(3) if rng.random() < 0.5 else np.clip(mix @ color * gain, 0, 1)
        else:
            color = np.clip(color * gain, 0, 1.5)
        materials.append(replace(material, color=(*map(float, color), material.color[3])))
    return replace(mesh, materials=tuple(materials))
